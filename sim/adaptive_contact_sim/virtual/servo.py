"""One virtual servo: a control table over a backend's angle.

Only what a master can see is modelled: which registers there are, which may be written and when,
what is refused and with which error; that a servo in trouble shuts itself down, and how to wake it;
how operating mode, drive mode, limits and offsets turn positions and goals into numbers (see
:mod:`adaptive_contact.bridge.modes`).
The slope of the control law (compliance slope, P gain, PWM limit) acts on the servo behind; other
registers of the law (margin, punch, I and D, speeds, a torque limit above 0) are kept and change
nothing.  Sources: the e-manual pages named in :mod:`adaptive_contact.bridge.tables`, whose
addresses are used.

A Feetech servo refuses nothing: it keeps what cannot be, and goes to its limits.  One that has shut
itself down drives again when its torque is switched; no manual says that.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.bridge.modes import LAW_REGISTERS, DriveMode, slope_rad
from adaptive_contact.bridge.tables import Register, ServoModel
from adaptive_contact.robot.description import Protocol
from adaptive_contact_sim.virtual.backend import Backend

# Errors of protocol 1.0 (bits) and 2.0 (numbers) for the same refusals.
RANGE1, ANGLE1, INSTRUCTION1 = 0x08, 0x02, 0x40
LENGTH2, LIMIT2, ACCESS2 = 0x05, 0x06, 0x07
_READ_ONLY: Final = (
    "model_number",
    "firmware",
    "present_position",
    "present_speed",
    "present_load",
    "voltage",
    "temperature",
    "moving",
    "hardware_error",
)
# Operating modes of X-series that follow goal positions; of those, with goals beyond one turn.
_POSITION, _EXTENDED, _CURRENT_BASED = 3, 4, 5
_MOST_STEPS: Final = 1_048_575  # of a goal in the extended modes
# Rates of terminals.
BAUDS: Final = (
    *(9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600, 1000000),
    *(1152000, 2000000, 2500000, 3000000, 3500000, 4000000),
)
# Of compact servos as delivered, by protocol: errors that shut them down.
_FATAL: Final[dict[Protocol, int]] = {1: 0x24, 2: 0x03, "sts": 0x2C, "scs": 0x25}
_LAW: Final[set[str]] = {name for names in LAW_REGISTERS for name in names}


class Refusal(NamedTuple):
    """Why an instruction was not carried out: the error of either protocol."""

    error: int


class VirtualServo:
    """A servo.

    Args:
        servo: id.
        model: what it is.
        backend: what moves.
        index: its place in the backend.
        rng: of the reading noise.
        noise_steps: standard deviation of a reading, in steps; an AX-12A's is in docs/simulator.md,
            an X-series' magnetic encoder jitters by a step.
        baud: rate at which it receives packets.

    Attributes:
        id: follows its register.
        baud: at which it receives packets; what is written to its register is kept only.
        last: the control table as it was last read.
        writes: instructions to write, carried out or refused.
        keeps_goal: torque that comes on drives to the goal in the register.  Firmwares differ in
            this: others set that goal to where the horn is, as X-series do here by default.
        goal_wakes: a goal switches torque on, as with protocol 1.0 and Feetech's.  XL-320's manual
            does not say.
    """

    def __init__(
        self,
        servo: int,
        model: ServoModel,
        backend: Backend,
        index: int,
        rng: np.random.Generator,
        *,
        noise_steps: float = 0.5,
        baud: int = 1_000_000,
    ) -> None:
        self.id = servo
        self.model = model
        self._backend = backend
        self._index = index
        self._rng = rng
        self._noise = noise_steps
        end = max(r.address + r.size for r in model.registers.values())
        if not model.compact:  # beyond the registers known here
            end = 228 if "330" in model.name else 662
        self._memory = bytearray(end)
        self._saved = bytearray(end)  # what is in EEPROM
        self.keeps_goal = model.compact
        self.goal_wakes = model.protocol != 2
        self._turns = 0
        self.writes = 0
        # EEPROM as delivered, but for what a robot's owner sets first.
        self._store_known(
            {
                "model_number": model.number,
                "firmware": 3 if model.feetech else 24 if model.protocol == 1 else 52,
                "byte_order": int(model.protocol == "scs"),
                "id": self.id,
                "return_delay": 0,
                "lower_limit": model.lowest,
                "upper_limit": model.highest,
                "shutdown": _FATAL[model.protocol] if model.compact else 0x34,
                "status_return": 2,
                "response_level": 1,
                "phase": 12,
                "resolution_divider": 1,
                "control_mode": model.joint_mode or 0,
                "operating_mode": _POSITION,
                "secondary_id": 255,
                "pwm_limit": 885,
            }
        )
        self.baud = baud
        self._power_on()
        self.last = bytes(self._memory)

    @property
    def torque(self) -> bool:
        """Whether the servo drives."""
        return bool(self.value("torque_enable"))

    @property
    def drives(self) -> bool:
        """Whether torque reaches the horn: not after a shutdown."""
        limit = self.value("torque_limit") if "torque_limit" in self.model.registers else 1
        return self.torque and limit > 0 and not self._latched

    @property
    def answers(self) -> int:
        """Status return level: 0 to pings, 1 to reads too, 2 to all."""
        if self.model.feetech:
            return 1 + self.value("response_level")
        return self.value("status_return")

    def value(self, name: str) -> int:
        """A register's value as it lies in memory."""
        register = self.model.registers[name]
        at = slice(register.address, register.address + register.size)
        return register.value(bytes(self._memory[at]))

    def follows(self, servo: int, address: int) -> bool:
        """Whether a write to another id counts here: one to the secondary id, and to RAM."""
        return address >= 64 and self._has("secondary_id") == servo > 0

    def set_errors(self, bits: int) -> int:
        """Put up what is wrong now; a servo that is set to shut down for it does so.

        Args:
            bits: of protocol 1.0's error byte, or of the model's Hardware Error Status.

        Returns:
            Bits to report: those that an X-series or a Feetech servo has shut down for stay.
        """
        fatal = bits & self.value("shutdown")
        if self.model.compact and not self.model.feetech:
            if fatal:
                self.store("torque_limit", 0)
                self._backend.set_torque(self._index, False)
            if "hardware_error" in self.model.registers:
                self.store("hardware_error", bits)
            return bits
        if fatal:
            if not self.model.feetech:
                self.store("torque_enable", 0)
            self._backend.set_torque(self._index, False)
            self._latched |= fatal
        self.store("hardware_error", bits | self._latched)
        return bits | self._latched

    def reboot(self) -> None:
        """Begin again, as after a loss of power: no torque, what is not in EEPROM as delivered."""
        self._power_on()
        self._set_slope()

    def read(self, address: int, size: int) -> bytes | Refusal:
        """Bytes of the control table, as of now."""
        if size < 1 or address + size > len(self._memory):
            return self._refusal(RANGE1, LENGTH2)
        self._refresh()
        self.last = bytes(self._memory)
        return self.last[address : address + size]

    def write(self, address: int, data: bytes) -> Refusal | None:
        """Write into the control table, whole registers; None when done."""
        self.writes += 1
        if not data or address + len(data) > len(self._memory):
            return self._refusal(RANGE1, LENGTH2)
        names = self._touched(address, data)
        for name in names:
            refusal = self._refuse(name, self.model.registers[name], address, data)
            if refusal is not None:
                return refusal
        self._memory[address : address + len(data)] = data
        if not self._has("eeprom_lock"):
            self._saved[:] = self._memory
        for name in names:
            self._act(name)
        return None

    # -- private -------------------------------------------------------------------------------

    def _refusal(self, one: int, two: int) -> Refusal:
        """The error of its protocol; Feetech's has none."""
        return Refusal(0 if self.model.feetech else one if self.model.protocol == 1 else two)

    def _touched(self, address: int, data: bytes) -> list[str]:
        return [
            name
            for name, register in self.model.registers.items()
            if register.address < address + len(data) and address < register.address + register.size
        ]

    def _refuse(self, name: str, register: Register, address: int, data: bytes) -> Refusal | None:
        if name in _READ_ONLY:
            return self._refusal(INSTRUCTION1, ACCESS2)
        if register.eeprom and self.torque and self.model.protocol == 2:
            return Refusal(ACCESS2)
        if name == "torque_enable" and self._latched and not self.model.feetech:
            return Refusal(ACCESS2)  # shut down: only a reboot helps
        if name == "goal_position" and not self.model.feetech:
            at = register.address - address
            if at < 0 or at + register.size > len(data):
                return None
            goal = register.value(data[at : at + register.size])
            lowest, highest = self.goals()
            if not lowest <= goal <= highest:
                return self._refusal(ANGLE1, LIMIT2)
        return None

    def goals(self) -> tuple[int, int]:
        """Goals that are taken."""
        if self._multi_turn:
            most = 28_672 if self.model.compact else _MOST_STEPS
            return -most, most
        if not self._follows:  # the register is kept, and means nothing
            return -_MOST_STEPS, _MOST_STEPS
        return self.value("lower_limit"), self.value("upper_limit")

    @property
    def _multi_turn(self) -> bool:
        """Whether positions and goals go beyond one turn."""
        if not self.model.compact:
            return self.value("operating_mode") in (_EXTENDED, _CURRENT_BASED)
        limits = self.value("lower_limit"), self.value("upper_limit")
        return limits == (self.model.multi_turn,) * 2

    @property
    def _follows(self) -> bool:
        """Whether goal positions are followed at all."""
        if self._has("drive_mode") & DriveMode.SLAVE:
            return False
        if not self.model.compact:
            return self._multi_turn or self.value("operating_mode") == _POSITION
        mode = self.model.joint_mode
        if self._has("torque_control") or (mode is not None and self.value("control_mode") != mode):
            return False
        limits = self.value("lower_limit"), self.value("upper_limit")
        return self._multi_turn or limits != (0, 0)

    def _has(self, name: str) -> int:
        """A register's value, 0 where the model has no such register."""
        return self.value(name) if name in self.model.registers else 0

    def _act(self, name: str) -> None:
        if name == "goal_position":
            if self.goal_wakes:
                # An AX servo that is given a goal switches its torque on.
                self.store("torque_enable", 1)
                self._backend.set_torque(self._index, self.drives)
            elif not self.torque and self._has("drive_mode") & DriveMode.TORQUE_BY_GOAL:
                self._settle_turns()
                self.store("torque_enable", 1)
                self._backend.set_torque(self._index, True)
            if self.torque:
                self._drive()
        elif name == "id":
            self.id = self.value("id")
        elif name in _LAW:
            self._set_slope()
        elif name == "torque_limit":
            self._backend.set_torque(self._index, self.drives)
            if self.drives:
                self._drive()
        elif name == "operating_mode":
            self._settle_turns()
        elif name == "torque_enable":
            if self.model.feetech:
                self._latched = 0
            self._backend.set_torque(self._index, self.drives)
            if self.torque:
                self._settle_turns()
                if not self.keeps_goal:
                    self.store("goal_position", self._steps(self._backend.angle(self._index)))
                self._drive()

    def _set_slope(self) -> None:
        known = _LAW & self.model.registers.keys()
        slope = slope_rad(self.model, {name: self.value(name) for name in known})
        if slope is not None:
            self._backend.set_slope(self._index, slope)

    def _drive(self) -> None:
        # What it follows instead of goals is not modelled: it stays.
        here = self._backend.angle(self._index)
        steps = self.value("goal_position")
        if self.model.feetech:
            steps = min(max(steps, self.goals()[0]), self.goals()[1])
        self._backend.set_goal(self._index, self._angle(steps) if self._follows else here)

    def _steps(self, angle_rad: float, noise: float = 0.0) -> int:
        """Return the position register for a horn's angle, by mode, turns and offsets."""
        model = self.model
        offset, divider, sign = self._frame()
        turn = model.centre + round(sign * angle_rad / model.step_rad + noise)
        if model.compact and not self._multi_turn:
            if model.full_turn:
                return (turn + offset) % (model.highest + 1)  # a full turn of encoder
            return min(max(turn, model.lowest), model.highest)
        return round((turn - self._turns * (model.highest + 1)) / divider) + offset

    def _angle(self, steps: int) -> float:
        """The horn's angle at a goal."""
        model = self.model
        offset, divider, sign = self._frame()
        full = (steps - offset) * divider
        if model.compact and not self._multi_turn:
            # A full turn of encoder: the goal is within the turn the horn is in.
            here = sign * self._backend.angle(self._index) / model.step_rad
            own = round(model.centre + offset + here) // (model.highest + 1)
            full += own * (model.highest + 1) if model.full_turn else 0
        else:
            full += self._turns * (model.highest + 1)
        return sign * (full - model.centre) * model.step_rad

    def _frame(self) -> tuple[int, int, int]:
        """Offset, divider and sign of the positions reported, as the mode applies them."""
        sign = -1 if self._has("drive_mode") & DriveMode.REVERSE else 1
        if self.model.feetech:
            return -self._has("homing_offset"), 1, sign
        if self.model.compact:
            if not self._multi_turn:
                return 0, 1, sign
            return self.value("multi_turn_offset"), max(self.value("resolution_divider"), 1), sign
        homing = self.value("homing_offset")
        if self.value("operating_mode") == _POSITION and abs(homing) > 1024:
            homing = 0  # ignored there
        return homing, 1, sign

    def _settle_turns(self, *, fresh: bool = False) -> None:
        """Forget whole turns: at power-on, and in position mode as torque comes on."""
        position = not self.model.compact and self.value("operating_mode") == _POSITION
        if fresh or position:
            sign = self._frame()[2]
            angle = self._backend.angle(self._index)
            turn = self.model.centre + round(sign * angle / self.model.step_rad)
            self._turns = turn // (self.model.highest + 1)

    def _refresh(self) -> None:
        model, backend, index = self.model, self._backend, self._index
        noise = self._noise * float(self._rng.standard_normal())
        self.store("present_position", self._steps(backend.angle(index), noise))
        speed = backend.speed(index)
        # A horn that is slower stands still for this register.
        self.store("moving", int(abs(speed) > 0.05))
        raw = round(speed / model.speed_rad_s)
        most = (1 << (model.registers["present_speed"].sign_bit or 31)) - 1
        self.store("present_speed", min(max(raw, -most), most))
        if (inside := backend.goal(index)) is not None:
            self.store("goal_position", self._steps(inside))

    def store(self, name: str, value: int) -> None:
        """Put a value into a register, whatever the bus would say: what it holds from before."""
        register = self.model.registers[name]
        at = slice(register.address, register.address + register.size)
        self._memory[at] = self._saved[at] = register.data(value)

    def _store_known(self, values: Mapping[str, int]) -> None:
        """Store what the model has registers for."""
        for name in values.keys() & self.model.registers.keys():
            self.store(name, values[name])

    def _power_on(self) -> None:
        model = self.model
        self._latched = 0
        self._memory[:] = self._saved  # what was written while EEPROM was locked is gone
        self._settle_turns(fresh=True)
        here = self._steps(self._backend.angle(self._index))
        # Registers that the model has not are left out.
        initial = {
            "goal_position": here,
            "voltage": 50 if model.protocol == 2 else 120,
            "temperature": 35,
            "torque_control": 0,
            "torque_limit": 1000 if model.feetech else 1023,
            "hardware_error": 0,
            "eeprom_lock": 1,
            "position_p": 32 if model.compact else 400 if "330" in model.name else 800,
            "max_acceleration": 254,
            **dict.fromkeys(("lower_slope", "upper_slope", "punch"), 32),
            **dict.fromkeys(("lower_margin", "upper_margin"), 1),
        }
        if not model.compact:  # those of the others are in their EEPROM
            initial["status_return"] = 2
        self._store_known(initial)
        starts = bool(self._has("startup") & 1)
        on = starts or self._backend.goal(self._index) is not None
        self.store("torque_enable", int(on))
        self._backend.set_torque(self._index, on)
        if starts:
            self._drive()
