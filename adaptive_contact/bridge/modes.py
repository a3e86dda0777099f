r"""Reads from registers how a servo follows goals: modes, limits, offsets, position gain.

Which modes are driven, observed or refused, and why: docs/bridge.md, "Modes and limits".  A servo
of protocol 1.0, an XL-320 or a Feetech servo is judged by its limits, any other by its operating
mode.

Sources: ROBOTIS e-manual, XL-320 "Control Mode(11)"; MX-106 "Drive Mode(10)"; MX-64
"CW/CCW Angle Limit(6, 8)", "Resolution Divider (22)", "Torque
Control Mode Enable (70)"; XM430-W350 "Drive Mode(10)", "Operating Mode(11)", "Secondary(Shadow)
ID(12)", "Homing Offset(20)", "Min/Max Position Limit(48, 52)", "Torque Enable(64)", "Present
Position(132)"; ROBOTIS forum 7814 (the turn that is lost as torque comes on).

The position gain is read as the error at which a servo drives with all it has, rad,
``servo.slope_rad`` in ``robot.toml``:

- AX: the compliance slope :math:`s` is that error in steps, beside the margin and the punch.
- MX, protocol 1.0: a P gain has taken its place; the manual gives pairs of the two (slope 8 and
  gain 128, 32 and 32, 128 and 8), so :math:`s = 1024 / P` in an AX servo's steps.
- X-series: the PWM is :math:`P/128` per step of error and ends at the PWM limit :math:`w` (885), so
  :math:`s = 128\,w / P` of its steps.
- STS: the duty cycle is :math:`0.166\,P` per rad of error, so :math:`s = 1 / (0.166\,P)`; measured
  with an oscilloscope (``bam/feetech/actuator.py`` of github Rhoban/bam, commit 060af88e).  Of the
  SCS series it is unknown.

Sources: ROBOTIS e-manual, AX-12A "Compliance Slope (28, 29)", MX-28 "P Gain", XM430-W210 "Position
PID Gain(80, 82, 84)" and "PWM Limit(36)".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.tables import ServoModel, tool_of

_MODES: Final = {
    0: "current",
    1: "velocity",
    3: "position",
    4: "extended position",
    5: "current-based position",
    16: "PWM",
}
_POSITION: Final = 3
_MULTI_TURN: Final = (4, 5)
_WIZARD: Final = "with DYNAMIXEL Wizard"


class DriveMode:
    """Names bits of the register Drive Mode (10)."""

    REVERSE = 0x01
    SLAVE = 0x02
    TIME_BASED = 0x04
    TORQUE_BY_GOAL = 0x08


class Setting(NamedTuple):
    """Describes how a servo is set."""

    # lowest, highest: goals that it takes and that are of its one turn, steps
    lowest: int
    highest: int
    values: dict[str, int]  # registers by name; a servo in which they change is not the one it was
    # why its goals say nothing of its movements, and what to do; None where they do
    wrong: str | None = None
    # why it is not driven although it may be observed; None where it may be
    undriven: str | None = None
    advice: str | None = None  # what to set differently; None without
    # positions at which its encoder ends, or begins its turn again, None where it counts on.  An AX
    # servo says one of them for all of the 60 degrees that it cannot see; the others may say either
    # of them for one place.
    ends: tuple[int, int] | None = None


def followed(bus: Bus, servo: int, model: ServoModel | None) -> int | None:
    """Return the servo whose goals another one takes as well, by its secondary id; else None."""
    register = None if model is None else model.registers.get("secondary_id")
    second = None if register is None else bus.get(servo, register)
    return second if second is not None and second <= MAX_ID and second != servo else None


def setting(model: ServoModel, data: Sequence[bytes]) -> Setting:
    """Judge a servo's registers."""
    # Gains may be changed while a servo drives, wherever they are kept.
    values = {
        name: block.part(part, register)
        for block, part in zip(model.settings, data, strict=True)
        for name, register in model.registers.items()
        if block.holds(register) and name not in ("position_p", "position_i", "position_d")
    }
    return _by_limits(model, values) if model.compact else _by_mode(model, values)


