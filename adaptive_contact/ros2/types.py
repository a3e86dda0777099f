"""Message types of ROS 2: definitions, hashes, CDR.  Needs rosbags (the extra ``ros2``).

rosbags brings the common interfaces.  Those of control_msgs are defined here by their fields, as
hash and layout follow from these alone.  ``JointTrajectoryControllerState`` has had four
definitions; a hash says which one a publisher means.

Reference: REP-2016 (type hashes); control_msgs at 6.8 and its branch ``humble``.
"""

from __future__ import annotations

import struct
from typing import Any, Final

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptive_contact.ros2.names import (
    ARRAY,
    BOOL,
    CONTROLLER_STATE,
    DIAGNOSTICS,
    JOINT_STATE,
    JOINT_VALUES,
    TRAJECTORY,
)
from adaptive_contact.ros2.rmw import NO_HASH

__all__ = ["CdrError", "Types", "UnknownHashError", "typestore"]

# A message of ours has a value per joint; a length beyond this is damage, and would allocate.
_MOST_ITEMS: Final = 65_536

_POINT: Final = "trajectory_msgs/JointTrajectoryPoint"
_MULTI: Final = "trajectory_msgs/MultiDOFJointTrajectoryPoint"


def _state_fields(single: str, multi: str = "", last: str = "") -> str:
    """Definition of a controller state with these points, in their order."""
    lines = ["std_msgs/Header header", "string[] joint_names"]
    lines += [f"{_POINT} {name}" for name in single.split()]
    if multi:
        lines.append("string[] multi_dof_joint_names")
        lines += [f"{_MULTI} multi_dof_{name}" for name in multi.split()]
    return "\n".join([*lines, last, ""])


_NEW: Final = "reference feedback error output"
_BOTH: Final = f"{_NEW} desired actual"
_OLD: Final = "desired actual error"
# The newest first.
_CONTROLLER_STATES: Final = {
    "jazzy": _state_fields(_NEW, _NEW, "float64 speed_scaling_factor"),
    "2023": _state_fields(_NEW, _NEW),
    "humble": _state_fields(_BOTH, _BOTH),
    "old": _state_fields(_OLD),
}
_JOINT_VALUES: Final = (
    "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n"
)
_INTERFACE_VALUE: Final = "string[] interface_names\nfloat64[] values\n"

# What rosbags' generated code raises on bytes that are no such message.
_DAMAGE: Final = (SerdeError, struct.error, ValueError, IndexError, OverflowError, MemoryError)


class CdrError(Exception):
    """A payload is no message of its type."""


class UnknownHashError(Exception):
    """A type's hash is of no definition that is known; the text names those that are."""


def typestore(state: str = "jazzy") -> Typestore:
    """All types that are read or written.

    Args:
        state: which definition of a controller state.
    """
    store = get_typestore(Stores.ROS2_JAZZY)
    store.max_sequence_length = _MOST_ITEMS
    store.register(
        {
            **get_types_from_msg(_CONTROLLER_STATES[state], CONTROLLER_STATE),
            **get_types_from_msg(_JOINT_VALUES, JOINT_VALUES),
            **get_types_from_msg(_INTERFACE_VALUE, "control_msgs/msg/InterfaceValue"),
        }
    )
    return store


class Types:
    """Reads and writes messages.

    Args:
        distro: of the ROS 2 that is talked to.
    """

    def __init__(self, distro: str = "jazzy") -> None:
        self._hashed = distro != "humble"
        self._stores = {name: typestore(name) for name in _CONTROLLER_STATES}
        own = self._stores["jazzy" if self._hashed else "humble"]
        self._own = own
        self.types: dict[str, Any] = own.types
        known = (CONTROLLER_STATE, JOINT_STATE, TRAJECTORY, ARRAY, BOOL, JOINT_VALUES, DIAGNOSTICS)
        # Definitions by (type, hash), and all that a key without hash may mean.
        self._by_hash: dict[tuple[str, str], Typestore] = {}
        for name, store in self._stores.items():
            for kind in known:
                self._by_hash.setdefault((kind, store.hash_rihs01(kind)), self._stores[name])
        self._unhashed = {
            NO_HASH: [self._stores["humble"], self._stores["old"]],
            "": list(self._stores.values()),
        }

    def hash_of(self, type_name: str) -> str:
        """What stands in keys for a type's definition."""
        return self._own.hash_rihs01(type_name) if self._hashed else NO_HASH

    def decode(self, type_name: str, type_hash: str, payload: bytes) -> Any:
        """Read a message.

        Args:
            type_name: of the message.
            type_hash: of its definition; an empty text tries each, and lengths tell them apart.
            payload: CDR.

        Raises:
            UnknownHashError: no definition has this hash.
            CdrError: the bytes are no such message.
        """
        stores = self._unhashed.get(type_hash, [])
        if not stores:
            found = self._by_hash.get((type_name, type_hash))
            if found is None:
                hashes = [hash_ for kind, hash_ in self._by_hash if kind == type_name]
                raise UnknownHashError(", ".join(hash_[:15] + "…" for hash_ in hashes))
            stores = [found]
        why = ""
        for store in stores:
            try:
                return store.deserialize_cdr(payload, type_name)
            except _DAMAGE as error:
                why = why or str(error) or type(error).__name__
        raise CdrError(why)

    def encode(self, message: Any) -> bytes:
        """CDR of a message made of :attr:`types`."""
        return bytes(self._own.serialize_cdr(message, message.__msgtype__))
