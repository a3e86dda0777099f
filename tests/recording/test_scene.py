"""The robot in a recording: what Foxglove's schemas say is where the legs are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.robot.description import Angles
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.service.recording.scene import BODY, WORLD, Scene
from adaptive_contact.wire import (
    SIM_BODY,
    BodyPose,
    ContactEvent,
    ServoSample,
    contact_key,
    servo_key,
)

ANGLES = {
    "hexapod": [0.3, -0.5, 1.1],
    "quadruped12": [0.2, 0.4, -0.9],
}


def sample(k: int, angles: list[float]) -> ServoSample:
    return ServoSample(t_ns=k, seq=k, measured=angles, desired=angles)


def event(leg: str, *, contact: bool, withheld: bool = False) -> ContactEvent:
    return ContactEvent(
        leg=leg, t_ns=1, seq=1, onset_ns=1, contact=contact, status="valid", score=1.0,
        residual=[0.0], model_version=1, withheld=withheld,
    )  # fmt: skip


def drawn(path: Path) -> dict[str, list[Any]]:
    factory = DecoderFactory()
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[factory])
        for schema, channel, message, content in reader.iter_decoded_messages():
            if schema is not None and schema.name.startswith("foxglove."):
                assert message.log_time == content_time(content)
                found.setdefault(schema.name, []).append(content)
                assert channel.topic.startswith("/")
    return found


def content_time(content: Any) -> int:
    stamp = content.timestamp if hasattr(content, "timestamp") else None
    if stamp is None:
        stamp = (getattr(content, "transforms", None) or content.entities)[0].timestamp
    return int(stamp.ToNanoseconds())


def turn(rotation: Any) -> np.ndarray:
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


def in_body(transforms: Any, frame: str, point: np.ndarray) -> np.ndarray:
    """A point of a frame in the body's, by the tree of transforms."""
    parents = {one.child_frame_id: one for one in transforms}
    while frame != BODY:
        one = parents[frame]
        frame, point = one.parent_frame_id, turn(one.rotation) @ point + xyz(one.translation)
    return point


@pytest.mark.parametrize("name", ANGLES)
def test_feet_are_where_the_kinematics_place_them(name: str, tmp_path: Path) -> None:
    robot = shipped_robot(name)
    angles = Angles(directions=(1, -1, 1), offsets_rad=(0.0, 0.2, 0.0))
    legs = (msgspec.structs.replace(robot.legs[0], angles=angles), *robot.legs[1:])
    robot = msgspec.structs.replace(robot, legs=legs)
    path = tmp_path / "a.mcap"
    wire = ANGLES[name]
    with RecordingWriter(path, scene=Scene(robot)) as writer:
        for leg in robot.legs:
            writer.write_message(servo_key(leg.id), sample(1, wire), 5)
    found = drawn(path)
    (states,), (transforms,), (scene,) = found.values()
    feet = {
        entity.frame_id.partition("/")[0]: entity for entity in scene.entities if entity.spheres
    }
    assert set(feet) == set(robot.leg_ids)
    for leg in robot.legs:
        q = [wire[0], 0.2 - wire[1], wire[2]] if leg is legs[0] else wire
        x, y, z = leg.chain.foot(q)
        cos, sin = np.cos(leg.mount.yaw_rad), np.sin(leg.mount.yaw_rad)
        expected = np.array([cos * x - sin * y, sin * x + cos * y, z]) + leg.mount.xyz_m
        foot = feet[leg.id]
        place = in_body(transforms.transforms, foot.frame_id, xyz(foot.spheres[0].pose.position))
        assert place == pytest.approx(expected, abs=1e-12)
    first = [state.position for state in states.joints[:3]]
    assert first == pytest.approx([wire[0], 0.2 - wire[1], wire[2]])
    assert len({state.name for state in states.joints}) == 3 * len(robot.legs)


def test_a_foot_is_red_while_it_touches(tmp_path: Path) -> None:
    robot = shipped_robot("hexapod")
    path = tmp_path / "a.mcap"

    def tick(writer: RecordingWriter, k: int, robot: Robot) -> None:
        for leg in robot.leg_ids:
            writer.write_message(servo_key(leg), sample(k, [0.0, 0.1, 0.2]), k)

    with RecordingWriter(path, scene=Scene(robot)) as writer:
        tick(writer, 1, robot)
        writer.write_message(contact_key("lf"), event("lf", contact=True), 1)
        tick(writer, 2, robot)
        tick(writer, 3, robot)
        writer.write_message(contact_key("lf"), event("lf", contact=False, withheld=True), 3)
        tick(writer, 4, robot)
        assert writer.messages == 4 * 6 + 2
    found = drawn(path)
    counts = {name: len(messages) for name, messages in found.items()}
    # The scene is written when it changes, the whole of it.
    assert counts == {
        "foxglove.JointStates": 4, "foxglove.FrameTransforms": 4, "foxglove.SceneUpdate": 3,
    }  # fmt: skip
    colours = [
        {
            entity.frame_id.partition("/")[0]: (sphere.color.r, sphere.color.g)
            for entity in scene.entities
            for sphere in entity.spheres
        }
        for scene in found["foxglove.SceneUpdate"]
    ]
    grey, red, amber = (0.7, 0.7), (0.9, 0.1), (0.95, 0.65)
    assert [of["lf"] for of in colours] == [grey, red, amber]
    assert {of["rf"] for of in colours} == {grey}
    # What is drawn is for viewers: a recording is read without it.
    assert {record.key.rpartition("/")[2] for record in read_recording(path)} == {
        "servo", "contact",
    }  # fmt: skip


def test_a_leg_that_is_silent_holds_nothing_up(tmp_path: Path) -> None:
    robot = shipped_robot("hexapod")
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, scene=Scene(robot)) as writer:
        for k in range(1, 4):
            for leg in robot.leg_ids[1:]:
                writer.write_message(servo_key(leg), sample(k, [0.0, 0.1, 0.2]), k)
        writer.write_message(servo_key("lf"), sample(4, [0.0]), 4)  # no sample of this leg
        writer.write_message(servo_key("lf"), sample(4, [0.0, float("nan"), 0.0]), 4)
    assert len(drawn(path)["foxglove.FrameTransforms"]) == 2


def test_the_body_is_in_the_world_once_something_says_where(tmp_path: Path) -> None:
    robot, angles = shipped_robot("hexapod"), ANGLES["hexapod"]
    places = [None, (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)]
    with RecordingWriter(tmp_path / "w.mcap", scene=Scene(robot)) as writer:
        for k, place in enumerate(places):
            if place is not None:
                pose = BodyPose(t_ns=k, position_m=place, quaternion_wxyz=(0.6, 0.0, 0.0, 0.8))
                writer.write_message(SIM_BODY, pose, k)
            for leg in robot.leg_ids:
                writer.write_message(servo_key(leg), sample(k, angles), k)
    for tick, place in zip(
        drawn(tmp_path / "w.mcap")["foxglove.FrameTransforms"], places, strict=True
    ):
        bodies = [one for one in tick.transforms if one.child_frame_id == BODY]
        assert len(bodies) == (place is not None)
        for body in bodies:
            assert body.parent_frame_id == WORLD
            assert tuple(xyz(body.translation)) == place
            assert turn(body.rotation)[:, 0] == pytest.approx([-0.28, 0.96, 0.0])
