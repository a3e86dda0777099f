"""One virtual servo: a control table over a backend's angle.

Only what a master can see is modelled: which registers there are, which may be written and when,
what is refused and with which error.  Sources: the e-manual pages named in
:mod:`adaptive_contact.bridge.tables`, whose addresses are used.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.bridge.tables import Register, ServoModel
from adaptive_contact_sim.virtual.backend import Backend

__all__ = ["Refusal", "VirtualServo"]

# Errors of protocol 1.0 (bits) and 2.0 (numbers) for the same refusals.
RANGE1, ANGLE1, INSTRUCTION1 = 0x08, 0x02, 0x40
RANGE2, LENGTH2, LIMIT2, ACCESS2 = 0x04, 0x05, 0x06, 0x07
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
# Size of the table: AX-12A ends at 49, X-series at 661.
_SIZES: Final = {1: 50, 2: 662}
# A horn slower than this stands still for the register Moving.
_MOVING_RAD_S: Final = 0.05


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
        noise_steps: standard deviation of a reading, in steps.
        return_delay: register, 2 us each; 250 when new.

    Attributes:
        writes: instructions to write, carried out or refused.
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
        return_delay: int = 0,
    ) -> None:
        self.id = servo
        self.model = model
        self._backend = backend
        self._index = index
        self._rng = rng
        self._noise = noise_steps
        self._memory = bytearray(_SIZES[model.protocol])
        self.registered: tuple[int, bytes] | None = None
        self.stale_data: bytes | None = None
        self.writes = 0
        self._power_on(return_delay)

    @property
    def torque(self) -> bool:
        """Whether the servo drives."""
        return bool(self.value("torque_enable"))

    @property
    def answers(self) -> int:
        """Status return level: 0 to pings, 1 to reads too, 2 to all."""
        return self.value("status_return")

    @property
    def return_delay_s(self) -> float:
        """Between an instruction and its answer."""
        return self.value("return_delay") * 2e-6

    def value(self, name: str) -> int:
        """A register's value as it lies in memory."""
        register = self.model.registers[name]
        part = self._memory[register.address : register.address + register.size]
        return int.from_bytes(part, "little", signed=register.signed)

    def set_hardware_error(self, bits: int) -> None:
        """Put up the bits behind protocol 2.0's alert."""
        self._store("hardware_error", bits)

    def read(self, address: int, size: int) -> bytes | Refusal:
        """Bytes of the control table, as of now."""
        if size < 1 or address + size > len(self._memory):
            return Refusal(RANGE1 if self.model.protocol == 1 else LENGTH2)
        self._refresh()
        return bytes(self._memory[address : address + size])

    def write(self, address: int, data: bytes) -> Refusal | None:
        """Write into the control table, whole registers; None when done."""
        one = self.model.protocol == 1
        self.writes += 1
        if not data or address + len(data) > len(self._memory):
            return Refusal(RANGE1 if one else LENGTH2)
        touched = [
            (name, register)
            for name, register in self.model.registers.items()
            if register.address < address + len(data) and address < register.address + register.size
        ]
        for name, register in touched:
            refusal = self._refuse(name, register, address, data)
            if refusal is not None:
                return refusal
        self._memory[address : address + len(data)] = data
        for name, _ in touched:
            self._act(name)
        return None

    # -- private -------------------------------------------------------------------------------

    def _refuse(self, name: str, register: Register, address: int, data: bytes) -> Refusal | None:
        one = self.model.protocol == 1
        if name in _READ_ONLY:
            return Refusal(INSTRUCTION1 if one else ACCESS2)
        if register.eeprom and self.torque and not one:
            return Refusal(ACCESS2)
        if name == "goal_position":
            at = register.address - address
            if at < 0 or at + register.size > len(data):
                return None
            goal = int.from_bytes(data[at : at + register.size], "little", signed=register.signed)
            if not self.value("lower_limit") <= goal <= self.value("upper_limit"):
                return Refusal(ANGLE1 if one else LIMIT2)
        return None

    def _act(self, name: str) -> None:
        if name == "goal_position":
            if self.model.protocol == 1:
                # An AX servo that is given a goal switches its torque on.
                self._store("torque_enable", 1)
                self._backend.set_torque(self._index, True)
            if self.torque:
                self._drive()
        elif name == "torque_enable":
            self._backend.set_torque(self._index, self.torque)
            if self.torque and self.model.protocol == 2:
                # X-series: the goal is where the horn is when torque comes on.
                self._store("goal_position", self._steps(self._backend.angle(self._index)))
                self._drive()

    def _drive(self) -> None:
        steps = self.value("goal_position") - self.model.centre
        self._backend.set_goal(self._index, steps * self.model.step_rad)

    def _steps(self, angle_rad: float, noise: float = 0.0) -> int:
        steps = self.model.centre + round(angle_rad / self.model.step_rad + noise)
        return min(max(steps, self.model.lowest), self.model.highest)

    def _refresh(self) -> None:
        model, backend, index = self.model, self._backend, self._index
        noise = self._noise * float(self._rng.standard_normal())
        self._store("present_position", self._steps(backend.angle(index), noise))
        speed = backend.speed(index)
        self._store("moving", int(abs(speed) > _MOVING_RAD_S))
        raw = round(abs(speed) / model.speed_rad_s)
        if model.registers["present_speed"].signed:
            self._store("present_speed", raw if speed >= 0 else -raw)
        else:
            self._store("present_speed", min(raw, 1023) | (0 if speed >= 0 else 0x400))
        inside = backend.goal(index)
        if inside is not None:
            self._store("goal_position", self._steps(inside))

    def _store(self, name: str, value: int) -> None:
        register = self.model.registers[name]
        data = value.to_bytes(register.size, "little", signed=register.signed)
        self._memory[register.address : register.address + register.size] = data

    def _power_on(self, return_delay: int) -> None:
        model = self.model
        initial = {
            "model_number": model.number,
            "firmware": 24 if model.protocol == 1 else 52,
            "id": self.id,
            "return_delay": return_delay,
            "lower_limit": model.lowest,
            "upper_limit": model.highest,
            "status_return": 2,
            "temperature": 35,
            "voltage": 120 if model.protocol == 1 else 50,
            "goal_position": self._steps(self._backend.angle(self._index)),
        }
        if model.protocol == 1:
            initial |= {"lower_margin": 1, "upper_margin": 1, "lower_slope": 32, "upper_slope": 32}
            initial |= {"torque_limit": 1023, "punch": 32}
        else:
            initial |= {"operating_mode": 3, "position_p": 400}
        for name, value in initial.items():
            self._store(name, value)
        inside = self._backend.goal(self._index)
        self._store("torque_enable", int(inside is not None))
        self._backend.set_torque(self._index, inside is not None)
