"""Commands of this program run in this process, and descriptions of robots on virtual buses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from adaptive_contact.robot import Robot, load_robot, parse_robot
from adaptive_contact.robot.write import write_robot
from adaptive_contact_sim.virtual import VirtualServo
from programs import invoke

# Servos of a rig, one of each way to speak.
AX = {"model": "AX-12A", "protocol": 1}
XL = {"model": "XL330-M288", "protocol": 2}
STS = {"model": "STS3215", "protocol": "sts"}
SCS = {"model": "SCS0009", "protocol": "scs"}

# Serves the servos of SPECs (see ``anybus``) on a port: its device, and they.
Serve = Callable[..., tuple[Path, Sequence[VirtualServo]]]


def init(device: Path, *words: str) -> tuple[str, Robot]:
    out = device.parent / "robot.toml"
    said = invoke("robot", "init", "--device", device, "--out", out, "--force", *words)
    return said, load_robot(out)


def robot(
    device: Path,
    *legs: tuple[Sequence[int], object],
    name: str = "main",
    limit_rad: float | None = None,
    **port: object,
) -> Robot:
    """A description of legs with these ids and models; its bus waits, as this computer is busy."""
    port = {"timeout_ms": 30, **port}
    settings = "".join(f"{key} = {_toml(value)}\n" for key, value in port.items())
    text = (
        '[robot]\nname = "t"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
        f'[port.{name}]\ndevice = "{device}"\n{settings}'
    )
    for i, (ids, model) in enumerate(legs):
        joints = [f"j{j}" for j in range(len(ids))]
        text += f'[[leg]]\nid = "l{i}"\njoints = {_toml(joints)}\n[leg.servos]\n'
        text += f"ids = {list(ids)}\nmodel = {_toml(model)}\n"
        if limit_rad is not None:
            ends = [[end] * len(ids) for end in (-limit_rad, limit_rad)]
            text += f"[leg.limits]\nlower_rad = {ends[0]}\nupper_rad = {ends[1]}\n"
    return parse_robot(text, source="t")


def _toml(value: object) -> str:
    return msgspec.json.encode(value).decode()


def write(path: Path, described: Robot) -> Path:
    path.write_text(write_robot(described), encoding="utf-8")
    return path


def goals_written(servo: VirtualServo) -> list[int]:
    """Goals that are written to a servo from now on."""
    goals, write, register = list[int](), servo.write, servo.model.registers["goal_position"]

    def spy(address: int, data: bytes) -> Any:
        if address == register.address:
            goals.append(register.value(data))
        return write(address, data)

    servo.write = spy  # type: ignore[method-assign]
    return goals
