"""Sources as robots have them: stamps that are off, loops that are late, readings that are none.

``PYTHONPATH=tests .venv/bin/python -m field.sources [--kind stamps|loops|readings] [--seeds 5 6]
[--only slips ...]`` prints, for each kind of source, how many touches the shipped baseline finds
and how many alarms are false.

Stamps and readings are changed in the samples of a walk whose ticks are even.  A loop that is
late is simulated: servos are read, and get their goals, as late as the stamps say; the gait counts
ticks.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from adaptive_contact import LearnerBank
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.score import Score, score_messages
from adaptive_contact.wire import (
    ContactEvent,
    Message,
    ServoSample,
)
from adaptive_contact_sim import TerrainSettings, WalkSettings
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.simulation import Simulation, SimulationSettings, Tick
from adaptive_contact_sim.truth import TruthTracker
from scoring import messages

Angles = NDArray[np.float64]
# Of tick 0, 1, ...: how many periods after it was due.
Clock = Callable[[np.random.Generator], Iterator[float]]
STEP_RAD: Final = math.radians(300.0) / 1023
STEP_S: Final = 0.001  # of the simulator's physics: lateness is a whole number of them


def fixed(draw: Callable[[np.random.Generator, int], float]) -> Clock:
    """Ticks off a schedule to which the next ones return."""

    def made(rng: np.random.Generator) -> Iterator[float]:
        for k in itertools.count():
            yield draw(rng, k)

    return made


def slips(draw: Callable[[np.random.Generator, int], float]) -> Clock:
    """Ticks that put off all that come after them, as of a loop that sleeps for a period."""

    def made(rng: np.random.Generator) -> Iterator[float]:
        late = 0.0
        for k in itertools.count():
            late += draw(rng, k)
            yield late

    return made


def one_in(each: int, periods: float) -> Callable[[np.random.Generator, int], float]:
    """So much late in one tick of so many, at random."""
    return lambda rng, _: periods * (rng.random() < 1.0 / each)


def wander(periods: float, ticks: int) -> Clock:
    """A deviation that comes and goes in so many ticks: the clock that stamps drifts."""

    def made(rng: np.random.Generator) -> Iterator[float]:
        kept = np.exp(-1.0 / ticks)
        by = 0.0
        while True:
            by = kept * by + np.sqrt(1.0 - kept**2) * periods * rng.normal()
            yield by

    return made


_PI5_MS: Final = (8.312, 0.71, 6.19, 1.56, 5.4, 1.83, 5.79, 3.91, 3.45, 4.92)
_PI5: Final = np.cumsum([0.0, *(np.array(_PI5_MS[:-1]) / np.mean(_PI5_MS) - 1.0)]).tolist()

STAMPS: Final[Mapping[str, Clock]] = {
    "even": fixed(lambda rng, k: 0.0),
    "white 0.25": fixed(lambda rng, k: rng.normal(0.0, 0.25)),
    "white 0.4": fixed(lambda rng, k: rng.normal(0.0, 0.4)),
    "Pi 5": fixed(lambda rng, k: _PI5[k % len(_PI5)]),
    "by turns 0.4": fixed(lambda rng, k: 0.4 * (-1) ** k),
    "two ways 0.4": fixed(lambda rng, k: 0.4 * rng.choice([-1, 1])),
    "batches of three": fixed(lambda rng, k: (0.67, 0.0, -0.67)[k % 3]),
    "bursts of 5": fixed(lambda rng, k: rng.normal(0.0, 0.4) if k % 50 < 5 else 0.0),
    "one in 50 a period late": fixed(lambda rng, k: float(rng.random() < 0.02)),
    "wander 0.4 in 10": wander(0.4, 10),
    "wander 0.4 in 100": wander(0.4, 100),
    "saw of 0.8 in 40": fixed(lambda rng, k: 0.8 * (k % 40) / 40),
}
LOOPS: Final[Mapping[str, Clock]] = {
    "even": fixed(lambda rng, k: 0.0),
    "late 0 to 0.25": fixed(lambda rng, k: rng.uniform(0.0, 0.25)),
    "two ways 0.25": fixed(lambda rng, k: 0.25 * (rng.random() < 0.5)),
    "by turns 0.25": fixed(lambda rng, k: 0.25 * (k % 2)),
    "bursts of 5": fixed(lambda rng, k: 0.25 * (k % 50 < 5)),
    "one in 10 slips 0 to 0.25": slips(lambda rng, k: rng.uniform(0, 0.25) * (rng.random() < 0.1)),
    "one in 20 slips 0.25": slips(one_in(20, 0.25)),
    "one in 10 slips 0.25": slips(one_in(10, 0.25)),
    "one in 4 slips 0.25": slips(one_in(4, 0.25)),
    "every 4th slips 0.25": slips(lambda rng, k: 0.25 * (k % 4 == 3)),
    "all slip 0 to 0.15": slips(lambda rng, k: rng.uniform(0.0, 0.15)),
}


# Of the right readings of a leg's tick: what the source sends; one in so many is bad.
Read = Callable[[Angles], Angles]
Bad = Callable[[np.random.Generator, float], Read]
_LOWEST_RAD: Final = math.radians(-150.0)  # raw step 0 of an AX-12A


def each_joint(change: Callable[[float, np.random.Generator], float]) -> Bad:
    """A fault of one servo's answer, by itself."""

    def made(rng: np.random.Generator, share: float) -> Read:
        def read(angles: Angles) -> Angles:
            hit = rng.random(len(angles)) < share
            return np.array([change(x, rng) if h else x for x, h in zip(angles, hit, strict=True)])

        return read

    return made


