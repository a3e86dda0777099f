"""Control tables as data: where each model keeps what the bridge reads and writes.

Addresses, sizes and model numbers: ROBOTIS e-manual, the page named with each table.  A model
not listed here is refused by name, never guessed.
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from adaptive_contact.errors import ConfigurationError

__all__ = [
    "BAUDS",
    "MODELS",
    "Block",
    "Register",
    "ServoModel",
    "model_of_number",
    "models_named",
]


class Register(NamedTuple):
    """A value in the control table.

    Attributes:
        address, size: bytes.
        eeprom: survives power-off, and wears out; written with ``--configure`` only.
        signed: two's complement.
    """

    address: int
    size: int
    eeprom: bool = False
    signed: bool = False


class Block(NamedTuple):
    """Neighbouring registers that are read in one go."""

    address: int
    size: int

    @property
    def longer(self) -> Block:
        """The same and a byte more: its answer cannot be taken for a late one to the shorter."""
        return Block(self.address, self.size + 1)

    def part(self, data: bytes, register: Register) -> int:
        """A register's value out of the block's bytes."""
        at = register.address - self.address
        return int.from_bytes(data[at : at + register.size], "little", signed=register.signed)


# e-manual AX-12A (AX-18A, AX-12W alike): "Control Table of EEPROM Area" and "of RAM Area".
_AX: Final = {
    "model_number": Register(0, 2, eeprom=True),
    "firmware": Register(2, 1, eeprom=True),
    "id": Register(3, 1, eeprom=True),
    "baud": Register(4, 1, eeprom=True),
    "return_delay": Register(5, 1, eeprom=True),  # 2 us each; 250 when new
    "lower_limit": Register(6, 2, eeprom=True),  # both limits 0: wheel mode
    "upper_limit": Register(8, 2, eeprom=True),
    "status_return": Register(16, 1, eeprom=True),
    "shutdown": Register(18, 1, eeprom=True),  # error bits that switch the drive off
    "torque_enable": Register(24, 1),
    "lower_margin": Register(26, 1),
    "upper_margin": Register(27, 1),
    "lower_slope": Register(28, 1),
    "upper_slope": Register(29, 1),
    "goal_position": Register(30, 2),
    "moving_speed": Register(32, 2),
    "torque_limit": Register(34, 2),
    "present_position": Register(36, 2),
    "present_speed": Register(38, 2),  # bit 10 is the sign
    "present_load": Register(40, 2),
    "voltage": Register(42, 1),
    "temperature": Register(43, 1),
    "moving": Register(46, 1),
    "lock": Register(47, 1),
    "punch": Register(48, 2),
}
# e-manual MX-28, MX-64 (protocol 1.0): the AX table with gains in the place of compliance.
_MX: Final = {
    **{
        name: register
        for name, register in _AX.items()
        if name not in ("lower_margin", "upper_margin", "lower_slope", "upper_slope")
    },
    "multi_turn_offset": Register(20, 2, eeprom=True, signed=True),  # multi-turn mode only
    "resolution_divider": Register(22, 1, eeprom=True),  # multi-turn mode only
    "position_d": Register(26, 1),
    "position_i": Register(27, 1),
    "position_p": Register(28, 1),
    # Multi-turn mode (both limits 4095): -28672 to 28672; joint mode: 0 to 4095.
    "goal_position": Register(30, 2, signed=True),
    "present_position": Register(36, 2, signed=True),
}
# e-manual MX-64 (protocol 1.0): the MX-28's, and a mode that follows torques.
_MX64: Final = {**_MX, "torque_control": Register(70, 1)}

# e-manual XL330-M288, XL430-W250, XM430-W350: the addresses used here are the same in all.
_X: Final = {
    "model_number": Register(0, 2, eeprom=True),
    "firmware": Register(6, 1, eeprom=True),
    "id": Register(7, 1, eeprom=True),
    "baud": Register(8, 1, eeprom=True),
    "return_delay": Register(9, 1, eeprom=True),  # 2 us each; 250 when new
    "drive_mode": Register(10, 1, eeprom=True),  # bits: see modes.py
    "operating_mode": Register(11, 1, eeprom=True),  # see modes.py
    "homing_offset": Register(20, 4, eeprom=True, signed=True),  # added to positions and goals
    "pwm_limit": Register(36, 2, eeprom=True),  # 885 is all of it
    "upper_limit": Register(48, 4, eeprom=True),
    "lower_limit": Register(52, 4, eeprom=True),
    "startup": Register(60, 1, eeprom=True),  # bit 0: torque comes on with the power
    "shutdown": Register(63, 1, eeprom=True),  # bits of hardware_error that switch the drive off
    "torque_enable": Register(64, 1),
    "status_return": Register(68, 1),
    "hardware_error": Register(70, 1),
    "position_d": Register(80, 2),
    "position_i": Register(82, 2),
    "position_p": Register(84, 2),
    "profile_acceleration": Register(108, 4),
    "profile_velocity": Register(112, 4),
    "goal_position": Register(116, 4, signed=True),
    "moving": Register(122, 1),
    "present_load": Register(126, 2, signed=True),
    "present_speed": Register(128, 4, signed=True),
    "present_position": Register(132, 4, signed=True),
    "voltage": Register(144, 2),
    "temperature": Register(146, 1),
}


@dataclass(frozen=True)
class ServoModel:
    """A kind of servo.

    Attributes:
        name: as ROBOTIS writes it.
        number: what the servo answers to a ping.
        protocol: 1 or 2.
        registers: its control table.
        lowest, highest, centre: position steps; ``centre`` is the middle of the horn's travel.
        step_rad: one position step.
        speed_rad_s: one step of present speed.
    """

    name: str
    number: int
    protocol: int
    registers: dict[str, Register]
    lowest: int
    highest: int
    centre: int
    step_rad: float
    speed_rad_s: float

    @property
    def motion(self) -> Block:
        """Present position and speed."""
        return self._block("present_speed", "present_position")

    @property
    def goal_and_motion(self) -> Block:
        """Goal position, present position and speed."""
        return self._block("goal_position", "present_speed", "present_position")

    @property
    def measured(self) -> Block:
        """What no two servos measure alike: position, voltage, temperature."""
        return self._block("present_position", "voltage", "temperature")

    @property
    def state(self) -> Block:
        """Whether it drives, and whether it has shut itself down."""
        if self.protocol == 1:
            return self._block("torque_enable", "torque_limit")
        return self._block("shutdown", "torque_enable", "hardware_error")

    @property
    def watched(self) -> Block:
        """What a driver reads in every tick: goal, position and speed.

        Protocol 1.0's includes :attr:`state`: a goal switches the torque of such a servo on, so
        that it may be written only where the same reading shows that the servo drives.
        """
        if self.protocol == 1:
            return self._block("torque_enable", "torque_limit", "present_position", "present_speed")
        return self.goal_and_motion

    @property
    def settings(self) -> tuple[Block, ...]:
        """What decides how goals are followed, in one block, or two."""
        if self.protocol == 2:
            return (self._block("drive_mode", "startup"),)
        if "resolution_divider" not in self.registers:
            return (self._block("lower_limit", "upper_limit"),)
        eeprom = self._block("lower_limit", "upper_limit", "resolution_divider")
        if "torque_control" not in self.registers:
            return (eeprom,)
        return (eeprom, self._block("torque_control"))

    def signed_speed(self, raw: int) -> float:
        """Present speed in rad/s; positive towards higher positions."""
        if self.registers["present_speed"].signed:
            return raw * self.speed_rad_s
        size = raw & 0x3FF  # e-manual AX-12A: 0-1023 counter-clockwise, 1024-2047 clockwise
        return (-size if raw & 0x400 else size) * self.speed_rad_s

    def _block(self, *names: str) -> Block:
        registers = [self.registers[name] for name in names]
        start = min(r.address for r in registers)
        return Block(start, max(r.address + r.size for r in registers) - start)


def _ax(name: str, number: int) -> ServoModel:
    # 300 degrees over 1023 steps; speed in 0.111 rpm.
    step, speed = math.radians(300.0) / 1023, 0.111 * 2 * math.pi / 60
    return ServoModel(name, number, 1, _AX, 0, 1023, 512, step, speed)


def _mx(name: str, number: int, registers: dict[str, Register]) -> ServoModel:
    # 4096 steps a turn; speed in 0.114 rpm.
    step, speed = 2 * math.pi / 4096, 0.114 * 2 * math.pi / 60
    return ServoModel(name, number, 1, registers, 0, 4095, 2048, step, speed)


def _x(name: str, number: int) -> ServoModel:
    # 4096 steps a turn; speed in 0.229 rpm.
    step, speed = 2 * math.pi / 4096, 0.229 * 2 * math.pi / 60
    return ServoModel(name, number, 2, _X, 0, 4095, 2048, step, speed)


MODELS: Final = (
    _ax("AX-12A", 12),
    _ax("AX-18A", 18),
    _ax("AX-12W", 300),
    _mx("MX-28", 29, _MX),
    _mx("MX-64", 310, _MX64),
    _x("XL330-M077", 1190),
    _x("XL330-M288", 1200),
    _x("XC330-T288", 1220),
    _x("XL430-W250", 1060),
    _x("XC430-W240", 1080),
    _x("XM430-W210", 1030),
    _x("XM430-W350", 1020),
)

# What DynamixelSDK 4.1.0 can set; AX-12A reach 1,000,000, X-series 4,000,000.
BAUDS: Final = (
    9600,
    19200,
    38400,
    57600,
    115200,
    230400,
    460800,
    500000,
    576000,
    921600,
    1000000,
    1152000,
    2000000,
    2500000,
    3000000,
    3500000,
    4000000,
)


def model_of_number(number: int) -> ServoModel | None:
    """The model that answers with this number, or None."""
    return next((m for m in MODELS if m.number == number), None)


def models_named(name: str) -> tuple[ServoModel, ...]:
    """Models that a name in ``robot.toml`` may mean: ``AX-12A``, or a family such as ``XL-330``.

    Raises:
        ConfigurationError: none is meant.
    """
    wanted = _plain(name)
    found = tuple(m for m in MODELS if _plain(m.name) == wanted) or tuple(
        m for m in MODELS if wanted and _plain(m.name).startswith(wanted) and len(wanted) >= 4
    )
    if found:
        return found
    near = difflib.get_close_matches(name, [m.name for m in MODELS], n=1)
    hint = f"did you mean '{near[0]}'?" if near else "see docs/bridge.md"
    known = ", ".join(m.name for m in MODELS)
    raise ConfigurationError(f"unknown servo model '{name}'; known are {known}; {hint}")


def _plain(name: str) -> str:
    return name.upper().replace("-", "").replace("_", "").replace(" ", "")
