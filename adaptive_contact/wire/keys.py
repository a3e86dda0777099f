"""Defines the Zenoh keys of the wire contract.

Keys carry no leading slash.  Several robots on one network are distinguished by Zenoh's
``namespace`` setting, which prefixes every key outside the process and strips it inside.
"""

from __future__ import annotations

import difflib
import re
from typing import Final

from adaptive_contact.wire.messages import LEG_MESSAGES

ALL_SERVO: Final = "robot/leg/*/servo"
ALL_CONTACT: Final = "robot/leg/*/contact"
ALL_LEARNER: Final = "robot/leg/*/learner"
ALL_STATE: Final = "robot/leg/*/state"
ALL_TRUTH: Final = "robot/leg/*/truth"
SIM_DRIFT: Final = "robot/sim/drift"
SIM_BODY: Final = "robot/sim/body"
HEARTBEAT: Final = "robot/service"
MARK: Final = "robot/mark"

# A leg id becomes one chunk of a key: no '/', and none of the wildcards '*', '$', '?', '#',
# which Zenoh accepts in `put` and would fan one sample out over every leg.
_LEG_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}\Z")
_LEG_KEY = re.compile(rf"robot/leg/([^/]*)/(?:{'|'.join(LEG_MESSAGES)})\Z")
_OWN_DEPTH: Final = 4
# Keys of the contract that belong to no leg, in a namespace or out of it.
_OTHER_KEY = re.compile(
    r"(?:.*/)?robot/(?:service(?:/status)?|mark|sim/(?:drift|body)|bridge/[^/]+/status)\Z"
)


def is_leg_id(text: str) -> bool:
    """Return whether ``text`` may name a leg: 1-32 letters, digits, ``_``, ``.`` or ``-``."""
    return _LEG_ID.match(text) is not None


def leg_of_key(key: str) -> str | None:
    """Return the leg that a key names, or None where it has none or an unusable one."""
    match = _LEG_KEY.match(key)
    if match is None or not is_leg_id(match.group(1)):
        return None
    return match.group(1)


def namespace_of(key: str) -> str | None:
    """Return the namespace in front of a leg's key of the contract, None where it is no such key.

    Outside of Zenoh a key may begin with ``/``, as a topic of ROS does; that belongs to none.
    """
    head, found, rest = key.lstrip("/").partition("robot/leg/")
    if not found or (head and not head.endswith("/")) or leg_of_key(found + rest) is None:
        return None
    return head.rstrip("/")


def meant_key(key: str) -> str | None:
    """Return the key of the contract that was probably meant by one that it does not have.

    Returns:
        The key, None where the key is of the contract, or of something else.
    """
    if leg_of_key(key) is not None or namespace_of(key) or _OTHER_KEY.match(key):
        return None
    parts = key.strip("/").split("/")
    if len(parts) < 2:
        return None
    own = key.lstrip("/").startswith("robot/leg/")
    pairs = [parts[-2:]]
    if own and len(parts) > _OWN_DEPTH:  # something behind, as of a joint
        pairs.insert(0, parts[2:4])
    for leg, kind in [way for pair in pairs for way in (pair, pair[::-1])]:  # also turned round
        near = difflib.get_close_matches(kind.lower(), LEG_MESSAGES, n=1)
        # A word of other robots' keys, such as camera/command, is no misspelling of ours; nor are
        # keys with more slashes.
        ours = own or (near == ["servo"] and len(parts) <= _OWN_DEPTH)
        if near and ours and is_leg_id(leg) and f"robot/leg/{leg}/{near[0]}" != key:
            return f"robot/leg/{leg}/{near[0]}"
    return None


def servo_key(leg: str) -> str:
    """Return the key of a leg's :class:`~adaptive_contact.wire.ServoSample` stream."""
    return f"robot/leg/{leg}/servo"


def contact_key(leg: str) -> str:
    """Return the key of a leg's :class:`~adaptive_contact.wire.ContactEvent` stream."""
    return f"robot/leg/{leg}/contact"


def learner_key(leg: str) -> str:
    """Return the key of a leg's :class:`~adaptive_contact.wire.LearnerStatus` stream."""
    return f"robot/leg/{leg}/learner"


def model_key(leg: str) -> str:
    """Return the key of a leg's queryable :class:`~adaptive_contact.wire.ModelReport`."""
    return f"robot/leg/{leg}/model"


def trace_key(leg: str) -> str:
    """Return the key of a leg's queryable :class:`~adaptive_contact.wire.LegTrace`."""
    return f"robot/leg/{leg}/trace"


def state_key(leg: str) -> str:
    """Return the key of a leg's :class:`~adaptive_contact.wire.LegState` stream."""
    return f"robot/leg/{leg}/state"


def truth_key(leg: str) -> str:
    """Return the key of a simulated leg's :class:`~adaptive_contact.wire.ContactTruth` stream."""
    return f"robot/leg/{leg}/truth"


def command_key(leg: str) -> str:
    """Return the key of a leg's :class:`~adaptive_contact.wire.Command` stream."""
    return f"robot/leg/{leg}/command"


def bridge_status_key(port: str) -> str:
    """Return the key of a bridge's status; ``port`` is its name in ``robot.toml``."""
    return f"robot/bridge/{port}/status"
