"""Holds control tables as data: where each model keeps what the bridge reads and writes.

The data is ``servos.toml``, beside this file.  Addresses, sizes, units and model numbers were
compared, register by register, with

- the ROBOTIS e-manual: each model's page is its :attr:`ServoModel.manual`;
- ``param/dxl_model/*.model`` of github ROBOTIS-GIT/dynamixel_hardware_interface, commit db2b9038,
  for protocol 2.0 (XL330, XC330: the ``_fw52`` files; ``startup`` is in none of them);
- ``dynamixel_item.cpp`` of github ROBOTIS-GIT/dynamixel-workbench, commit 2eb370f1;
- ``actuator.cpp`` of github ROBOTIS-GIT/Dynamixel2Arduino, commit 516205ff;
- Feetech's: ``lerobot/motors/feetech/tables.py`` of github huggingface/lerobot, commit 7427f318,
  ``src/servo/feetech`` of github pollen-robotics/rustypot, commits 0013a79e and 4de7e7cc, and
  https://wiki.aifitlab.com/feetech-servo-motor-docs/feetech-sts-servo-memory-table-analysis.

A test holds them to these.  Where they differ the e-manual's counts: the workbench has XL-320's
torque limit at 34, the others have it at 35.  A model not listed here is refused by name, never
guessed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final, Literal, NamedTuple

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.printable import did_you_mean
from adaptive_contact.robot.description import Protocol


class Register(NamedTuple):
    """Describes a value in the control table."""

    # address, size: bytes
    address: int
    size: int
    eeprom: bool = False  # survives power-off, and wears out; written with ``--configure`` only
    signed: bool = False  # two's complement, or sign and magnitude
    sign_bit: int = 0  # of sign and magnitude
    order: Literal["little", "big"] = "little"

    @property
    def block(self) -> Block:
        """Return the register's place, to be read alone."""
        return Block(self.address, self.size)

    def value(self, data: bytes) -> int:
        """Decode the value from the bytes of its own block."""
        if not self.sign_bit:
            return int.from_bytes(data, self.order, signed=self.signed)
        raw, sign = int.from_bytes(data, self.order), 1 << self.sign_bit
        return -(raw & (sign - 1)) if raw & sign else raw & (sign - 1)

    def data(self, value: int) -> bytes:
        """Encode a value as bytes."""
        if self.sign_bit and value < 0:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, self.order, signed=self.signed and not self.sign_bit)


class Block(NamedTuple):
    """Groups neighbouring registers that are read in one go."""

    address: int
    size: int

    def holds(self, register: Register) -> bool:
        """Return whether the block has all bytes of a register."""
        ends = register.address + register.size, self.address + self.size
        return self.address <= register.address and ends[0] <= ends[1]

    def part(self, data: bytes, register: Register) -> int:
        """Decode a register's value from the block's bytes."""
        at = register.address - self.address
        return register.value(data[at : at + register.size])


