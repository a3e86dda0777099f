"""What the check of a source finds, and whom it accuses: the price list of readings that are false.

    PYTHONPATH=tests python -m field.lies [--lies 200] [--seconds 30] [--real ../shared/data]

Honest legs: the shipped robots, the second engine where pybullet is installed, servos of first
order with delays, play and steps, real logs where they are.  Lies: drawn at random from `KINDS`,
laid over a leg that walks from the start or from some moment on, in all joints or one.  Each leg is
followed by a learner, with its baseline or without.  One table is printed, and is the test.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.checks.information import low_pass
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.robot import Robot, inverse, load_robot, parse_robot

from . import mistakes

Array = np.ndarray
FOUND, OVER = 3, 5  # swings
ROBOTS = ("hexapod", "quadruped12", "leg5")


class Stream(NamedTuple):
    """What one leg sends, and who it is."""

    name: str
    robot: Robot
    leg: str
    baseline: Baseline | None
    samples: list[ServoSample]
    walks: bool = True


class Lie(NamedTuple):
    """One kind of lie: what is to be said of it, and what it makes of readings and commands."""

    words: str
    make: Callable[[Array, Array, float, np.random.Generator], Array]


def delayed(u: Array, ticks: float) -> Array:
    k = np.arange(len(u))
    return np.stack([np.interp(k - ticks, k, of) for of in u.T], axis=1)


def rounded(y: Array, step: float) -> Array:
    return np.asarray(np.round(y / step) * step)


def _copy(
    u: Array, step: float, rng: np.random.Generator, *, moved: float = 0.0, scale: float = 1.0,
    noise: float = 0.0, pole: float = 0.0,
) -> Array:  # fmt: skip
    y = delayed(u, float(rng.choice([rng.integers(0, 13), rng.uniform(0, 12)])))
    y = (
        scale * (low_pass(y, (pole,))[0] if pole else y)
        + moved
        + noise * rng.standard_normal(u.shape)
    )
    return rounded(y, step) if step and rng.random() < 0.5 else y


_COPIED: Final = "copies desired"
KINDS: Final[dict[str, Lie]] = {
    "late": Lie(_COPIED, lambda _, u, s, r: _copy(u, s, r)),
    "moved": Lie(_COPIED, lambda _, u, s, r: _copy(u, s, r, moved=r.uniform(-0.05, 0.05))),
    "scaled": Lie(_COPIED, lambda _, u, s, r: _copy(u, s, r, scale=r.uniform(0.5, 1.1))),
    "noisy": Lie(_COPIED, lambda _, u, s, r: _copy(u, s, r, noise=r.uniform(0.0, 1.0) * s)),
    "filtered": Lie(_COPIED, lambda _, u, s, r: _copy(u, s, r, pole=r.uniform(0.2, 0.9))),
    "blended": Lie(
        _COPIED, lambda _, u, s, r: rounded((delayed(u, r.integers(6)) + _copy(u, 0.0, r)) / 2, s)
    ),
    "held": Lie("held", lambda y, _, s, r: held(y, int(r.integers(3, 9)))),
    "old": Lie("earlier desired", lambda y, _, s, r: delayed(y, int(r.integers(30, 80)))),
}


def held(y: Array, ticks: int) -> Array:
    return y[ticks * (np.arange(len(y)) // ticks)]


# -- honest legs -----------------------------------------------------------------------------------


def simulated(seconds: float, seed: int, robots: Sequence[str] = ROBOTS) -> Iterator[Stream]:
    """The shipped robots in the simulator."""
    from adaptive_contact_sim import SimulationSettings, record_arrays, simulated_robot

    for kind in robots:
        robot = simulated_robot(kind).description
        settings = SimulationSettings.from_robot(kind, "pose" if kind == "leg5" else "walk")
        run = record_arrays(dataclasses.replace(settings, seed=seed), seconds)
        baseline = shipped_baseline(robot.name)
        for leg, of in run.legs.items():
            yield Stream(
                kind, robot, leg, baseline, as_samples(robot, of.measured, of.desired, of.swing)
            )


SECOND: Final = {
    "hexapod": "tripod", "light": "ripple", "worm": "tripod", "quadruped": "trot", "arm": "steps",
}  # fmt: skip


def second_engine(
    seconds: float, seed: int, kinds: Sequence[str] = tuple(SECOND)
) -> Iterator[Stream]:
    """Robots of the second engine; none where it is not installed."""
    try:
        import pybullet  # noqa: F401
    except ImportError:
        return
    from adaptive_contact_bullet.gait import GAITS
    from adaptive_contact_bullet.plant import Ground
    from adaptive_contact_bullet.record import Plan, record

    for kind in kinds:
        ground = Ground("none" if kind == "arm" else "flat")
        plates = 0.5 * (kind == "arm")
        run = record(Plan(kind, GAITS[SECOND[kind]], ground, seconds, seed, plates=plates))
        robot = run.shape.description
        for leg, of in run.run.legs.items():
            made = as_samples(robot, of.measured, of.desired, of.swing)
            yield Stream(f"second {kind}", robot, leg, None, made)


def drawn(swings: int, seed: int) -> Iterator[Stream]:
    """A leg that was drawn, which steps or goes from point to point; none that diverges."""
    from adaptive_contact_sim.plant import SimulationDivergedError
    from adaptive_contact_studies.family.legs import draw_leg, record

    leg = draw_leg(seed, second=seed % 2 == 1)
    try:
        run = record(leg, "gait" if seed % 4 < 2 else "pose", swings, seed, plates=0.8)
    except SimulationDivergedError:
        return
    robot = leg.robot
    for name, of in run.legs.items():
        made = as_samples(robot, of.measured, of.desired, of.swing)
        yield Stream("drawn", robot, name, None, made)


def first_order(seconds: float, seed: int) -> Iterator[Stream]:
    """Light servos that follow closely, with load in stance: delays, play, steps."""
    for delay, play, step in itertools.product(
        range(5), (0.0, 0.5, 2.0), (2 * math.pi / 1024, 2 * math.pi / 4096, 1e-7)
    ):
        described = max(step, 1e-4)
        robot = parse_robot(
            f'[robot]\nname = "light"\nperiod_s = 0.02\nquantum_rad = {described}\n[[leg]]\n'
            'id = "a"\njoints = ["coxa", "femur", "tibia"]\nlengths_m = [0.052, 0.066, 0.138]\n',
            source="light",
        )
        rng = np.random.default_rng([seed, delay, round(10 * play), round(1e7 * step)])
        made = _light(round(seconds / 0.02), rng, delay, math.radians(play), step)
        yield Stream("first order", robot, "a", None, as_samples(robot, *made))


def _light(
    ticks: int, rng: np.random.Generator, delay: int, play: float, step: float
) -> tuple[Array, Array, Array]:
    lengths = (0.052, 0.066, 0.138)
    at, rows, swing = np.array([0.16, 0.0, -0.1]), list[Array](), list[bool]()
    while len(rows) < ticks:
        to = np.array([0.16, 0.0, -0.1]) + rng.uniform(-0.03, 0.03, 3) * [1, 1, 0.3]
        for k in range(28):
            x = (1 - math.cos(math.pi * k / 27)) / 2
            point = at + x * (to - at) + [0, 0, 0.06 * math.sin(math.pi * k / 27)]
            rows.append(inverse(point, lengths))
            swing.append(True)
        for k in range(24):  # the body goes on
            rows.append(inverse(to - [0, 0.001 * k, 0], lengths))
            swing.append(False)
        at = to - [0, 0.023, 0]
    u = np.array(rows[:ticks])
    load, motor, out, y = np.zeros(3), u[0].copy(), u[0].copy(), np.zeros_like(u)
    for k in range(ticks):
        y[k] = out
        weight = 0.0 if swing[k] else rng.uniform(0.5, 1.5)
        load += 0.3 * (weight * np.array([0.01, 0.02, 0.02]) - load)
        motor = motor + 0.95 * (u[max(k - delay, 0)] - motor)
        out = np.clip(out, motor + load - play / 2, motor + load + play / 2)
    return rounded(y + 0.3 * step * rng.standard_normal(y.shape), step), u, np.array(swing[:ticks])


def real(folder: Path) -> Iterator[Stream]:
    """Real logs, where they are."""
    dyna, field = folder / "dyna1", folder.parent / "field" / "dackel"
    for path, toml in (
        (dyna / "ground.mcap", dyna / "ground.toml"), (dyna / "hung.mcap", dyna / "hung.toml"),
        (field / "hung.mcap", field / "robot.toml"),
    ):  # fmt: skip
        if not path.exists():
            continue
        robot = load_robot(toml)
        by_leg: dict[str, list[ServoSample]] = {leg: [] for leg in robot.leg_ids}
        for sent in mistakes.read(path):
            if sent.is_sample:
                by_leg[sent.leg].append(msgspec.convert(sent.body, ServoSample))
        for leg, samples in by_leg.items():
            yield Stream(f"real {path.parent.name} {path.stem}", robot, leg, None, samples, False)


def as_samples(robot: Robot, measured: Array, desired: Array, swing: Array) -> list[ServoSample]:
    period_ns = round(robot.period_s * 1e9)
    return [
        ServoSample(
            t_ns=k * period_ns, seq=k, measured=m, desired=d, phase="swing" if s else "stance"
        )
        for k, (m, d, s) in enumerate(
            zip(measured.tolist(), desired.tolist(), swing.tolist(), strict=True)
        )
    ]


# -- the list --------------------------------------------------------------------------------------


class Told(NamedTuple):
    """What became of one lie."""

    kind: str
    named: bool  # with its cause, within three swings
    contacts: int  # sent while it lasted, after its third swing
    right_again: bool  # within five swings of its end
    of: str


class Honest(NamedTuple):
    """What became of one honest leg."""

    name: str
    seconds: float
    doubted: bool
    words: str = ""  # of the first note on its source

    @property
    def hours(self) -> float:
        return self.seconds / 3600.0


def follow_honest(stream: Stream, *, fitted: bool) -> Honest:
    """Have a learner follow an honest leg."""
    learner = ContactLearner(stream.robot, stream.leg, stream.baseline if fitted else None)
    doubted, words = False, ""
    for sample in stream.samples:
        learner.update(sample)
        doubted |= learner.report.doubt in ("echo", "stale")
        if sample.phase == "swing":
            source = learner.report.source
            words = words or source.note or source.limits_note or ""
    seconds = len(stream.samples) * stream.robot.period_s
    return Honest(stream.name, seconds, doubted, words)


def draw(
    stream: Stream, kind: str, rng: np.random.Generator
) -> tuple[list[ServoSample], int, int, list[int]]:
    """Lay a lie over a stream; the samples, from which to which it lasts, and its joints."""
    n, step = len(stream.samples), stream.robot.quantum(stream.leg)
    u = np.array([s.desired for s in stream.samples])
    y = np.array([s.measured for s in stream.samples])
    x = KINDS[kind].make(y, u, step, rng)
    begin = 0 if rng.random() < 0.3 else int(rng.integers(n // 3, n // 2))
    end = begin + n // 3
    joints = list(range(y.shape[1]))
    if kind not in ("held", "old", "noisy") and rng.random() < 0.5:
        # A joint that hardly moves says nothing.
        lively = np.flatnonzero(np.diff(u[begin:end], axis=0).std(axis=0) > 3.0 * step)
        joints = [int(rng.choice(lively))] if len(lively) else joints
    y[begin:end, joints] = x[begin:end, joints]
    made = [
        msgspec.structs.replace(s, measured=row)
        for s, row in zip(stream.samples, y.tolist(), strict=True)
    ]
    return made, begin, end, joints


def tell(stream: Stream, kind: str, rng: np.random.Generator, *, fitted: bool) -> Told:
    """Have a learner follow a leg that lies for a third of the time."""
    samples, begin, end, joints = draw(stream, kind, rng)
    learner = ContactLearner(stream.robot, stream.leg, stream.baseline if fitted else None)
    swings = over = contacts = since = 0
    named = right = False
    before: str | None = None
    for k, sample in enumerate(samples):
        event = learner.update(sample)
        ended = before == "swing" and sample.phase == "stance"
        begun = before == "stance" and sample.phase == "swing"
        before = sample.phase
        if begin <= k < end:
            swings, since = swings + begun, 0 if begun else since + 1
            # What is found as the next swing begins holds from the tick after.
            if swings <= FOUND or (swings == FOUND + 1 and since <= 1):
                note = learner.report.source.note or ""
                # From the start on, a leg that has never shown itself may as well carry nothing.
                named |= KINDS[kind].words in note or (begin == 0 and "nothing tells" in note)
            elif event is not None and event.contact:
                contacts += 1
        elif k >= end:
            over += ended
            right |= over <= OVER and learner.report.source.cause is None
    where = f"{stream.name} {stream.leg}, {'fitted' if fitted else 'cold'}, from {begin}, {joints}"
    return Told(kind, named, contacts, right, where)


def price(told: list[Told], honest: list[Honest]) -> str:
    """Print both columns in one table."""
    by_kind = {kind: [t for t in told if t.kind == kind] for kind in KINDS} | {"all": told}
    by_name = {h.name: [of for of in honest if of.name == h.name] for h in honest}
    return "\n".join(
        [
            "| lies | named in 3 swings | contacts after them | right again in 5 |",
            "|---|---|---|---|",
            *(
                f"| {kind} | {sum(t.named for t in of)} of {len(of)} | "
                f"{sum(t.contacts for t in of)} | {sum(t.right_again for t in of)} |"
                for kind, of in by_kind.items()
                if of
            ),
            "",
            "| honest legs | legs | leg-minutes | doubted |",
            "|---|---|---|---|",
            *(
                f"| {name} | {len(of)} | {60.0 * sum(h.hours for h in of):.1f} | "
                f"{sum(h.doubted for h in of)} |"
                for name, of in by_name.items()
            ),
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lies", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--real", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    made = [
        list(of(options.seconds, options.seed)) for of in (simulated, second_engine, first_order)
    ]
    walkers = [stream for group in made[:2] for stream in group]
    streams = [*itertools.chain(*made), *real(options.real)]
    honest = [
        follow_honest(stream, fitted=fitted)
        for stream in streams
        for fitted in ([True, False] if stream.baseline else [False])
    ]
    kinds = list(KINDS)
    told = []
    for k in range(options.lies):
        stream = walkers[int(rng.integers(len(walkers)))]
        fitted = stream.baseline is not None and rng.random() < 0.7
        told.append(tell(stream, kinds[k % len(kinds)], rng, fitted=fitted))
    print(price(told, honest))
    for t in told:
        if not (t.named and t.right_again) or t.contacts:
            print(t)


if __name__ == "__main__":
    main()
