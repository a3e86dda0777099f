"""A virtual bus of any servos, set in any way.

A SPEC is ``IDS:MODEL[:NAME=VALUE...]``, such as
``1-3:MX-28:lower_limit=4095:upper_limit=4095:at=-4.8``.
A NAME is a register of the model, or one of

=======  =======================================================================================
at       where the horn is, rad from its centre; any number of turns
baud     rate at which it answers
number   model number that it answers, instead of its own
short    share of reads of more than a byte that it answers with a single 0
keeps    1: torque that comes on drives to the goal in the register; 0: sets that goal to the horn
=======  =======================================================================================

Registers are stored as they are, without what the servo does for a write; ``torque_enable`` acts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from kinematic import KinematicBackend

from adaptive_contact.bridge.tables import models_named
from adaptive_contact_sim.virtual import (
    Backend,
    FaultSchedule,
    VirtualPort,
    VirtualServer,
    VirtualServo,
)
from adaptive_contact_sim.virtual.servo import Refusal

OWN: Final = ("at", "baud", "number", "short", "keeps")


class Horns(KinematicBackend):
    """A backend without inertia: a horn with torque is at its goal at once.

    What a single write does to it is all there to be seen.
    """

    def __init__(self, size: int) -> None:
        super().__init__(size)
        self._driven[:] = False

    def advance(self, now_s: float) -> float:
        return now_s + self._IDLE_S

    def set_goal(self, index: int, angle_rad: float) -> None:
        super().set_goal(index, angle_rad)
        if self._driven[index]:
            self._angle[index] = angle_rad

    def set_torque(self, index: int, on: bool) -> None:
        # Torque holds the horn until the servo says where to.
        if on and not self._driven[index]:
            self._goal[index] = self._angle[index]
        super().set_torque(index, on)

    def place(self, index: int, angle_rad: float) -> None:
        """Turn a horn by hand; one with torque stays."""
        if not self._driven[index]:
            self._angle[index] = angle_rad


class AnyServo(VirtualServo):
    """A virtual servo that can be set in any way, and answers some reads short.

    Attributes:
        short: share of reads answered with a single 0.
        deaf: writes from now on that are lost.
        switched_on: how far the goal was from the horn whenever torque came on, steps.
    """

    short = 0.0
    deaf = 0

    def read(self, address: int, size: int) -> bytes | Refusal:
        answer = super().read(address, size)
        if isinstance(answer, bytes) and size > 1 and self._rng.random() < self.short:
            return b"\0"
        return answer

    def write(self, address: int, data: bytes) -> Refusal | None:
        if self.deaf:
            self.deaf -= 1
            return None
        limp, at = not self.torque, self._steps(self._backend.angle(self._index))
        goal = self.value("goal_position")
        refusal = super().write(address, data)
        if limp and self.torque:
            written = self.model.registers["goal_position"].address == address
            goal = self.value("goal_position") if written else goal
            self.__dict__.setdefault("switched_on", []).append(abs(goal - at))
        return refusal

    def set_registers(self, registers: Mapping[str, int]) -> None:
        """Store registers as they are; mode and turns are what they would be after power-on."""
        for name, value in registers.items():
            self.store(name, value)
        self._settle_turns(fresh=True)
        if "torque_enable" in registers:
            self._backend.set_torque(self._index, bool(registers["torque_enable"]))
            if self.drives:
                self._drive()


def any_servo(
    servo: int, model: str, backend: Backend, index: int, registers: Mapping[str, int] | None = None
) -> AnyServo:
    """A servo without noise."""
    made = AnyServo(
        servo, models_named(model)[0], backend, index, np.random.default_rng(servo), noise_steps=0.0
    )
    made.set_registers(registers or {})
    return made


def parse(spec: str) -> tuple[list[int], str, dict[str, float]]:
    """Ids, model and settings of a SPEC."""
    ids, model, *settings = spec.split(":")
    pairs = (text.split("=") for text in settings)
    return _ids(ids), model, {name: float(value) for name, value in pairs}


def build(specs: Sequence[str], backend: KinematicBackend) -> list[AnyServo]:
    """The servos of SPECs, over a backend that has a place for each."""
    servos: list[AnyServo] = []
    for spec in specs:
        ids, model, settings = parse(spec)
        for servo in ids:
            index = len(servos)
            backend.place(index, settings.get("at", 0.0))
            made = any_servo(servo, model, backend, index)
            if "baud" in settings:
                made.baud = int(settings["baud"])
            if "number" in settings:
                made.store("model_number", int(settings["number"]))
            made.short = settings.get("short", 0.0)
            made.keeps_goal = bool(settings.get("keeps", made.keeps_goal))
            made.set_registers({n: int(v) for n, v in settings.items() if n not in OWN})
            servos.append(made)
    return servos


def serve(directory: Path, specs: Sequence[str]) -> tuple[VirtualServer, KinematicBackend]:
    """A server of one port, ``port0``, in a directory."""
    backend = KinematicBackend(sum(len(parse(spec)[0]) for spec in specs))
    faults = FaultSchedule([], np.random.default_rng(0))
    port = VirtualPort("main", directory / "port0", build(specs, backend), faults, wire_time=True)
    return VirtualServer([port], backend), backend


def _ids(text: str) -> list[int]:
    found: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        found += range(int(first), int(last or first) + 1)
    return found
