"""Control loops as robots have them: late now and then, or slower by each delay.

``PYTHONPATH=tests .venv/bin/python -m field.sources [--seeds 5 6] [--only slips ...]`` prints for
each kind of loop how many touches the shipped baseline finds and how many alarms are false.

A loop is simulated: servos are read, and get their goals, as late as the stamps say; the gait
counts ticks.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from typing import Final

import msgpack
import msgspec
import numpy as np

from adaptive_contact import LearnerBank
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.score import Score, score_messages
from adaptive_contact.service.recording import Record
from adaptive_contact.wire import MSGPACK, ServoSample, servo_key, truth_key
from adaptive_contact_sim import TerrainSettings, WalkSettings
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.truth import TruthTracker

from . import mistakes as m

# How many periods after it was due tick 0, 1, ... is.
Late = Callable[[np.random.Generator, int], float]
STEP_S: Final = 0.001  # of the simulator's physics: lateness is a whole number of them


def one_in(each: int, periods: float) -> Late:
    """So much late in one tick of so many, at random."""
    return lambda rng, _: periods * (rng.random() < 1.0 / each)


# With whether a late tick puts off all that come after it, as in a loop that sleeps for a period.
LOOPS: Final[Mapping[str, tuple[Late, bool]]] = {
    "even": (lambda rng, k: 0.0, False),
    "late 0 to 0.25": (lambda rng, k: rng.uniform(0.0, 0.25), False),
    "two ways 0.25": (one_in(2, 0.25), False),
    "by turns 0.25": (lambda rng, k: 0.25 * (k % 2), False),
    "bursts of 5": (lambda rng, k: 0.25 * (k % 50 < 5), False),
    "one in 10 slips 0 to 0.25": (
        lambda rng, k: rng.uniform(0, 0.25) * (rng.random() < 0.1),
        True,
    ),
    "one in 20 slips 0.25": (one_in(20, 0.25), True),
    "one in 10 slips 0.25": (one_in(10, 0.25), True),
    "one in 4 slips 0.25": (one_in(4, 0.25), True),
    "every 4th slips 0.25": (lambda rng, k: 0.25 * (k % 4 == 3), True),
    "all slip 0 to 0.15": (lambda rng, k: rng.uniform(0.0, 0.15), True),
}


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


def late_loop(
    settings: SimulationSettings, seconds: float, late: Late, slips: bool
) -> list[m.Sent]:
    """A walk whose loop reads, writes and stamps that late; the first tick is on time."""
    loop = _Loop(settings)
    period, rng = round(settings.period_s / STEP_S), np.random.default_rng(settings.seed)
    off = np.array([late(rng, k) for k in range(round(seconds / settings.period_s) + 1)])
    off = np.round((np.cumsum(off) if slips else off) * period).astype(int)
    made: list[m.Sent] = []
    at, k, end = 0, 0, round(seconds / STEP_S)
    while at < end:
        k += 1
        then = max(k * period + max(0, int(off[k])), at + 1)
        loop.steps_of_tick = then - at
        tick = loop.tick()
        t_ns = settings.epoch_ns + at * round(STEP_S * 1e9)
        for leg, sample in tick.samples.items():
            body = msgspec.to_builtins(sample) | {"t_ns": t_ns}
            made.append(m.Sent(servo_key(leg), t_ns, body))
        for leg, truth in tick.truth:
            made.append(m.Sent(truth_key(leg), t_ns, msgspec.to_builtins(truth)))
        at = then
    return made


def play(sent: list[m.Sent], robot: Robot) -> Score:
    """Score what learners with the shipped baseline report of messages."""
    bank = LearnerBank(robot, shipped_baseline(robot.name))
    found = []
    for one in sent:
        if one.is_sample:
            found += bank.update({one.leg: msgspec.convert(one.body, ServoSample)})
    records = [Record(s.key, msgpack.packb(s.body), MSGPACK, s.at_ns, s.at_ns) for s in sent]
    return score_messages(records, robot, found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5])
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    options = parser.parse_args()
    for seed in options.seeds:
        for name, loop in LOOPS.items():
            if any(part in name for part in options.only):
                sent = late_loop(*walk_of(seed, options.seconds), *loop)
                total = play(sent, shipped_robot()).total
                found = f"{total.counted.found:5} of {total.counted.touches:5}"
                print(f"{f'{seed} {name}':36} {found} {total.false_alarms:4} false", flush=True)


if __name__ == "__main__":
    main()
