"""Control tables as data: where each model keeps what the bridge reads and writes.

Addresses, sizes, units and model numbers were compared, register by register, with

- the ROBOTIS e-manual: each model's page is its :attr:`ServoModel.manual`;
- ``param/dxl_model/*.model`` of github ROBOTIS-GIT/dynamixel_hardware_interface, commit db2b9038,
  for protocol 2.0 (XL330, XC330: the ``_fw52`` files; ``startup`` is in none of them);
- ``dynamixel_item.cpp`` of github ROBOTIS-GIT/dynamixel-workbench, commit 2eb370f1.

A test holds them to these.  Where they differ the e-manual's counts: the workbench has XL-320's
torque limit at 34, the other two have it at 35.  A model not listed here is refused by name, never
guessed.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from adaptive_contact.errors import ConfigurationError

__all__ = [
    "BAUDS",
    "FEETECH_MARK",
    "MODELS",
    "Block",
    "Register",
    "ServoModel",
    "feetech_name",
    "model_of_number",
    "models_named",
    "number_name",
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

    @property
    def block(self) -> Block:
        """Where it is, to be read alone."""
        return Block(self.address, self.size)

    def value(self, data: bytes) -> int:
        """Its value, out of the bytes of its own block."""
        return int.from_bytes(data, "little", signed=self.signed)


class Block(NamedTuple):
    """Neighbouring registers that are read in one go."""

    address: int
    size: int

    @property
    def longer(self) -> Block:
        """The same and a byte more: its answer cannot be taken for a late one to the shorter."""
        return Block(self.address, self.size + 1)

    @property
    def wider(self) -> Block:
        """The same and a byte more, before it: some tables end with a register that is read."""
        return Block(self.address - 1, self.size + 1) if self.address else self.longer

    def holds(self, register: Register) -> bool:
        """Whether all of a register is in it."""
        ends = register.address + register.size, self.address + self.size
        return self.address <= register.address and ends[0] <= ends[1]

    def part(self, data: bytes, register: Register) -> int:
        """A register's value out of the block's bytes."""
        at = register.address - self.address
        return register.value(data[at : at + register.size])


# e-manual AX-12A (AX-18A, AX-12W, RX-28, RX-64 alike): "Control Table of EEPROM Area" and "of RAM
# Area".
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
# e-manual MX-28 (protocol 1.0): the AX table with gains in the place of compliance.
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
    "goal_acceleration": Register(73, 1),
}
# e-manual MX-64 (protocol 1.0): the MX-28's, and a mode that follows torques.
_MX64: Final = {**_MX, "torque_control": Register(70, 1)}
# e-manual MX-106 (protocol 1.0): the MX-64's, and two servos as one joint ("Drive Mode(10)").
_MX106: Final = {**_MX64, "drive_mode": Register(10, 1, eeprom=True)}

# e-manual XL-320: protocol 2.0, with a table like an AX servo's, each its own addresses.
_XL320: Final = {
    "model_number": Register(0, 2, eeprom=True),
    "firmware": Register(2, 1, eeprom=True),
    "id": Register(3, 1, eeprom=True),
    "baud": Register(4, 1, eeprom=True),
    "return_delay": Register(5, 1, eeprom=True),
    "lower_limit": Register(6, 2, eeprom=True),
    "upper_limit": Register(8, 2, eeprom=True),
    "control_mode": Register(11, 1, eeprom=True),  # 1: wheel, 2: joint
    "status_return": Register(17, 1, eeprom=True),
    "shutdown": Register(18, 1, eeprom=True),
    "torque_enable": Register(24, 1),
    "position_d": Register(27, 1),
    "position_i": Register(28, 1),
    "position_p": Register(29, 1),
    "goal_position": Register(30, 2),
    "moving_speed": Register(32, 2),
    "torque_limit": Register(35, 2),
    "present_position": Register(37, 2),
    "present_speed": Register(39, 2),  # bit 10 is the sign
    "present_load": Register(41, 2),
    "voltage": Register(45, 1),
    "temperature": Register(46, 1),
    "moving": Register(49, 1),
    "hardware_error": Register(50, 1),
    "punch": Register(51, 2),
}

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
# e-manual MX-28(2.0): an X-series table without "Startup Configuration"; MX-64(2.0) and
# MX-106(2.0) alike.
_MX2: Final = {name: register for name, register in _X.items() if name != "startup"}

# Bits of the register hardware_error: e-manual XM430-W350 "Shutdown(63)", XL-320 "Shutdown(18)".
_X_ERRORS: Final = {
    0x01: "voltage",
    0x04: "overheating",
    0x08: "encoder",
    0x10: "electrical_shock",
    0x20: "overload",
}
_XL320_ERRORS: Final = {0x01: "overload", 0x02: "overheating", 0x04: "voltage"}


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
        manual: address of its page in the e-manual.
        error_bits: names of the bits of ``hardware_error``, where it has that register.
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
    manual: str
    error_bits: Mapping[int, str] = field(default_factory=dict)

    @property
    def compact(self) -> bool:
        """Whether torque, goal and motion are neighbours (AX, RX, MX with protocol 1.0, XL-320).

        Such a servo shuts itself down by a torque limit of 0, and a goal may switch its torque on.
        The others (X-series, MX with protocol 2.0) have operating modes, shut themselves down by
        switching their torque off, and no goal switches it on (but see :mod:`.modes`).
        """
        return "torque_limit" in self.registers

    @property
    def full_turn(self) -> bool:
        """Whether its encoder counts a whole turn, and begins again where it ends."""
        return not self.compact or "multi_turn_offset" in self.registers

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
        if not self.compact:
            return self._block("shutdown", "torque_enable", "hardware_error")
        if "hardware_error" in self.registers:
            return self._block("torque_enable", "torque_limit", "hardware_error")
        return self._block("torque_enable", "torque_limit")

    @property
    def watched(self) -> Block:
        """What a driver reads in every tick: goal, position and speed.

        Of :attr:`compact` servos it says whether they drive, too: a goal switches their torque on,
        so that it may be written only where the same reading shows that the servo drives.
        """
        if self.compact:
            return self._block("torque_enable", "torque_limit", "present_position", "present_speed")
        return self.goal_and_motion

    @property
    def settings(self) -> tuple[Block, ...]:
        """What decides how goals are followed, in one block, or two."""
        eeprom = self._block(*(name for name in _SETTINGS if name in self.registers))
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


# In the EEPROM, one block in all models.
_SETTINGS: Final = (
    "lower_limit",
    "upper_limit",
    "resolution_divider",
    "control_mode",
    "drive_mode",
    "operating_mode",
    "startup",
)
_E_MANUAL: Final = "https://emanual.robotis.com/docs/en/dxl/"
_RPM: Final = 2 * math.pi / 60


def _potentiometer(
    name: str, number: int, registers: dict[str, Register], page: str, protocol: int = 1
) -> ServoModel:
    # 300 degrees over 1023 steps; speed in 0.111 rpm.
    step, speed = math.radians(300.0) / 1023, 0.111 * _RPM
    errors = _XL320_ERRORS if protocol == 2 else {}
    manual = _E_MANUAL + page
    return ServoModel(name, number, protocol, registers, 0, 1023, 512, step, speed, manual, errors)


def _mx(name: str, number: int, registers: dict[str, Register], page: str) -> ServoModel:
    # 4096 steps a turn; speed in 0.114 rpm.
    step, speed, manual = 2 * math.pi / 4096, 0.114 * _RPM, _E_MANUAL + page
    return ServoModel(name, number, 1, registers, 0, 4095, 2048, step, speed, manual)


def _x(name: str, number: int, page: str = "", registers: dict[str, Register] = _X) -> ServoModel:
    # 4096 steps a turn; speed in 0.229 rpm.
    step, speed = 2 * math.pi / 4096, 0.229 * _RPM
    manual = _E_MANUAL + (page or f"x/{name.lower()}/")
    return ServoModel(name, number, 2, registers, 0, 4095, 2048, step, speed, manual, _X_ERRORS)


MODELS: Final = (
    _potentiometer("AX-12A", 12, _AX, "ax/ax-12a/"),
    _potentiometer("AX-18A", 18, _AX, "ax/ax-18a/"),
    _potentiometer("AX-12W", 300, _AX, "ax/ax-12w/"),
    _potentiometer("RX-28", 28, _AX, "rx/rx-28/"),
    _potentiometer("RX-64", 64, _AX, "rx/rx-64/"),
    _mx("MX-28", 29, _MX, "mx/mx-28/"),
    _mx("MX-64", 310, _MX64, "mx/mx-64/"),
    _mx("MX-106", 320, _MX106, "mx/mx-106/"),
    _x("MX-28(2.0)", 30, "mx/mx-28-2/", _MX2),
    _x("MX-64(2.0)", 311, "mx/mx-64-2/", _MX2),
    _x("MX-106(2.0)", 321, "mx/mx-106-2/", _MX2),
    _potentiometer("XL-320", 350, _XL320, "x/xl320/", protocol=2),
    _x("XL330-M077", 1190),
    _x("XL330-M288", 1200),
    _x("XC330-M181", 1230),
    _x("XC330-M288", 1240),
    _x("XC330-T181", 1210),
    _x("XC330-T288", 1220),
    _x("XL430-W250", 1060),
    _x("2XL430-W250", 1090),
    _x("XC430-W150", 1070),  # XC430-T150BB says the same number
    _x("XC430-W240", 1080),  # XC430-T240BB says the same number
    _x("2XC430-W250", 1160),
    _x("XM430-W210", 1030),
    _x("XM430-W350", 1020),
    _x("XM540-W150", 1130),
    _x("XM540-W270", 1120),
    _x("XH430-W210", 1010),
    _x("XH430-W350", 1000),
    _x("XH430-V210", 1050),
    _x("XH430-V350", 1040),
    _x("XH540-W150", 1110),
    _x("XH540-W270", 1100),
    _x("XH540-V150", 1150),
    _x("XH540-V270", 1140),
    _x("XD430-T210", 1011),
    _x("XD430-T350", 1001),
    _x("XD540-T150", 1111),
    _x("XD540-T270", 1101),
    _x("XW430-T200", 1280),
    _x("XW430-T333", 1270),
    _x("XW540-T140", 1180),
    _x("XW540-T260", 1170),
    _x("XW540-H260", 1310),
)

# Model numbers that are public, of Dynamixel servos without a table here: dynamixel_item.h of the
# workbench, and dynamixel.model of the hardware interface.
_OTHERS: Final = {
    10: "RX-10",
    24: "RX-24F",
    107: "EX-106+",
    360: "MX-12W",
    1700: "XC335-T332",
    2000: "PH42-020-S300",
    2010: "PH54-100-S500",
    2020: "PH54-200-S500",
    2100: "PM42-010-S260",
    2110: "PM54-040-S250",
    2120: "PM54-060-S250",
    4000: "YM070-210-M001",
    4010: "YM070-210-B001",
    4020: "YM070-210-R051",
    4030: "YM070-210-R099",
    4040: "YM070-210-A051",
    4050: "YM070-210-A099",
    4120: "YM080-230-M001",
    4130: "YM080-230-B001",
    4140: "YM080-230-R051",
    4150: "YM080-230-R099",
    4160: "YM080-230-A051",
    4170: "YM080-230-A099",
    35072: "L42-10-S300-R",
    35073: "RH-P12-RN",
    35074: "RH-P12-RN(A)",
    37896: "L54-30-S500-R",
    37928: "L54-30-S400-R",
    38152: "L54-50-S500-R",
    38176: "L54-50-S290-R",
    43288: "M42-10-S260-R",
    43289: "M42-10-S260-R(A)",
    46096: "M54-40-S250-R",
    46097: "M54-40-S250-R(A)",
    46352: "M54-60-S250-R",
    46353: "M54-60-S250-R(A)",
    51200: "H42-20-S300-R",
    51201: "H42-20-S300-R(A)",
    53768: "H54-100-S500-R",
    53769: "H54-100-S500-R(A)",
    54024: "H54-200-S500-R",
    54025: "H54-200-S500-R(A)",
}
# Feetech's servos answer pings and reads of protocol 1.0, and have their model's number and their
# id where Dynamixel servos have id, baud rate and return delay; at 0 and 1 is their firmware's.
# Addresses and numbers: src/lerobot/motors/feetech/tables.py of github huggingface/lerobot, commit
# 7427f318; those of the SCS series come with their high byte first.
FEETECH_MARK: Final = Block(3, 3)
_FEETECH: Final = {777: "STS3215", 2825: "STS3250", 11272: "SM8512BL", 1284: "SCS0009"}

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


def number_name(number: int) -> str:
    """What a servo of this model number is, in words, as far as that is public."""
    model = model_of_number(number)
    if model is not None:
        return model.name
    told = f"model number {number}"
    return f"{_OTHERS[number]}, {told}" if number in _OTHERS else told


def feetech_name(data: bytes, servo: int) -> str | None:
    """What a Feetech servo is, in words, by the bytes at :data:`FEETECH_MARK`; None for others.

    Args:
        data: what it answered.
        servo: the id under which it was asked.
    """
    numbers = int.from_bytes(data[:2], "little"), int.from_bytes(data[:2], "big")
    known = next((_FEETECH[n] for n in numbers if n in _FEETECH), None)
    if data[2] != servo or (known is None and data[0] == servo):
        return None
    return f"Feetech {known or f'number {numbers[0]}'}, no Dynamixel"


def models_named(name: str) -> tuple[ServoModel, ...]:
    """Models that a name in ``robot.toml`` may mean: ``AX-12A``, or a family such as ``XL-330``.

    Raises:
        ConfigurationError: none is meant.
    """
    wanted = _plain(name)
    found = tuple(m for m in MODELS if _plain(m.name) == wanted) or tuple(
        m for m in MODELS if wanted and _plain(m.name).startswith(wanted) and len(wanted) >= 4
    )
    if len({id(model.registers) for model in found}) > 1:
        raise ConfigurationError(
            f"servo model '{name}' may be {' or '.join(m.name for m in found)}, which have "
            "different control tables; name one"
        )
    if found:
        return found
    if wanted in map(_plain, _OTHERS.values()):
        raise ConfigurationError(
            f"servo model '{name}' has no control table here; those that have are in docs/bridge.md"
        )
    near = difflib.get_close_matches(wanted, [_plain(m.name) for m in MODELS], n=3)
    likely = [m.name for plain in near for m in MODELS if _plain(m.name) == plain]
    hint = "expected one such as AX-12A or XL430-W250;"
    if likely:
        hint = f"did you mean {', '.join(map(repr, likely))}?"
    raise ConfigurationError(
        f"unknown servo model '{name}'; {hint} all that are known are in docs/bridge.md"
    )


def _plain(name: str) -> str:
    return name.upper().replace("-", "").replace("_", "").replace(" ", "")