def _by_limits(model: ServoModel, values: dict[str, int]) -> Setting:
    lower, upper = values["lower_limit"], values["upper_limit"]
    tool = f"with {tool_of(model.protocol)}"
    usual = f"{model.lowest} and {model.highest}, {tool}"
    # Of an STS servo's phase: positions are not those of one turn.
    ends = None if values.get("phase", 0) & 0x10 else (model.lowest, model.highest)
    full = Setting(model.lowest, model.highest, values, ends=ends)
    if values.get("torque_control"):
        return full._replace(
            wrong="is in torque control mode (register 70 is 1), expected 0: it ignores goal "
            "positions; write 0 to that register, or switch its power off and on"
        )
    if values.get("control_mode") != model.joint_mode:
        return full._replace(
            wrong=f"does not follow goal positions (its control mode is {values['control_mode']}), "
            f"expected {model.joint_mode}; set it {tool}"
        )
    if values.get("drive_mode", 0) & DriveMode.SLAVE:
        return full._replace(wrong=_slave(values["drive_mode"]))
    divider, multi_turn = values.get("resolution_divider", 1), lower == upper == model.multi_turn
    if divider != 1 and (multi_turn or model.feetech):
        return full._replace(
            wrong=f"has a resolution divider of {divider}, expected 1; set that {tool}"
        )
    if lower == upper == 0 and not multi_turn:
        return full._replace(
            wrong=f"is in wheel mode (both angle limits are 0); set limits, such as {usual}"
        )
    if multi_turn:
        return full._replace(
            ends=None,
            advice=f"is in multi-turn mode (both angle limits are {lower}) and forgets its turns "
            f"with its power; joint mode is meant for legs: set limits, such as {usual}",
        )
    if lower >= upper:
        return full._replace(
            wrong=f"has angle limits {lower} and {upper}, between which there is no travel; set "
            f"limits, such as {usual}"
        )
    return full._replace(lowest=max(lower, model.lowest), highest=min(upper, model.highest))


def _by_mode(model: ServoModel, values: dict[str, int]) -> Setting:
    mode, drive = values["operating_mode"], values["drive_mode"]
    full = Setting(model.lowest, model.highest, values)
    if drive & DriveMode.TORQUE_BY_GOAL:
        full = full._replace(
            undriven=f"has drive mode {drive} (torque on by goal update), expected that bit (8) "
            f"clear: a goal written to it while it is limp would switch it on; clear it {_WIZARD}"
        )
    second = values["secondary_id"]
    if second <= MAX_ID:
        why = (
            f"has secondary id {second}, expected 255 (none): it would follow what is "
            f"written to servo {second} as well; set it {_WIZARD}"
        )
        full = full._replace(undriven=why, advice=why)
    if mode != _POSITION and mode not in _MULTI_TURN:
        name = _MODES.get(mode, "unknown")
        return full._replace(
            wrong=f"is in operating mode {mode} ({name}), expected {_POSITION} (position); set it "
            f"{_WIZARD}"
        )
    if drive & DriveMode.SLAVE:
        return full._replace(wrong=_slave(drive))
    if mode in _MULTI_TURN:
        return full
    lower, upper = values["lower_limit"], values["upper_limit"]
    homing = values["homing_offset"]
    if abs(homing) > 1024:  # ignored in position mode
        homing = 0
    lowest = max(lower, model.lowest, model.lowest + homing)
    highest = min(upper, model.highest, model.highest + homing)
    if lowest >= highest:
        return full._replace(
            wrong=f"has position limits {lower} and {upper} and a homing offset of {homing}, "
            f"between which there is no travel; set limits, such as {model.lowest} and "
            f"{model.highest}, {_WIZARD}"
        )
    ends = model.lowest + homing, model.highest + homing
    return full._replace(lowest=lowest, highest=highest, ends=ends)


def _slave(drive: int) -> str:
    return (
        f"has drive mode {drive} (slave: it follows another servo's cable), expected that bit (2) "
        f"clear; clear it {_WIZARD}"
    )


# What a description may hold.
_RANGE_RAD: Final = (1e-3, math.pi)

# Registers of each kind of controller; a model has those of one.
LAW_REGISTERS: Final = (
    ("lower_slope", "upper_slope"),
    ("position_p", "pwm_limit"),
    ("position_p",),
)


def read_slope(bus: Bus, servo: int, model: ServoModel) -> float | None:
    """Read the slope of a servo on a bus, rad; None where it does not report it.

    Raises:
        PortLostError: the port is gone.
    """
    names = next(names for names in LAW_REGISTERS if set(names) <= set(model.registers))
    values = {name: bus.get(servo, model.registers[name]) for name in names}
    known = {name: value for name, value in values.items() if value is not None}
    return slope_rad(model, known) if len(known) == len(values) else None


def slope_rad(model: ServoModel, values: dict[str, int]) -> float | None:
    """Compute the slope, rad, from a model's :data:`LAW_REGISTERS`; None where its gain is 0.

    The factors are those of the module's text.
    """
    if "lower_slope" in values:
        slope = (values["lower_slope"] + values["upper_slope"]) / 2 * model.step_rad
    elif not values["position_p"]:
        return None
    elif model.feetech:
        if model.protocol == "scs":
            return None
        slope = 1.0 / (0.166 * values["position_p"])
    elif "pwm_limit" in values:
        slope = 128.0 * values["pwm_limit"] / values["position_p"] * model.step_rad
    else:
        ax_step_rad = math.radians(300.0) / 1023
        slope = 1024.0 / values["position_p"] * ax_step_rad
    return min(max(slope, _RANGE_RAD[0]), _RANGE_RAD[1])