@dataclass(frozen=True)
class ServoModel:
    """Describes a kind of servo."""

    name: str  # as its maker writes it
    number: int  # what the servo says that it is
    protocol: Protocol
    registers: dict[str, Register]  # its control table
    # lowest, highest, centre: position steps; ``centre`` is the middle of the horn's travel
    lowest: int
    highest: int
    centre: int
    step_rad: float  # one position step
    speed_rad_s: float  # one step of present speed
    manual: str  # address of its manual
    # names of the bits of ``hardware_error``, where it has that register
    error_bits: Mapping[int, str] = field(default_factory=dict)
    joint_mode: int | None = None  # the control mode that follows goal positions
    multi_turn: int | None = None  # what both limits are where goals go beyond one turn

    @property
    def feetech(self) -> bool:
        """Return whether it is a Feetech servo; all others are Dynamixel servos."""
        return is_feetech(self.protocol)

    @property
    def compact(self) -> bool:
        """Return whether torque, goal and motion are neighbours (AX, RX, MX 1.0, XL-320).

        A goal may switch such a servo's torque on.  AX, RX, MX and XL-320 shut themselves down by a
        torque limit of 0, Feetech servos say so in their status.  X-series and MX with protocol 2.0
        have operating modes, shut themselves down by switching their torque off, and no goal
        switches it on (but see :mod:`.modes`).
        """
        return "operating_mode" not in self.registers

    @property
    def full_turn(self) -> bool:
        """Return whether its encoder counts a whole turn, and begins again where it ends."""
        return round(2 * math.pi / self.step_rad) == self.highest + 1

    @property
    def goal_and_motion(self) -> Block:
        """Return the block of goal position, present position and speed."""
        return self._block("goal_position", "present_speed", "present_position")

    @property
    def measured(self) -> Block:
        """Return the block that no two servos measure alike: position, voltage, temperature."""
        return self._block("present_position", "voltage", "temperature")

    @property
    def state(self) -> Block:
        """Return the block that says whether it drives, and whether it has shut itself down.

        Of Feetech's servos it says the latter only.  Nothing in it changes while a servo moves, so
        that it can be read twice alike.
        """
        if self.feetech:
            return self._block("hardware_error")
        if not self.compact:
            return self._block("shutdown", "torque_enable", "hardware_error")
        if "hardware_error" in self.registers:
            return self._block("torque_enable", "torque_limit", "hardware_error")
        return self._block("torque_enable", "torque_limit")

    @property
    def watched(self) -> Block:
        """Return the block that a driver reads in every tick: goal, position and speed.

        Of :attr:`compact` servos it says whether they drive, too: a goal switches their torque on,
        so that it may be written only where the same reading shows that the servo drives.
        """
        if self.feetech:
            return self._block("torque_enable", "hardware_error")
        if self.compact:
            return self._block("torque_enable", "torque_limit", "present_position", "present_speed")
        return self.goal_and_motion

    @property
    def settings(self) -> tuple[Block, ...]:
        """Return the blocks that decide how goals are followed, one or two."""
        names = [name for name in _SETTINGS if name in self.registers]
        eeprom = self._block(*names, *(["shutdown"] if self.feetech else []))
        if "torque_control" not in self.registers:
            return (eeprom,)
        return (eeprom, self._block("torque_control"))

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
    """Return a family's registers by name, those of the family that it resembles first."""
    base = _table(_DATA["family"][family["like"]]) if "like" in family else {}
    own = {}
    for name, (address, size, *marks) in family.get("registers", {}).items():
        sign_bit = next((mark for mark in marks if isinstance(mark, int)), 0)
        signed = "signed" in marks or sign_bit > 0
        own[name] = Register(address, size, "eeprom" in marks, signed, sign_bit)
    without = family.get("without", ())
    table = {name: register for name, register in base.items() if name not in without} | own
    if family["protocol"] != "scs":
        return table
    return {name: register._replace(order="big") for name, register in table.items()}


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
                manual=family.get(
                    "manual", _E_MANUAL + (page[0] if page else f"x/{name.lower()}/")
                ),
                error_bits={bit: error for error, bit in family.get("error_bits", {}).items()},
                joint_mode=family.get("joint_mode"),
                multi_turn=family.get("multi_turn"),
            )


MODELS: Final = tuple(_models())
# Where each protocol has the model's number.
MODEL_NUMBERS: Final[Mapping[Protocol, Register]] = {
    **dict.fromkeys((1, 2), Register(0, 2)),
    "sts": Register(3, 2),
    "scs": Register(3, 2, order="big"),
}


def is_feetech(protocol: Protocol) -> bool:
    """Return whether a protocol is one of Feetech's."""
    return isinstance(protocol, str)


def tool_of(protocol: Protocol) -> str:
    """Return the program with which a person sets servos of a protocol."""
    return "Feetech's FD software" if is_feetech(protocol) else "DYNAMIXEL Wizard"


def model_of_number(number: int | None, protocol: Protocol) -> ServoModel | None:
    """Return the model with this number in a protocol of its maker, or None."""
    made = (m for m in MODELS if m.feetech == is_feetech(protocol))
    return next((m for m in made if m.number == number), None)


def models_named(name: str) -> tuple[ServoModel, ...]:
    """Return the models that a name in ``robot.toml`` may mean: ``AX-12A``, or ``XL-330``.

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
    hint = did_you_mean(name, [model.name for model in MODELS], "expected one such as AX-12A;")
    raise ConfigurationError(
        f"unknown servo model '{name}'; {hint} all that are known are in docs/bridge.md"
    )


def _plain(name: str) -> str:
    return name.upper().replace("-", "").replace("_", "").replace(" ", "")
