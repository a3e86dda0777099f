"""Compares servos' registers: what differs among servos of a model, what shapes their motion.

A leg's model is learned from its motion, and its slope is one number for the whole robot.  A servo
that is set differently from the others is often one that was replaced; a limit on speed or
acceleration makes a servo follow its goals along a way of its own, which the model has to learn.

Units: ROBOTIS e-manual, XM430-W350 "Profile Acceleration(108)", "Profile Velocity(112)".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.modes import DriveMode
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.tables import ServoModel

COMPARED: Final = (
    "moving_speed",
    "goal_time",
    "goal_acceleration",
    "acceleration",
    "max_acceleration",
    "profile_velocity",
    "profile_acceleration",
    "phase",
    "drive_mode",
    "operating_mode",
    "control_mode",
    "position_p",
    "position_i",
    "position_d",
    "lower_slope",
    "upper_slope",
    "lower_margin",
    "upper_margin",
    "punch",
    "torque_limit",
    "pwm_limit",
    "return_delay",
)
# Lower and upper are clockwise and counter-clockwise in the manual.
_NAMES: Final = {
    "position_p": "P gain",
    "position_i": "I gain",
    "position_d": "D gain",
    "lower_slope": "CW compliance slope",
    "upper_slope": "CCW compliance slope",
    "lower_margin": "CW compliance margin",
    "upper_margin": "CCW compliance margin",
    "pwm_limit": "PWM limit",
}


class Servo(NamedTuple):
    """Holds a servo's registers."""

    id: int  # on its port
    where: str  # leg and joint
    model: ServoModel  # what it is
    values: Mapping[str, int]  # registers by name, those that it has and reports
    port: str = ""  # its name, where the robot has several


def read_servos(plans: Sequence[PortPlan]) -> list[Servo]:
    """Read what :func:`compare` compares, twice alike; writes nothing.

    Raises:
        BusError: a port cannot be opened, or is gone.
    """
    servos = []
    for plan in plans:
        bus = Bus(plan.name, plan.port)
        bus.open()
        try:
            for leg in plan.legs:
                for joint in leg.joints:
                    values = {}
                    for name in COMPARED:
                        register = joint.model.registers.get(name)
                        if register and (data := bus.confirmed(joint.servo, register.block)):
                            values[name] = register.value(data)
                    port = plan.name if len(plans) > 1 else ""
                    where = f"{leg.id} {joint.name}"
                    servos.append(Servo(joint.servo, where, joint.model, values, port))
        finally:
            bus.close()
    return servos


def compare(servos: Sequence[Servo]) -> list[str]:
    """Describe what differs among servos of a model, and what shapes their motion, line by line."""
    by_model: dict[str, list[Servo]] = {}
    for servo in servos:
        by_model.setdefault(servo.model.name, []).append(servo)
    lines = []
    for name, group in by_model.items():
        for register in COMPARED:
            if register not in _SHAPES:
                lines += _differing(name, register, [s for s in group if register in s.values])
    for register, shapes in _SHAPES.items():
        by_line: dict[str, list[Servo]] = {}
        for servo in servos:
            # 0 limits nothing; a torque limit of 0 is a servo's that has shut itself down.
            line = shapes(servo, register) if servo.values.get(register) else None
            if line is not None:
                by_line.setdefault(line, []).append(servo)
        lines += [
            f"{_title(register)} of {_who(some, servos)} {line}" for line, some in by_line.items()
        ]
    return lines


# -- private -----------------------------------------------------------------------------------


def _differing(model: str, register: str, group: Sequence[Servo]) -> list[str]:
    counts = Counter(servo.values[register] for servo in group)
    if len(counts) < 2:
        return []
    [(usual, most), *others] = counts.most_common()
    rest = "; ".join(
        f"{value} in {_who([s for s in group if s.values[register] == value], group)}"
        for value, _ in others
    )
    hint = ""
    if register == "drive_mode" and not any(value & ~DriveMode.REVERSE for value in counts):
        hint = " (1 is reverse mode; directions in robot.toml are on top of it)"
    return [f"{_title(register)} differs among {model}: {usual} in {most} servos, {rest}{hint}"]


def _title(register: str) -> str:
    return _NAMES.get(register, register.replace("_", " "))


def _who(some: Sequence[Servo], of: Sequence[Servo]) -> str:
    if len(some) == len(of):
        return f"all {len(of)} servos" if len(of) > 1 else f"servo {of[0].id} ({of[0].where})"
    names = ", ".join(f"{s.port}{':' if s.port else ''}{s.id} ({s.where})" for s in some)
    return f"servo {names}"


def _speed(servo: Servo, register: str) -> str:
    value = servo.values[register]
    if register == "profile_velocity" and _time_based(servo):
        return f"is {value} ms: goals are reached so much later; 0 sets no limit"
    rad_s = value * servo.model.speed_rad_s
    return f"is {value}: goals are followed at {rad_s:.2g} rad/s at the most; 0 sets no limit"


def _acceleration(servo: Servo, register: str) -> str:
    value = servo.values[register]
    if register == "profile_acceleration" and _time_based(servo):
        return f"is {value} ms: so long a servo gathers speed for each goal; 0 sets no limit"
    # 214.577 rev/min², in rad/s².
    unit = 214.577 * 2 * math.pi / 3600
    if register == "acceleration":
        unit = 100 * servo.model.step_rad
    most = "" if register == "goal_acceleration" else f" ({value * unit:.3g} rad/s²)"
    return f"is {value}: goals are followed with a limited acceleration{most}; 0 sets no limit"


def _weaker(servo: Servo, register: str) -> str | None:
    # All of it, as the servo's own unit has it: e-manual AX-12A "Torque Limit(34)", XM430-W350 "PWM
    # Limit(36)".
    value, full = servo.values[register], {"torque_limit": 1023, "pwm_limit": 885}[register]
    if servo.model.feetech:
        full = 1000
    if value >= full:
        return None
    return f"is {value} of {full}: it drives with {100 * value / full:.0f} % of what it has"


def _time_based(servo: Servo) -> bool:
    return bool(servo.values.get("drive_mode", 0) & DriveMode.TIME_BASED)


# What a register says of a servo's motion; None where it is as it leaves a servo free.
_SHAPES: Final[Mapping[str, Callable[[Servo, str], str | None]]] = {
    "moving_speed": _speed,
    "goal_acceleration": _acceleration,
    "acceleration": _acceleration,
    "profile_velocity": _speed,
    "profile_acceleration": _acceleration,
    "torque_limit": _weaker,
    "pwm_limit": _weaker,
}
