"""Encodes types, keys, liveliness tokens and attachments of rmw_zenoh.

A topic is published on ``<domain>/<topic>/<type>/<type hash>``.  Every node, publisher and
subscription shows itself by a liveliness token under ``@ros2_lv``.  A message carries an
attachment: sequence number (int64), source time in ns (int64), publisher id (16 bytes).

Reference: rmw_zenoh, docs/design.md and rmw_zenoh_cpp/src/detail (attachment_helpers.cpp,
liveliness_utils.cpp, qos.cpp), as of ROS 2 Kilted.
"""

from __future__ import annotations

import enum
import hashlib
import struct
from typing import Final, Literal, NamedTuple


class RosType(enum.StrEnum):
    """Name of a message type, as keys, bags and rosbags write it."""

    CONTROLLER_STATE = "control_msgs/msg/JointTrajectoryControllerState"
    JOINT_STATE = "sensor_msgs/msg/JointState"
    TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
    ARRAY = "std_msgs/msg/Float64MultiArray"
    BOOL = "std_msgs/msg/Bool"
    JOINT_VALUES = "control_msgs/msg/DynamicJointState"
    DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


# What a topic of each role may carry.
STATES: Final = (RosType.CONTROLLER_STATE, RosType.JOINT_STATE)
COMMANDS: Final = (RosType.JOINT_STATE, RosType.TRAJECTORY, RosType.ARRAY)
FLAGS: Final = (RosType.BOOL,)


# Humble's rosidl knows no type hashes and writes this in their place.
NO_HASH: Final = "TypeHashNotSupported"

# Quality of service in a token: reliability, durability, history and depth, deadline, lifespan,
# liveliness; empty is rmw_zenoh's default (reliable, volatile, keep last, for ever, automatic).
STREAM: Final = "::,10:,:,:,,"
LATCHED: Final = ":1:,1:,:,:,,"  # transient local, depth 1

_PLAIN: Final = struct.Struct("<qqB16s")
_ID_BYTES: Final = 16


class Address(NamedTuple):
    """Holds what a key of rmw_zenoh names."""

    topic: str  # with a leading slash
    type: str  # such as ``sensor_msgs/msg/JointState``
    hash: str  # of the type's definition


class Attachment(NamedTuple):
    """Holds what a publisher attaches to a message."""

    seq: int  # +1 with every message of the publisher
    time_ns: int  # when it was published, ns since 1970
    publisher: bytes  # (16 bytes) its id


class Node(NamedTuple):
    """Describes a node as its tokens name it."""

    domain: int  # ``ROS_DOMAIN_ID``
    session: str  # Zenoh id of its session
    name: str  # without namespace

    @property
    def token(self) -> str:
        """Return the liveliness token of the node itself."""
        return f"@ros2_lv/{self.domain}/{self.session}/0/0/NN/%/%/{self.name}"

    def endpoint_token(
        self, kind: Literal["MP", "MS"], number: int, address: Address, quality: str
    ) -> str:
        """Return the token of a publisher (``MP``) or subscription (``MS``) of this node."""
        return (
            f"@ros2_lv/{self.domain}/{self.session}/0/{number}/{kind}/%/%/{self.name}/"
            f"{address.topic.replace('/', '%')}/{dds_name(address.type)}/{address.hash}/{quality}"
        )


def dds_name(type_name: str) -> str:
    """Name of a message type in keys: ``std_msgs/msg/Bool`` is ``std_msgs::msg::dds_::Bool_``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def topic_key(domain: int, address: Address) -> str:
    """Return the key that messages of a topic are published on."""
    return f"{domain}/{address.topic.strip('/')}/{dds_name(address.type)}/{address.hash}"


def any_type(domain: int, topic: str) -> str:
    """Return the key expression of a topic's messages of any type, so that a wrong one is named."""
    return f"{domain}/{topic.strip('/')}/*/*"


def address_of(key: str) -> Address | None:
    """Parse the key of a message; None where it is none of rmw_zenoh's."""
    parts = key.split("/")
    if len(parts) < 4:
        return None
    # A type's name as ROS has it; other texts stay as they are.
    package, found, name = parts[-2].partition("::msg::dds_::")
    kind = f"{package}/msg/{name.removesuffix('_')}" if found else parts[-2]
    return Address("/" + "/".join(parts[1:-2]), kind, parts[-1])


def publisher_id(token: str) -> bytes:
    """Return the id of a publisher (16 bytes) by its token.

    rmw_zenoh takes XXH3 here; receivers only compare ids of messages with each other.
    """
    return hashlib.blake2b(token.encode(), digest_size=_ID_BYTES).digest()


def encode_attachment(attachment: Attachment) -> bytes:
    """Encode an attachment."""
    return _PLAIN.pack(attachment.seq, attachment.time_ns, _ID_BYTES, attachment.publisher)


def decode_attachment(data: bytes) -> Attachment | None:
    """Read an attachment; None where it is none."""
    if len(data) != _PLAIN.size:
        return None
    seq, time_ns, length, publisher = _PLAIN.unpack(data)
    return Attachment(seq, time_ns, publisher) if length == _ID_BYTES else None
