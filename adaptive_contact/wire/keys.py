"""Zenoh keys of the wire contract.

Keys carry no leading slash.  Several robots on one network are told apart by Zenoh's own
``namespace`` setting, which prefixes every key outside the process and strips it inside.
"""

from __future__ import annotations

import re
from typing import Final

__all__ = [
    "ALL_CONTACT",
    "ALL_LEARNER",
    "ALL_SERVO",
    "ALL_TRUTH",
    "SIM_DRIFT",
    "bridge_status_key",
    "command_key",
    "contact_key",
    "is_leg_id",
    "learner_key",
    "leg_of_key",
    "model_key",
    "servo_key",
    "truth_key",
]

ALL_SERVO: Final = "robot/leg/*/servo"
ALL_CONTACT: Final = "robot/leg/*/contact"
ALL_LEARNER: Final = "robot/leg/*/learner"
ALL_TRUTH: Final = "robot/leg/*/truth"
SIM_DRIFT: Final = "robot/sim/drift"

# A leg id becomes one chunk of a key: no '/', and none of the wildcards '*', '$', '?', '#',
# which Zenoh accepts in `put` and would fan one sample out over every leg.
_LEG_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}\Z")
_LEG_KEY = re.compile(r"robot/leg/([^/]*)/(?:servo|contact|learner|model|truth|command)\Z")


def is_leg_id(text: str) -> bool:
    """Tell whether ``text`` may name a leg: 1-32 letters, digits, ``_``, ``.`` or ``-``."""
    return _LEG_ID.match(text) is not None


def leg_of_key(key: str) -> str | None:
    """Return the leg a key speaks of, or None where it has none or an unusable one."""
    match = _LEG_KEY.match(key)
    if match is None or not is_leg_id(match.group(1)):
        return None
    return match.group(1)


def servo_key(leg: str) -> str:
    """Key of a leg's :class:`~adaptive_contact.wire.ServoSample` stream."""
    return f"robot/leg/{leg}/servo"


def contact_key(leg: str) -> str:
    """Key of a leg's :class:`~adaptive_contact.wire.ContactEvent` stream."""
    return f"robot/leg/{leg}/contact"


def learner_key(leg: str) -> str:
    """Key of a leg's :class:`~adaptive_contact.wire.LearnerStatus` stream."""
    return f"robot/leg/{leg}/learner"


def model_key(leg: str) -> str:
    """Key of a leg's queryable :class:`~adaptive_contact.wire.ModelReport`."""
    return f"robot/leg/{leg}/model"


def truth_key(leg: str) -> str:
    """Key of a simulated leg's :class:`~adaptive_contact.wire.ContactTruth` stream."""
    return f"robot/leg/{leg}/truth"


def command_key(leg: str) -> str:
    """Key of a leg's :class:`~adaptive_contact.wire.Command` stream."""
    return f"robot/leg/{leg}/command"


def bridge_status_key(port: str) -> str:
    """Key of a bridge's status; ``port`` is its name in ``robot.toml``."""
    return f"robot/bridge/{port}/status"
