"""What moves behind the virtual servos, and the faults of a bus."""

from __future__ import annotations

import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest
from kinematic import KinematicBackend

from adaptive_contact.bridge.plan import JointPlan, plan_ports
from adaptive_contact.bridge.tables import models_named
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import foot, shipped_robot
from adaptive_contact_sim.elements import HEXAPOD
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.virtual import (
    FaultSchedule,
    VirtualServo,
    parse_fault,
)
from adaptive_contact_sim.virtual.assembly import with_ports
from adaptive_contact_sim.virtual.backend import PassiveBackend, mounted
from adaptive_contact_sim.virtual.session import run
from quadruped import LEGS


def joints() -> tuple[JointPlan, ...]:
    return mounted(plan_ports(with_ports(shipped_robot(), Path("x"), None)), HEXAPOD.servos)


def test_registers_refuse_what_real_ones_refuse() -> None:
    backend = KinematicBackend(1)
    model = models_named("XL330-M288")[0]
    servo = VirtualServo(1, model, backend, 0, np.random.default_rng(1), noise_steps=0.0)
    registers = model.registers
    goal = registers["goal_position"]
    assert servo.write(registers["present_position"].address, bytes(4)) is not None  # read only
    assert servo.write(goal.address, (5000).to_bytes(4, "little")) is not None  # out of range
    assert servo.write(registers["torque_enable"].address, b"\x01") is None
    assert servo.write(registers["return_delay"].address, b"\x00") is not None  # EEPROM, driving
    assert servo.read(660, 20) is not None


def test_a_gentler_slope_lets_a_leg_sag_further() -> None:
    sag = []
    for slope in (32, 128):
        backend, now = PassiveBackend(joints()), 3.0
        servo = VirtualServo(
            2, models_named("AX-12A")[0], backend, 1, np.random.default_rng(1), noise_steps=0.0
        )  # a femur, that holds its leg out level
        registers = servo.model.registers
        servo.write(registers["lower_slope"].address, bytes((slope, slope)))
        servo.write(registers["goal_position"].address, (512).to_bytes(2, "little"))
        for _ in range(800):
            now += 0.001
            backend.advance(now)
        sag.append(abs(backend.angle(1)))
    assert sag[1] > 2 * sag[0]
    servo.reboot()
    assert backend.plant.servos.parameters.slope_steps[1] == pytest.approx(32)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("silent:id=3@5+2", {"kind": "silent", "servo": 3, "start_s": 5.0, "end_s": 7.0}),
        ("flip:p=0.25", {"kind": "flip", "probability": 0.25, "servo": None}),
        ("hangup@1", {"kind": "hangup", "start_s": 1.0, "end_s": 2.0}),
        ("error:bits=overload|overheating", {"bits": ("overload", "overheating")}),
    ],
)
def test_faults_are_read(text: str, expected: dict) -> None:
    spec = parse_fault(text)
    assert {name: getattr(spec, name) for name in expected} == expected


@pytest.mark.parametrize(
    "text", ["", "quiet", "silent:id=x", "silent@1.2.3", "flip:p=2", "error:bits=sad", "late:z=1"]
)
def test_faults_that_cannot_be_read(text: str) -> None:
    with pytest.raises(ConfigurationError, match="fault '"):
        parse_fault(text)


def test_faults_strike_when_and_whom_they_should() -> None:
    schedule = FaultSchedule([parse_fault("silent:id=3@5+2")], np.random.default_rng(1))
    assert schedule.strike("silent", 3, 4.9) is None
    assert schedule.strike("silent", 4, 6.0) is None
    assert schedule.strike("silent", 3, 6.0) is not None
    assert schedule.strike("silent", 3, 7.0) is None


def test_the_quadrupeds_description_fits_its_model() -> None:
    robot = shipped_robot("quadruped")
    rng = np.random.default_rng(3)
    model = mujoco.MjModel.from_xml_string(robot_xml("quadruped"))
    for _ in range(5):
        angles, data = rng.uniform(-1.0, 0.2, 8), mujoco.MjData(model)
        for i, leg in enumerate(LEGS):
            data.joint(f"{leg}_hip").qpos, data.joint(f"{leg}_knee").qpos = angles[
                2 * i : 2 * i + 2
            ]
        mujoco.mj_forward(model, data)
        for i, leg in enumerate(robot.legs):
            point = foot(angles[2 * i : 2 * i + 2], leg.lengths_m, leg.joint_axes)
            turn = np.cos(leg.mount.yaw_rad)
            out = np.array([turn * point[0], turn * point[1], point[2] + 0.3])
            world = np.array(leg.mount.xyz_m) + out
            assert data.site(f"{leg.id}_foot").xpos == pytest.approx(world, abs=1e-6)


def test_two_buses_do_not_share_a_folder(tmp_path: Path) -> None:
    robot = shipped_robot()

    def second(_: str) -> None:
        with pytest.raises(ConfigurationError, match="in use by another virtual bus; give another"):
            run(robot, tmp_path, threading.Event())

    ended = threading.Event()
    ended.set()
    for _ in range(2):  # a folder is free again when its bus has ended
        run(robot, tmp_path, ended, on_start=second)
    assert not (tmp_path / "port0").is_symlink()