def whole_leg(change: Read) -> Bad:
    """A fault of all that is read in a tick."""
    return lambda rng, share: lambda angles: change(angles) if rng.random() < share else angles


def held(ticks: int) -> Bad:
    """A joint's last value, that so many ticks keep; as often begun as the others are bad."""

    def made(rng: np.random.Generator, share: float) -> Read:
        left, kept = np.zeros(3, dtype=int), np.zeros(3)

        def read(angles: Angles) -> Angles:
            nonlocal left, kept
            begin = (left == 0) & (rng.random(len(angles)) < share)
            left = np.where(begin, ticks, left)
            sent = np.where(left > 0, kept, angles)
            left = np.maximum(left - 1, 0)
            kept = sent
            return np.asarray(sent)

        return read

    return made


READINGS: Final[Mapping[str, Bad]] = {
    "none": whole_leg(lambda angles: angles),
    "raw 0": each_joint(lambda x, rng: _LOWEST_RAD),
    "0 rad": each_joint(lambda x, rng: 0.0),
    "0.3 rad": each_joint(lambda x, rng: 0.3),
    "all joints 0 rad": whole_leg(np.zeros_like),
    "all joints raw 0": whole_leg(lambda angles: np.full_like(angles, _LOWEST_RAD)),
    "a turn off": each_joint(lambda x, rng: x + math.tau * rng.choice([-1, 1])),
    "0, raw 0, 0.3 by turns": each_joint(lambda x, rng: float(rng.choice([0.0, _LOWEST_RAD, 0.3]))),
    "sign": each_joint(lambda x, rng: -x),
    "femur and tibia swapped": whole_leg(lambda angles: angles[[0, 2, 1]]),
    "degrees": whole_leg(np.degrees),
    "0.3 rad off": each_joint(lambda x, rng: x + 0.3 * rng.choice([-1, 1])),
    "a bit flipped": each_joint(
        lambda x, rng: (
            (round((x - _LOWEST_RAD) / STEP_RAD) ^ (1 << int(rng.integers(10)))) * STEP_RAD
            + _LOWEST_RAD
        )
    ),
    "held for 2 ticks": held(1),
    "held for 3 ticks": held(2),
    "held for 5 ticks": held(4),
}


@dataclass(frozen=True)
class Played:
    """A source's samples and touches, and what learners make of them."""

    samples: list[dict[str, ServoSample]]  # of a tick, by leg
    truth: list[tuple[str, Message]]

    def events(self, bank: LearnerBank) -> list[ContactEvent]:
        """What the learners report."""
        return [event for tick in self.samples for event in bank.update(tick)]


class _Loop(Simulation):
    """A simulation whose control loop makes ticks of any whole number of physics steps."""

    def __init__(self, settings: SimulationSettings) -> None:
        super().__init__(settings)
        plant: Plant = self.plant
        self._whole_tick = plant.substeps
        plant.substeps, plant.sensed = 1, plant.sensed[-1:].copy()
        plant.forces = plant.forces[-1:].copy()
        self.truth = TruthTracker(plant.step_s, 1, len(self.layout.legs))
        self._opening = self.truth.start(plant.forces[0], 0)
        self.steps_of_tick = self._whole_tick

    def advance(self) -> None:
        super().advance()
        for _ in range(self.steps_of_tick - 1):
            self.plant.advance()
            self.changes += self.truth.update(
                self.plant.forces, self.plant.touches, self.plant.steps
            )


def walk_of(seed: int, seconds: float, ground: str = "rough") -> tuple[SimulationSettings, float]:
    """Settings of the walk that is played."""
    terrain = TerrainSettings(kind=ground)  # type: ignore[arg-type]
    return SimulationSettings(motion=WalkSettings(), terrain=terrain, seed=seed, run=1), seconds


