"""Keeps learners' state on disk: it survives a restart, a crash and a full disk.

:mod:`.format` is one file's bytes, :mod:`.store` a folder of them.  :mod:`.keeper` decides when to
save; the worker never waits for a disk.
"""

from __future__ import annotations

from adaptive_contact.service.state.format import (
    FORMAT,
    Identity,
    Record,
    Refused,
    default_folder,
    pack,
    settings_digest,
    unpack,
)
from adaptive_contact.service.state.store import (
    StateStore,
    Stored,
    is_of_leg,
    list_rest,
    list_states,
    robot_folder,
)

__all__ = [
    "FORMAT",
    "Identity",
    "Record",
    "Refused",
    "StateStore",
    "Stored",
    "default_folder",
    "is_of_leg",
    "list_rest",
    "list_states",
    "pack",
    "robot_folder",
    "settings_digest",
    "unpack",
]
