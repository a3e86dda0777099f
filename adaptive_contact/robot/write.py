"""Writes a robot description as TOML, with comments on what is still to be filled in."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from adaptive_contact.robot.description import Leg, Port, Robot, ServoBus


def write_robot(robot: Robot) -> str:
    """Format a description as TOML; comments show what is still to be filled in."""
    say = _Commented()
    say.line("[robot]")
    say.line(f"name = {_text(robot.name)}")
    say.line(f"period_s = {robot.period_s:g}", "control tick; 0.02 is 50 Hz")
    if robot.steps_known:
        say.line(f"quantum_rad = {robot.quantum_rad:g}", "position step of the servos")
    say.line("")
    say.line("[servo]")
    say.line(
        f"slope_rad = {robot.servo.slope_rad:g}",
        "position error at which the servo drives with all it has",
    )
    for name, port in robot.ports.items():
        say.line("")
        # A bare name with a dot would be a table in a table.
        say.line(f"[port.{_text(name) if '.' in name else name}]")
        say.line(f"device = {_text(port.device)}")
        say.line(f"baud = {port.baud}")
        comment = '1: AX, RX and MX, 2: X-series; of Feetech "sts" or "scs"'
        say.line(f"protocol = {_text(port.protocol)}", comment)
        if port.fast:
            say.line("fast = true")
        if port.timeout_ms != Port(device="").timeout_ms:
            say.line(f"timeout_ms = {port.timeout_ms:g}")
        if port.ignore:
            say.line(f"ignore = {list(port.ignore)}", "servos that are no leg's: left alone")
    for i, leg in enumerate(robot.legs):
        _write_leg(say, leg, first=i == 0)
    return say.text


class _Commented:
    def __init__(self) -> None:
        self._lines: list[str] = []

    def line(self, text: str, comment: str | None = None) -> None:
        self._lines.append(text if comment is None else f"{text:<28} # {comment}")

    @property
    def text(self) -> str:
        return "\n".join(self._lines) + "\n"


def _write_leg(say: _Commented, leg: Leg, *, first: bool) -> None:
    say.line("")
    say.line("[[leg]]")
    say.line(f"id = {_text(leg.id)}")
    joints = ", ".join(_text(name) for name in leg.joints)
    say.line(f"joints = [{joints}]", "from the body outwards" if first else None)
    if leg.axes is not None:
        axes = ", ".join(
            _text(axis) if isinstance(axis, str) else _numbers(axis) for axis in leg.joint_axes
        )
        what = "yaw turns left and right, pitch up"
        if leg.origins_m is not None:
            what = "with all joints at 0; x ahead, y left, z up"
        say.line(f"axes = [{axes}]", what if first else None)
    if leg.lengths_m is not None:
        say.line(f"lengths_m = {_numbers(leg.lengths_m)}")
    elif leg.origins_m is not None:
        origins = ", ".join(_numbers(origin) for origin in leg.origins_m)
        say.line(
            f"origins_m = [{origins}]", "from joint to joint, and to the foot" if first else None
        )
    else:
        if first:
            say.line("# Measure the links, axis to axis and last axis to foot tip, and fill in, m:")
        say.line(f"# lengths_m = {_numbers([0.1] * len(leg.joints))}")
    if leg.quantum_rad is not None:
        say.line(f"quantum_rad = {leg.quantum_rad:g}")
    mount = leg.mount
    if any(mount.xyz_m) or mount.yaw_rad:
        say.line(f"mount = {{ xyz_m = {_numbers(mount.xyz_m)}, yaw_rad = {mount.yaw_rad:g} }}")
    if leg.limits is not None:
        lower, upper = _numbers(leg.limits.lower_rad), _numbers(leg.limits.upper_rad)
        say.line(f"limits = {{ lower_rad = {lower}, upper_rad = {upper} }}")
    elif first:
        say.line("# How far the bridge may ever drive the joints, rad:")
        most = len(leg.joints)
        say.line(f"# limits = {{ lower_rad = {[-1.0] * most}, upper_rad = {[1.0] * most} }}")
    if leg.angles is not None:
        parts = []
        if leg.angles.directions is not None:
            parts.append(f"directions = {list(leg.angles.directions)}")
        if leg.angles.offsets_rad is not None:
            parts.append(f"offsets_rad = {_numbers(leg.angles.offsets_rad)}")
        say.line(f"angles = {{ {', '.join(parts)} }}")
    servos = leg.servos
    if servos is None:
        return
    say.line("[leg.servos]")
    say.line(f"ids = {list(servos.ids)}")
    if isinstance(servos.model, str):
        say.line(f"model = {_text(servos.model)}")
    else:
        say.line(f"model = [{', '.join(map(_text, servos.model))}]")
    if servos.port is not None:
        say.line(f"port = {_text(servos.port)}")
    ones = [1] * len(leg.joints)
    directions = list(servos.directions) if servos.directions is not None else ones
    offsets = servos.offsets_rad if servos.offsets_rad is not None else [0.0] * len(leg.joints)
    say.line(f"directions = {directions}", "-1 where the angle grows the wrong way")
    say.line(f"offsets_rad = {_numbers(offsets)}", "joint angle with the horn in its centre")
    if servos.max_step_rad != ServoBus(ids=()).max_step_rad:
        say.line(f"max_step_rad = {servos.max_step_rad:g}")


def _numbers(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{float(x):.6g}" if x % 1 else f"{float(x):.1f}" for x in values) + "]"


def _text(value: str | int) -> str:
    return msgspec.json.encode(value).decode()