def late_loop(settings: SimulationSettings, seconds: float, clock: Clock) -> Played:
    """A walk whose loop reads, writes and stamps as late as a clock says."""
    rng = np.random.default_rng(settings.seed)
    loop = _Loop(settings)
    period = round(settings.period_s / STEP_S)
    samples: list[dict[str, ServoSample]] = []
    truth: list[tuple[str, Message]] = []
    late = (max(0, round(by * period)) for by in clock(rng))
    at, k, end = 0, 0, round(seconds / STEP_S)
    next(late)  # the first tick is on time
    while at < end:
        k += 1
        then = max(k * period + next(late), at + 1)
        loop.steps_of_tick = then - at
        tick: Tick = loop.tick()
        t_ns = settings.epoch_ns + at * round(STEP_S * 1e9)
        samples.append(
            {leg: msgspec.structs.replace(s, t_ns=t_ns) for leg, s in tick.samples.items()}
        )
        truth += tick.truth
        at = then
    return Played(samples, truth)


def stamped(played: Played, clock: Clock, period_ns: int, seed: int = 1) -> Played:
    """The same samples, of which only the stamps are off; all legs' of a tick alike."""
    made, newest = [], -1
    for tick, by in zip(played.samples, clock(np.random.default_rng(seed)), strict=False):
        (due_ns,) = {sample.t_ns for sample in tick.values()}
        # Ten periods later, so that none is before zero.
        newest = max(newest + 1, due_ns + round((10.0 + by) * period_ns))
        made.append({leg: msgspec.structs.replace(s, t_ns=newest) for leg, s in tick.items()})
    return Played(made, played.truth)


def misread(played: Played, bad: Bad, share: float, seed: int = 1) -> Played:
    """The same samples, some of which hold what is no reading."""
    rng = np.random.default_rng(seed)
    ways = {leg: bad(rng, share) for leg in played.samples[0]}
    made = []
    for tick in played.samples:
        row = {}
        for leg, sample in tick.items():
            read = ways[leg](np.array(sample.measured))
            row[leg] = msgspec.structs.replace(sample, measured=read.tolist())
        made.append(row)
    return Played(made, played.truth)


def play(played: Played, robot: Robot, origin: Played | None = None) -> Score:
    """Score what learners with the shipped baseline report.

    Args:
        played: what they are given.
        robot: its description.
        origin: the same samples with right stamps, where the given ones are wrong.
    """
    bank = LearnerBank(robot, shipped_baseline(robot.name))
    found = played.events(bank)
    right = origin or played
    at = {(leg, s.seq): s.t_ns for tick in right.samples for leg, s in tick.items()}
    given = {(leg, s.seq): s.t_ns for tick in played.samples for leg, s in tick.items()}
    shifted = [
        msgspec.structs.replace(
            one,
            t_ns=at[one.leg, one.seq],
            onset_ns=one.onset_ns + at[one.leg, one.seq] - given[one.leg, one.seq],
        )
        for one in found
    ]
    samples = [(leg, sample) for tick in right.samples for leg, sample in tick.items()]
    return score_messages(messages(samples, right.truth), robot, shifted)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5])
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--only", nargs="*", default=[], help="parts of names")
    parser.add_argument("--kind", choices=["stamps", "loops", "readings"])
    options = parser.parse_args()
    robot = shipped_robot()
    period_ns = round(robot.period_s * 1e9)

    for seed in options.seeds:
        settings, seconds = walk_of(seed, options.seconds)
        even = late_loop(settings, seconds, LOOPS["even"])
        made: list[tuple[str, str, Callable[[], Played], Played | None]] = [
            *(
                ("stamps", f"stamps: {name}", partial(stamped, even, clock, period_ns), even)
                for name, clock in STAMPS.items()
            ),
            *(
                ("loops", f"loop: {name}", partial(late_loop, settings, seconds, clock), None)
                for name, clock in LOOPS.items()
            ),
            *(
                ("readings", f"1 in {each}: {name}", partial(misread, even, bad, 1.0 / each), None)
                for name, bad in READINGS.items()
                for each in (200, 50)
            ),
        ]
        for kind, name, make, origin in made:
            chosen = not options.only or any(part in name for part in options.only)
            if chosen and options.kind in (None, kind):
                total = play(make(), robot, origin).total
                found = f"{total.counted.found:5} of {total.counted.touches:5}"
                print(f"{f'{seed} {name}':36} {found} {total.false_alarms:4} false", flush=True)


if __name__ == "__main__":
    main()
