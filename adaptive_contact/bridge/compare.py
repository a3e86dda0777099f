"""Compares servos' registers: what differs among servos of a model, what shapes their motion.

A leg's model is learned from its motion, and its slope is one number for the whole robot.  A servo
that is set differently from the others is often one that was replaced; a limit on speed or
acceleration makes a servo follow its goals along a way of its own, which the model has to learn.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
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
# Those that limit how goals are followed, and of which 0 limits nothing.
_LIMITS: Final = (
    *("moving_speed", "goal_acceleration", "acceleration"),
    *("profile_velocity", "profile_acceleration"),
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
            if register not in _LIMITS:
                lines += _differing(name, register, [s for s in group if register in s.values])
    for register in _LIMITS:
        by_value: dict[int, list[Servo]] = {}
        for servo in servos:
            if servo.values.get(register):
                by_value.setdefault(servo.values[register], []).append(servo)
        lines += [
            f"{_title(register)} of {_who(some, servos)} is {value}: it limits how goals are "
            "followed; 0 sets no limit"
            for value, some in by_value.items()
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
