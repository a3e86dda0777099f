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
import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import msgpack
import msgspec
import numpy as np
from scipy.signal import lfilter

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


def wander(periods: float, ticks: int) -> Late:
    """A deviation that comes and goes in so many ticks: the clock that stamps drifts."""
    kept = math.exp(-1.0 / ticks)
    drawn = np.random.default_rng(1).normal(0.0, periods * math.sqrt(1.0 - kept**2), 100_000)
    by = lfilter([1.0], [1.0, -kept], drawn)
    return lambda _, k: float(by[k])


_PI5_MS: Final = (8.312, 0.71, 6.19, 1.56, 5.4, 1.83, 5.79, 3.91, 3.45, 4.92)
_PI5: Final = np.cumsum([0.0, *(np.array(_PI5_MS[:-1]) / np.mean(_PI5_MS) - 1.0)]).tolist()

STAMPS: Final[Mapping[str, Late]] = {
    "even": lambda rng, k: 0.0,
    "white 0.25": lambda rng, k: rng.normal(0.0, 0.25),
    "white 0.4": lambda rng, k: rng.normal(0.0, 0.4),
    "Pi 5": lambda rng, k: _PI5[k % len(_PI5)],
    "by turns 0.4": lambda rng, k: 0.4 * (-1) ** k,
    "two ways 0.4": lambda rng, k: 0.4 * rng.choice([-1, 1]),
    "batches of three": lambda rng, k: (0.67, 0.0, -0.67)[k % 3],
    "bursts of 5": lambda rng, k: rng.normal(0.0, 0.4) if k % 50 < 5 else 0.0,
    "one in 50 a period late": one_in(50, 1.0),
    "wander 0.4 in 10": wander(0.4, 10),
    "wander 0.4 in 100": wander(0.4, 100),
    "saw of 0.8 in 40": lambda rng, k: 0.8 * (k % 40) / 40,
}
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

# Of a share of readings: a source that sends something else in their place.
Bad = Callable[[float], m.Mistake]
_LOWEST_RAD: Final = math.radians(-150.0)  # raw step 0 of an AX-12A


def each_joint(change: Callable[[float, np.random.Generator], float]) -> Bad:
    """A fault of one servo's answer, by itself."""
    return lambda share: m.misread(share, change)


def whole_leg(change: Callable[[m.Angles], m.Angles]) -> Bad:
    """A fault of all that is read in a tick."""

    def made(share: float) -> m.Mistake:
        return m.each_sample(
            lambda sent, rng: (
                sent.but(measured=change(sent.body["measured"])) if rng.random() < share else sent
            )
        )

    return made


def stuck(ticks: int) -> Bad:
    """A joint's last value, that so many more ticks keep; as often begun as the others are bad."""

    def made(share: float) -> m.Mistake:
        def changed(sent: m.Sent, rng: np.random.Generator, kept: dict[Any, Any]) -> m.Sent:
            row = list(sent.body["measured"])
            for joint, now in enumerate(row):
                left, value = kept.get((sent.leg, joint), (0, now))
                left = left or ticks * int(rng.random() < share)
                row[joint] = value if left else now
                kept[sent.leg, joint] = max(left - 1, 0), row[joint]
            return sent.but(measured=row)

        return m.remembering(changed)

    return made


def _flipped(x: float, rng: np.random.Generator) -> float:
    raw = round((x - _LOWEST_RAD) / m.AX12_STEP) ^ (1 << int(rng.integers(10)))
    return raw * m.AX12_STEP + _LOWEST_RAD


READINGS: Final[Mapping[str, Bad]] = {
    "none": each_joint(lambda x, rng: x),
    "raw 0": each_joint(lambda x, rng: _LOWEST_RAD),
    "0 rad": each_joint(lambda x, rng: 0.0),
    "0.3 rad": each_joint(lambda x, rng: 0.3),
    "all joints 0 rad": whole_leg(lambda row: [0.0] * len(row)),
    "all joints raw 0": whole_leg(lambda row: [_LOWEST_RAD] * len(row)),
    "a turn off": each_joint(lambda x, rng: x + math.tau * rng.choice([-1, 1])),
    "0, raw 0, 0.3 by turns": each_joint(lambda x, rng: float(rng.choice([0.0, _LOWEST_RAD, 0.3]))),
    "sign": each_joint(lambda x, rng: -x),
    "femur and tibia swapped": whole_leg(lambda row: [row[0], row[2], row[1]]),
    "degrees": whole_leg(lambda row: [math.degrees(x) for x in row]),
    "0.3 rad off": each_joint(lambda x, rng: x + 0.3 * rng.choice([-1, 1])),
    "a bit flipped": each_joint(_flipped),
    "held for 2 ticks": stuck(1),
    "held for 3 ticks": stuck(2),
    "held for 5 ticks": stuck(4),
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


def play(sent: list[m.Sent], robot: Robot, right: list[m.Sent] | None = None) -> Score:
    """Score what learners with the shipped baseline report.

    Args:
        sent: what they are given.
        robot: its description.
        right: the same messages with right stamps, where the given ones are wrong.
    """
    bank = LearnerBank(robot, shipped_baseline(robot.name))
    right = right or sent
    found = []
    for given, at in zip(sent, right, strict=True):
        if given.is_sample:
            off_ns = at.body["t_ns"] - given.body["t_ns"]
            for one in bank.update({given.leg: msgspec.convert(given.body, ServoSample)}):
                found.append(
                    msgspec.structs.replace(
                        one, t_ns=one.t_ns + off_ns, onset_ns=one.onset_ns + off_ns
                    )
                )
    records = [Record(s.key, msgpack.packb(s.body), MSGPACK, s.at_ns, s.at_ns) for s in right]
    return score_messages(records, robot, found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[5])
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--only", nargs="*", default=[], help="parts of names")
    parser.add_argument("--kind", choices=["stamps", "loops", "readings"])
    options = parser.parse_args()
    robot = shipped_robot()
    all_of: dict[tuple[str, str], Any] = {
        **{("stamps", f"stamps: {name}"): m.stamped(late) for name, late in STAMPS.items()},
        **{("loops", f"loop: {name}"): loop for name, loop in LOOPS.items()},
        **{
            ("readings", f"1 in {each}: {name}"): bad(1.0 / each)
            for name, bad in READINGS.items()
            for each in (200, 50)
        },
    }
    for seed in options.seeds:
        settings, seconds = walk_of(seed, options.seconds)
        even = late_loop(settings, seconds, *LOOPS["even"])
        for (kind, name), made in all_of.items():
            if options.kind not in (None, kind):
                continue
            if options.only and not any(part in name for part in options.only):
                continue
            if kind == "loops":
                sent = late_loop(settings, seconds, *made)
            else:
                sent = list(made(even, np.random.default_rng(1)))
            total = play(sent, robot, even if kind == "stamps" else None).total
            found = f"{total.counted.found:5} of {total.counted.touches:5}"
            print(f"{f'{seed} {name}':36} {found} {total.false_alarms:4} false", flush=True)


if __name__ == "__main__":
    main()
