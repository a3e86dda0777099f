"""Draws the robot for Foxglove: joint states, transforms, and feet, red while they touch.

Each is one topic with the whole robot in each message: a viewer that jumps to a time needs no other
message, and a plot finds a joint always at the same place.  Topics begin with a slash, as no key
of Zenoh does.

With all angles 0 every joint's frame is parallel to its leg's; it is placed by the link before it
and turned about the joint's axis (:mod:`adaptive_contact.robot.kinematics`).

``foxglove.binpb`` beside this file has Foxglove's own descriptors of these messages (MIT licence,
https://github.com/foxglove/foxglove-sdk).

Reference: https://docs.foxglove.dev/docs/visualization/message-schemas
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool

from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.description import AngleFrame
from adaptive_contact.robot.kinematics import Vector
from adaptive_contact.wire import (
    BodyPose,
    ContactEvent,
    Message,
    ServoSample,
    leg_of_key,
)

_TOPICS: Final = {
    "/joint_states": "foxglove.JointStates",
    "/tf": "foxglove.FrameTransforms",
    "/robot": "foxglove.SceneUpdate",
}
BODY: Final = "base_link"
WORLD: Final = "world"
# Colours as red, green, blue and opacity.
_LINK: Final = (0.35, 0.45, 0.6, 1.0)
_FREE: Final = (0.7, 0.7, 0.7, 1.0)
_TOUCHES: Final = (0.9, 0.1, 0.1, 1.0)
_WITHHELD: Final = (0.95, 0.65, 0.1, 1.0)

Color = tuple[float, float, float, float]
Schema = tuple[str, bytes]  # name and descriptors


class Scene:
    """Draws a robot from its samples and its events.

    Legs without geometry have joint states only.
    """

    def __init__(self, robot: Robot) -> None:
        topics = _made()
        self._topics = tuple(topics)
        self._joints, self._transforms, self._update = (made for _, made, _ in topics)
        shared = Counter(joint for leg in robot.legs for joint in leg.joints)
        self._legs = {
            leg.id: _DrawnLeg(
                leg,
                self._joints,
                self._transforms,
                self._update,
                [f"{leg.id}/{name}" if shared[name] > 1 else name for name in leg.joints],
            )
            for leg in robot.legs
        }
        self._moved: set[str] = set()
        self._body: Any = None  # its transform; None while nothing says where it is
        self.restart()

    def restart(self) -> None:
        """Begin a new file, which gets the scene with the first samples."""
        self._changed = True

    def update(
        self, key: str, message: Message, time_ns: int
    ) -> Iterator[tuple[str, bytes, Schema]]:
        """Update the scene by a message; yield topics, messages and schemas to write after it."""
        if isinstance(message, BodyPose):
            self._move_body(message)
        leg = self._legs.get(leg_of_key(key) or "")
        if leg is None:
            return
        if isinstance(message, ServoSample):
            name = leg.id
            if name in self._moved:  # of the next tick: one of the others is missing
                yield from self._draw(time_ns)
            if leg.move(message.measured):
                self._moved.add(name)
            if len(self._moved) == len(self._legs):
                yield from self._draw(time_ns)
        elif isinstance(message, ContactEvent):
            seen = _WITHHELD if message.withheld else _TOUCHES if message.contact else _FREE
            self._changed |= leg.show_contact(seen)

    def _move_body(self, pose: BodyPose) -> None:
        """Place the body in the world, for the ticks that follow."""
        if self._body is None:
            transforms = self._transforms.transforms
            self._body = transforms.add(parent_frame_id=WORLD, child_frame_id=BODY)
        rotation = self._body.rotation
        _set_vector(self._body.translation, pose.position_m)
        rotation.w, rotation.x, rotation.y, rotation.z = pose.quaternion_wxyz

    def _draw(self, time_ns: int) -> Iterator[tuple[str, bytes, Schema]]:
        self._moved.clear()
        self._joints.timestamp.FromNanoseconds(time_ns)
        for transform in self._transforms.transforms:
            transform.timestamp.CopyFrom(self._joints.timestamp)
        for entity in self._update.entities:
            entity.timestamp.CopyFrom(self._joints.timestamp)
        for topic, message, schema in self._topics if self._changed else self._topics[:2]:
            yield topic, message.SerializeToString(), schema
        self._changed = False


class _DrawnLeg:
    """Draws one leg's part of the messages."""

    def __init__(
        self,
        leg: Leg,
        joints: Any,
        transforms: Any,
        scene: Any,
        names: list[str],
    ) -> None:
        self.id = leg.id
        self._angles = AngleFrame(leg).angles
        self._joints = [joints.joints.add(name=name) for name in names]
        self._turns: list[tuple[Any, Vector]] = []
        self._sphere: Any = None  # of the foot
        chain = leg.chain
        if chain is None:
            return
        reach_m, parent, place = chain.reach_m, leg.id, (0.0, 0.0, 0.0)
        half = leg.mount.yaw_rad / 2
        mount = transforms.transforms.add(parent_frame_id=BODY, child_frame_id=parent)
        _set_vector(mount.translation, leg.mount.xyz_m)
        mount.rotation.z, mount.rotation.w = math.sin(half), math.cos(half)
        self._add_link(scene, BODY, leg.mount.xyz_m, reach_m, parent)
        for joint, axis, way in zip(leg.joints, chain.axis_vectors, chain.origins_m, strict=True):
            frame = f"{leg.id}/{joint}"
            transform = transforms.transforms.add(parent_frame_id=parent, child_frame_id=frame)
            _set_vector(transform.translation, place)
            transform.rotation.w = 1.0
            self._turns.append((transform.rotation, axis))
            entity = self._add_link(scene, frame, way, reach_m, frame)
            parent, place = frame, way
        self._sphere = entity.spheres.add()
        _set_vector(self._sphere.pose.position, place)
        self._sphere.pose.orientation.w = 1.0
        _set_vector(self._sphere.size, (0.1 * reach_m,) * 3)
        self._colour = _FREE
        _paint(self._sphere.color, _FREE)

    def move(self, measured: list[float]) -> bool:
        """Move the joints to a sample; return False if it does not fit this leg."""
        angles = self._angles(measured)
        if len(angles) != len(self._joints) or not all(map(math.isfinite, angles)):
            return False
        for joint, angle in zip(self._joints, angles, strict=True):
            joint.position = angle
        for (rotation, (x, y, z)), angle in zip(self._turns, angles, strict=False):
            sin = math.sin(angle / 2)
            rotation.x, rotation.y, rotation.z = x * sin, y * sin, z * sin
            rotation.w = math.cos(angle / 2)
        return True

    def show_contact(self, colour: Color) -> bool:
        """Paint the foot; return whether that changes the picture."""
        if self._sphere is None or colour == self._colour:
            return False
        self._colour = colour
        _paint(self._sphere.color, colour)
        return True

    def _add_link(self, scene: Any, frame: str, way: Vector, reach_m: float, name: str) -> Any:
        entity = scene.entities.add(frame_id=frame, id=name, frame_locked=True)
        line = entity.lines.add(thickness=0.03 * reach_m)
        line.pose.orientation.w = 1.0
        line.points.add()
        _set_vector(line.points.add(), way)
        _paint(line.color, _LINK)
        return entity


def _set_vector(vector: Any, place: Vector) -> None:
    vector.x, vector.y, vector.z = place


def _paint(color: Any, parts: Color) -> None:
    color.r, color.g, color.b, color.a = parts


def _made() -> list[tuple[str, Any, Schema]]:
    """Return topics, empty messages, and their schemas with all that these need."""
    descriptors = (Path(__file__).parent / "foxglove.binpb").read_bytes()
    pool, files = DescriptorPool(), {}
    for file in FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
        files[file.name] = file

    def needed(name: str) -> list[str]:
        return [*(n for of in files[name].dependency for n in needed(of)), name]

    made = []
    for topic, name in _TOPICS.items():
        kind = pool.FindMessageTypeByName(name)
        parts = [files[part] for part in dict.fromkeys(needed(kind.file.name))]
        schema = name, FileDescriptorSet(file=parts).SerializeToString()
        made.append((topic, message_factory.GetMessageClass(kind)(), schema))
    return made
