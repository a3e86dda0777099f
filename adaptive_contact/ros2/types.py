"""Defines message types of ROS 2: definitions, hashes, CDR.  Needs rosbags (extra ``ros2``).

rosbags brings the common interfaces.  Those of control_msgs are defined here by their fields, as
hash and layout follow from these alone.  ``JointTrajectoryControllerState`` has had four
definitions; a hash says which one a publisher means.

Reference: REP-2016 (type hashes); control_msgs at 6.8 and its branch ``humble``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adaptive_contact.ros2.problems import CdrError, UnknownHashError
from adaptive_contact.ros2.rmw import NO_HASH, RosType


class _Definition(NamedTuple):
    """Describes a definition of a controller's state."""

    points: str
    multi: bool = True
    scaling: bool = False

    @property
    def fields(self) -> str:
        """Return the fields as rosidl writes them."""
        lines, points = ["std_msgs/Header header", "string[] joint_names"], self.points.split()
        lines += [f"trajectory_msgs/JointTrajectoryPoint {name}" for name in points]
        if self.multi:
            lines.append("string[] multi_dof_joint_names")
            kind = "trajectory_msgs/MultiDOFJointTrajectoryPoint"
            lines += [f"{kind} multi_dof_{name}" for name in points]
        if self.scaling:
            lines.append("float64 speed_scaling_factor")
        return "\n".join([*lines, ""])


_NEW: Final = "reference feedback error output"
# The newest first.
_CONTROLLER_STATES: Final = {
    "jazzy": _Definition(_NEW, scaling=True),
    "2023": _Definition(_NEW),
    "humble": _Definition(f"{_NEW} desired actual"),
    "old": _Definition("desired actual error", multi=False),
}


def typestore(state: str = "jazzy") -> Typestore:
    """Return a store of all types that are read or written."""
    store = get_typestore(Stores.ROS2_JAZZY)
    # A message of ours has a value per joint; a length beyond this is damage, and would allocate.
    store.max_sequence_length = 65_536
    definitions = {
        RosType.CONTROLLER_STATE: _CONTROLLER_STATES[state].fields,
        RosType.JOINT_VALUES: (
            "std_msgs/Header header\nstring[] joint_names\nInterfaceValue[] interface_values\n"
        ),
        "control_msgs/msg/InterfaceValue": "string[] interface_names\nfloat64[] values\n",
    }
    for name, fields in definitions.items():
        store.register(get_types_from_msg(fields, name))
    return store


class Types:
    """Reads and writes messages as a distribution of ROS 2 has them."""

    def __init__(self, distro: str = "jazzy") -> None:
        self._hashed = distro != "humble"
        self._stores = {name: typestore(name) for name in _CONTROLLER_STATES}
        own = self._stores["jazzy" if self._hashed else "humble"]
        self._own = own
        self.types: dict[str, Any] = own.types
        every = list(self._stores.values())
        self._states = {store.hash_rihs01(RosType.CONTROLLER_STATE): [store] for store in every}
        self._known = ", ".join(map(_short, self._states))
        # Definitions that a key without hash may mean, and a bag that says nothing.
        self._states |= {NO_HASH: every[2:], "": every}
        others = (name for name in RosType if name is not RosType.CONTROLLER_STATE)
        self._hashes: dict[str, str] = {name: own.hash_rihs01(name) for name in others}

    def hash_of(self, type_name: str) -> str:
        """Return the hash that stands in keys for a type's definition."""
        return self._own.hash_rihs01(type_name) if self._hashed else NO_HASH

    def decode(self, type_name: str, type_hash: str, payload: bytes) -> Any:
        """Read a message.

        Args:
            type_name: of the message.
            type_hash: of its definition; an empty text tries each, and lengths distinguish them.
            payload: CDR.

        Raises:
            UnknownHashError: no definition has this hash.
            CdrError: the bytes are no such message.
        """
        if type_name != RosType.CONTROLLER_STATE:
            known = self._hashes.get(type_name, "")
            if type_hash not in (NO_HASH, "", known):
                raise UnknownHashError(_short(known))
            return _read(self._own, type_name, payload)
        stores = self._states.get(type_hash)
        if stores is None:
            raise UnknownHashError(self._known)
        why = ""
        for store in stores:
            try:
                return _state(_read(store, type_name, payload))
            except CdrError as error:
                why = why or str(error)
        raise CdrError(why)

    def encode(self, message: Any) -> bytes:
        """Encode a message made of :attr:`types` as CDR."""
        return bytes(self._own.serialize_cdr(message, message.__msgtype__))


def _read(store: Typestore, type_name: str, payload: bytes) -> Any:
    try:
        return store.deserialize_cdr(payload, type_name)
    # What rosbags' generated code raises on bytes that are no such message.
    except (
        SerdeError,
        struct.error,
        ValueError,
        IndexError,
        OverflowError,
        MemoryError,
    ) as error:
        raise CdrError(str(error) or type(error).__name__) from error


class ControllerState(NamedTuple):
    """Holds what a sample needs of a controller's state."""

    header: Any
    joint_names: Sequence[str]
    # points of a trajectory
    feedback: Any
    reference: Any


def _state(message: Any) -> ControllerState:
    def point(name: str, old: str) -> Any:
        """Humble fills both; a definition that is older has only the second."""
        new = getattr(message, name, None)
        return new if new is not None and len(new.positions) else getattr(message, old, new)

    return ControllerState(
        message.header,
        message.joint_names,
        point("feedback", "actual"),
        point("reference", "desired"),
    )


def _short(type_hash: str) -> str:
    return type_hash[:15] + "…"
