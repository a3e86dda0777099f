"""Writes a robot description as TOML, with comments on what is still to be filled in."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

import msgspec

from adaptive_contact.robot.description import Robot

# What stands beside a key, where it is written first.
_COMMENTS: Final = {
    "period_s": "control tick; 0.02 is 50 Hz",
    "quantum_rad": "position step of the servos",
    "slope_rad": "position error at which the servo drives with all it has",
    "protocol": '1: AX, RX and MX, 2: X-series; of Feetech "sts" or "scs"',
    "ignore": "servos that are no leg's: left alone",
    "joints": "from the body outwards",
    "axes": "yaw turns left and right, pitch up; vectors: x ahead, y left, z up",
    "origins_m": "with all joints at 0, from joint to joint, and to the foot",
    "directions": "-1 where the angle grows the wrong way",
    "offsets_rad": "joint angle with the horn in its centre",
}


def write_robot(robot: Robot) -> str:
    """Format a description as TOML; what has its default is left out."""
    head = {"name": robot.name, "period_s": robot.period_s}
    if robot.steps_known:
        head["quantum_rad"] = robot.quantum_rad
    tables = {"[robot]": head, "[servo]": _given(robot.servo, ("slope_rad",))}
    if detector := _given(robot.detector):
        tables["[detector]"] = detector
    for name, port in robot.ports.items():
        # A bare name with a dot would be a table in a table.
        key = f"[port.{_toml(name) if '.' in name else name}]"
        tables[key] = _given(port, ("baud", "protocol"))
    if robot.ros2 is not None:
        tables["[ros2]"] = _given(robot.ros2)
    comments = dict(_COMMENTS)
    text = [_table(name, table, comments) for name, table in tables.items()]
    for leg in robot.legs:
        table, servos, joints = _given(leg), leg.servos, len(leg.joints)
        table.pop("servos", None)
        text.append(_table("[[leg]]", table, comments))
        if leg.chain is None:
            if leg is robot.legs[0]:
                text[-1] += (
                    "# Measure the links, axis to axis and last axis to foot tip, and fill in, m:\n"
                )
            text[-1] += f"# lengths_m = {[0.1] * joints}\n"
        if leg.limits is None and leg is robot.legs[0]:
            text[-1] += (
                "# How far the bridge may ever drive the joints, rad:\n"
                f"# limits = {{ lower_rad = {[-1.0] * joints}, upper_rad = {[1.0] * joints} }}\n"
            )
        if servos is not None:
            filled = msgspec.structs.replace(
                servos,
                directions=servos.directions or (1,) * joints,
                offsets_rad=servos.offsets_rad or (0.0,) * joints,
            )
            text[-1] += _table("[leg.servos]", _given(filled, ("model",)), comments)
    return "\n".join(text)


def _given(struct: msgspec.Struct, always: Collection[str] = ()) -> dict[str, Any]:
    """Return the fields that differ from their defaults, and those that are always written."""
    values = {field.name: (getattr(struct, field.name), field.default)
              for field in msgspec.structs.fields(struct)}  # fmt: skip
    return {
        name: value
        for name, (value, default) in values.items()
        if name in always or value != default
    }


def _table(name: str, table: Mapping[str, Any], comments: dict[str, str]) -> str:
    lines = [name]
    for key, value in table.items():
        line = f"{key} = {_toml(value)}"
        comment = comments.pop(key, None)
        if comment is not None:
            line = f"{line:<28} # {comment}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, msgspec.Struct):
        return f"{{ {', '.join(f'{key} = {_toml(x)}' for key, x in _given(value).items())} }}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return f"{value:.6g}" if value % 1 else f"{value:.1f}"
    return msgspec.json.encode(value).decode()
