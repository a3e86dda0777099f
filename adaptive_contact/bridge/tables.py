"""Holds control tables as data: where each model keeps what the bridge reads and writes.

The data is ``servos.toml``, beside this file.  Addresses, sizes, units and model numbers were
compared, register by register, with

- the ROBOTIS e-manual: each model's page is its :attr:`ServoModel.manual`;
- ``param/dxl_model/*.model`` of github ROBOTIS-GIT/dynamixel_hardware_interface, commit db2b9038,
  for protocol 2.0 (XL330, XC330: the ``_fw52`` files; ``startup`` is in none of them);
- ``dynamixel_item.cpp`` of github ROBOTIS-GIT/dynamixel-workbench, commit 2eb370f1;
- ``actuator.cpp`` of github ROBOTIS-GIT/Dynamixel2Arduino, commit 516205ff.

A test holds them to these.  Where they differ the e-manual's counts: the workbench has XL-320's
torque limit at 34, the others have it at 35.  A model not listed here is refused by name, never
guessed.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final, NamedTuple

from adaptive_contact.errors import ConfigurationError


class Register(NamedTuple):
    """A value in the control table."""

    # address, size: bytes
    address: int
    size: int
    eeprom: bool = False  # survives power-off, and wears out; written with ``--configure`` only
    signed: bool = False  # two's complement

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

    def holds(self, register: Register) -> bool:
        """Whether all of a register is in it."""
        ends = register.address + register.size, self.address + self.size
        return self.address <= register.address and ends[0] <= ends[1]

    def part(self, data: bytes, register: Register) -> int:
        """A register's value out of the block's bytes."""
        at = register.address - self.address
        return register.value(data[at : at + register.size])


@dataclass(frozen=True)
class ServoModel:
    """A kind of servo."""

    name: str  # as ROBOTIS writes it
    number: int  # what the servo answers to a ping
    protocol: int  # 1 or 2
    registers: dict[str, Register]  # its control table
    # lowest, highest, centre: position steps; ``centre`` is the middle of the horn's travel
    lowest: int
    highest: int
    centre: int
    step_rad: float  # one position step
    speed_rad_s: float  # one step of present speed
    manual: str  # address of its page in the e-manual
    # names of the bits of ``hardware_error``, where it has that register
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
    *("lower_limit", "upper_limit", "resolution_divider", "control_mode", "drive_mode"),
    *("operating_mode", "secondary_id", "startup"),
)
_E_MANUAL: Final = "https://emanual.robotis.com/docs/en/dxl/"
_DATA: Final = tomllib.loads(
    resources.files(__package__).joinpath("servos.toml").read_text("utf-8")
)


def _table(family: dict[str, Any]) -> dict[str, Register]:
    """A family's registers by name, those of the family that it is like first."""
    base = _table(_DATA["family"][family["like"]]) if "like" in family else {}
    own = {
        name: Register(address, size, "eeprom" in marks, "signed" in marks)
        for name, (address, size, *marks) in family.get("registers", {}).items()
    }
    without = family.get("without", ())
    return {name: register for name, register in base.items() if name not in without} | own


def _models() -> Iterator[ServoModel]:
    for family in _DATA["family"].values():
        registers = _table(family)
        for name, number, *page in family["models"]:
            yield ServoModel(
                name,
                number,
                family["protocol"],
                registers,
                lowest=0,
                highest=family["highest"],
                centre=family["centre"],
                step_rad=math.radians(family["span_deg"]) / family["steps"],
                speed_rad_s=family["speed_rpm"] * (2 * math.pi / 60),
                manual=_E_MANUAL + (page[0] if page else f"x/{name.lower()}/"),
                error_bits={bit: error for error, bit in family.get("error_bits", {}).items()},
            )


MODELS: Final = tuple(_models())
# Model numbers that are public, of Dynamixel servos without a table here.
_OTHERS: Final = {int(number): name for number, name in _DATA["others"].items()}
# Feetech's servos answer pings and reads of protocol 1.0, and have their model's number and their
# id where Dynamixel servos have id, baud rate and return delay; at 0 and 1 is their firmware's.
FEETECH_MARK: Final = Block(3, 3)
_FEETECH: Final = {int(number): name for number, name in _DATA["feetech"].items()}

# What DynamixelSDK 4.1.0 can set; AX-12A reach 1,000,000, X-series 4,000,000.
BAUDS: Final = (
    *(9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600, 1000000),
    *(1152000, 2000000, 2500000, 3000000, 3500000, 4000000),
)


def model_of_number(number: int | None) -> ServoModel | None:
    """The model that answers with this number, or None."""
    return next((m for m in MODELS if m.number == number), None)


def number_name(number: int) -> str:
    """What a servo of this model number is, in words, as far as that is public."""
    model = model_of_number(number)
    if model is not None:
        return model.name
    by_number = f"model number {number}"
    return f"{_OTHERS[number]}, {by_number}" if number in _OTHERS else by_number


def feetech_name(data: bytes, servo: int) -> str | None:
    """What a Feetech servo is, in words, by the bytes at :data:`FEETECH_MARK`; None for others."""
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
