"""What a servo does before it gets a goal of ours: held somewhere, let go, or shut down.

A servo that has torque stands where its goal register says, or a little below that under its load;
taking its position for the start would let it sink, or move it.  Only without torque does the
position say where to begin.

An alarm that the servo's shutdown register names switches its drive off for good.  An AX or MX
servo sets its torque limit to 0, and drives again as soon as that is written; an X-series one
switches its torque off and stays so until a reboot.

Source: ROBOTIS e-manual, AX-12A "Shutdown (18)" and XL330-M288 "Shutdown (63)".
"""

from __future__ import annotations

from typing import NamedTuple

from adaptive_contact.bridge.protocol2 import HARDWARE_ERROR_BITS
from adaptive_contact.bridge.tables import ServoModel

__all__ = ["Standing", "remedy", "standing"]


class Standing(NamedTuple):
    """How a servo stands.

    Attributes:
        torque: it drives to its goal.
        goal: in force where there is torque, steps.
        shut: it has shut itself down.
        alarms: names of what is behind the alert of protocol 2.0.
    """

    torque: bool
    goal: int
    shut: bool
    alarms: tuple[str, ...] = ()


def standing(model: ServoModel, data: bytes) -> Standing:
    """How a servo stands, from the bytes of :attr:`.ServoModel.state`."""

    def value(name: str) -> int:
        return model.state.part(data, model.registers[name])

    torque, goal = value("torque_enable") != 0, value("goal_position")
    if model.protocol == 1:
        limit = value("torque_limit")
        return Standing(torque and limit > 0, goal, limit == 0)
    errors = value("hardware_error")
    alarms = tuple(name for bit, name in HARDWARE_ERROR_BITS.items() if errors & bit)
    return Standing(torque, goal, not torque and bool(errors & value("shutdown")), alarms)


def remedy(model: ServoModel) -> str:
    """What to do for a servo that has shut itself down."""
    if model.protocol == 1:
        limit = model.registers["torque_limit"].address
        return (
            "shut down, its torque limit is 0; take the load off it, let it cool, then switch its "
            f"power off and on, or write 1023 to its torque limit ({limit})"
        )
    return (
        "shut down, its torque is off until a reboot; take the load off it, let it cool, then "
        "reboot it with DYNAMIXEL Wizard, or switch its power off and on"
    )
