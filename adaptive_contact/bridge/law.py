r"""How steep a servo's position controller is, read off its registers.

The position error at which it drives with all it has, rad, ``servo.slope_rad`` in ``robot.toml``:

- AX: the compliance slope :math:`s` is that error in steps, beside the margin and the punch.
- MX, protocol 1.0: a P gain has taken its place; the manual gives pairs of the two (slope 8 and
  gain 128, 32 and 32, 128 and 8), so :math:`s = 1024 / P` in an AX servo's steps.
- X-series: the PWM is :math:`P/128` per step of error and ends at the PWM limit :math:`w` (885), so
  :math:`s = 128\,w / P` of its steps.

Sources: ROBOTIS e-manual, AX-12A "Compliance Slope (28, 29)", MX-28 "P Gain", XM430-W210 "Position
PID Gain(80, 82, 84)" and "PWM Limit(36)".
"""

from __future__ import annotations

import math
from typing import Final

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.tables import ServoModel

__all__ = ["LAW_REGISTERS", "read_slope", "slope_rad"]

_AX_STEP_RAD: Final = math.radians(300.0) / 1023
_SLOPE_TIMES_GAIN: Final = 1024.0
_PWM_PER_GAIN: Final = 128.0
# What a description may hold.
_RANGE_RAD: Final = (1e-3, math.pi)

# Registers of each kind of controller; a model has those of one.
LAW_REGISTERS: Final = (
    ("lower_slope", "upper_slope"),
    ("position_p", "pwm_limit"),
    ("position_p",),
)


def read_slope(bus: Bus, servo: int, model: ServoModel) -> float | None:
    """Slope of a servo on a bus, rad; None where it does not tell.

    Raises:
        PortLostError: the port is gone.
    """
    names = next(names for names in LAW_REGISTERS if set(names) <= set(model.registers))
    values = {name: bus.get(servo, model.registers[name]) for name in names}
    known = {name: value for name, value in values.items() if value is not None}
    return slope_rad(model, known) if len(known) == len(values) else None


def slope_rad(model: ServoModel, values: dict[str, int]) -> float | None:
    """Slope, rad, of a model's registers; None where its gain is 0.

    Args:
        model: the kind of servo.
        values: of the registers in :data:`LAW_REGISTERS` that it has.
    """
    if "lower_slope" in values:
        slope = (values["lower_slope"] + values["upper_slope"]) / 2 * model.step_rad
    elif not values["position_p"]:
        return None
    elif "pwm_limit" in values:
        slope = _PWM_PER_GAIN * values["pwm_limit"] / values["position_p"] * model.step_rad
    else:
        slope = _SLOPE_TIMES_GAIN / values["position_p"] * _AX_STEP_RAD
    return min(max(slope, _RANGE_RAD[0]), _RANGE_RAD[1])
