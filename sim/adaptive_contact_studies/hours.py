"""Whether a learner finds after hours what it found at first, on both engines.

An hour of one gait on flat ground, where every swing touches at one place; eight hours in half
hours of changing gaits, with three drifts that stay.  Learners begin with nothing.  Each stage is a
start of the robot's program; the learners go on.

``python -m adaptive_contact_studies.hours FOLDER [SHARE [WALK ...]]``: SHARE of these times, for a
try.
"""

from __future__ import annotations

import dataclasses
import itertools
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np
from rich.console import Console

from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactEvent
from adaptive_contact_bullet.gait import GAITS
from adaptive_contact_bullet.plant import Ground
from adaptive_contact_bullet.record import Plan, record
from adaptive_contact_bullet.robots import SHAPES
from adaptive_contact_sim import SimulationSettings, record_arrays, simulated_robot
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.scenario import parse_drift
from adaptive_contact_studies.evaluate import feed, samples_of, score_run
from adaptive_contact_studies.show.pages import row
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

_SECOND: Final = "bullet-"  # before the names of robots of the second engine
_PARTS: Final = 6  # of a walk of one stage
_SEED: Final = 77
_PAUSE_NS: Final = 60_000_000_000  # between stages


class Stage(NamedTuple):
    """One start of a robot."""

    robot: str
    gait: str
    seconds: float
    drifts: tuple[str, ...] = ()  # from its beginning on
    seed: int = _SEED


class Walk(NamedTuple):
    """Stages that one set of learners follows."""

    name: str
    stages: tuple[Stage, ...]


class Part(NamedTuple):
    """What the learners did in a part of a walk; all legs."""

    touches: int
    found: int
    alarms: int
    bytes: int  # of the learners, as pickled


def _hour(robot: str, gait: str) -> Walk:
    return Walk(f"{robot} {gait}, an hour", (Stage(robot, gait, 3600.0),))


def _day(robot: str, gaits: Sequence[str], drifts: Sequence[str]) -> Walk:
    """Plan eight hours in half hours; a drift after two, four and six hours."""
    return Walk(
        f"{robot}, eight hours",
        tuple(
            Stage(robot, gait, 1800.0, tuple(drifts[: k // 4]), _SEED + k)
            for k, gait in zip(range(16), itertools.cycle(gaits), strict=False)
        ),
    )


WALKS: Final = (
    _hour("hexapod", "tripod"),
    _hour("quadruped12", "trot"),
    _hour("bullet-hexapod", "tripod"),
    _hour("bullet-geared", "tripod"),
    _hour("bullet-quadruped", "trot"),
    _day(
        "hexapod", ("tripod", "ripple", "wave"),
        ("friction:value=2.5@0s", "supply:value=10.2@0s", "backlash:value=0.017@0s"),
    ),
    _day("bullet-hexapod", ("tripod", "ripple", "tripod-fast"), ("friction", "supply", "mass")),
)  # fmt: skip


def recorded(stage: Stage) -> tuple[Robot, Run]:
    """Record a stage on flat, hard ground."""
    if stage.robot.startswith(_SECOND):
        shape = SHAPES[stage.robot.removeprefix(_SECOND)]
        drifts = tuple((drift, 0.0) for drift in stage.drifts)
        plan = Plan(
            stage.robot.removeprefix(_SECOND), GAITS[stage.gait], Ground("hard"), stage.seconds,
            stage.seed, _SEED, drifts=drifts,  # type: ignore[arg-type]
        )  # fmt: skip
        return shape.description, record(plan).run
    settings = SimulationSettings.of(stage.robot, "walk", stage.gait)  # type: ignore[arg-type]
    settings = dataclasses.replace(
        settings, seed=stage.seed, robot_seed=_SEED,
        terrain=dataclasses.replace(settings.terrain, kind="flat"),
        drift=tuple(parse_drift(text) for text in stage.drifts),
    )  # fmt: skip
    return simulated_robot(stage.robot).description, record_arrays(settings, stage.seconds)


@rests_on("adaptive_contact_bullet", "adaptive_contact_studies.evaluate", *SIMULATOR, *LEARNER)
def followed(work: Work, walk: Walk) -> tuple[Part, ...]:
    """Follow a walk from nothing."""
    learners: list[ContactLearner] = []
    parts: list[Part] = []
    of_stage = _PARTS if len(walk.stages) == 1 else 1
    before_ns = 0  # from the first stage's beginning to this one's
    for number, stage in enumerate(walk.stages):
        robot, run = recorded(stage)
        legs = robot.leg_ids
        if not learners:
            learners += [ContactLearner(robot, leg) for leg in legs]
        streams = [
            [
                msgspec.structs.replace(sample, run=number, t_ns=sample.t_ns + before_ns)
                for sample in samples_of(run, leg)
            ]
            for leg in legs
        ]
        ends = [len(run.t_ns) * (k + 1) // of_stage - 1 for k in range(of_stage)]
        sizes: list[int] = []

        def weigh(k: int, ends: Sequence[int] = ends, sizes: list[int] = sizes) -> None:
            if k in ends:
                sizes.append(sum(len(pickle.dumps(one)) for one in learners))  # noqa: B023

        told = feed(learners, streams, weigh)
        events = {
            leg: [
                msgspec.structs.replace(
                    event, t_ns=event.t_ns - before_ns, onset_ns=event.onset_ns - before_ns
                )
                for event in own
            ]
            for leg, own in zip(legs, told, strict=True)
        }
        parts += _parts(run, robot, events, sizes)
        before_ns += int(run.t_ns[-1] - run.t_ns[0]) + _PAUSE_NS
    return tuple(parts)


def _parts(
    run: Run, robot: Robot, events: dict[str, list[ContactEvent]], sizes: Sequence[int]
) -> list[Part]:
    """Count what was found and what was false, in as many parts as there are sizes."""
    edges = np.linspace(run.t_ns[0], run.t_ns[-1], len(sizes) + 1)
    touches, found, alarms = (np.zeros(len(sizes), dtype=int) for _ in range(3))
    for outcome in score_run(run, robot, events):
        own = outcome.touches
        touches += np.histogram(own.onset_ns[own.counted], edges)[0]
        found += np.histogram(own.onset_ns[own.counted & own.found], edges)[0]
        alarms += np.histogram(outcome.alarms_ns, edges)[0]
    rows = zip(touches.tolist(), found.tolist(), alarms.tolist(), sizes, strict=True)
    return [Part(*of) for of in rows]


def table(walks: Sequence[Walk], followed: Sequence[Sequence[Part]]) -> str:
    """Write what was found as Markdown."""
    lines = [
        "| walk, from nothing | touches | found by parts, % | false alarms by parts "
        "| learners, kB |",
        "|---|---|---|---|---|",
    ]
    for walk, parts in zip(walks, followed, strict=True):
        lines.append(
            row(
                walk.name,
                str(sum(part.touches for part in parts)),
                ", ".join(f"{100 * part.found / max(part.touches, 1):.1f}" for part in parts),
                ", ".join(str(part.alarms) for part in parts),
                f"{parts[0].bytes / 1000:.0f} to {parts[-1].bytes / 1000:.0f}",
            )
        )
    return "\n".join(lines)


def main(arguments: list[str]) -> int:
    """Do what is asked for."""
    if not arguments or arguments[0].startswith("-"):
        print("expected FOLDER [SHARE [WALK ...]]", file=sys.stderr)
        return 2
    share = float(arguments[1]) if arguments[1:] else 1.0
    wanted = [
        walk._replace(
            stages=tuple(stage._replace(seconds=share * stage.seconds) for stage in walk.stages)
        )
        for walk in WALKS
        if not arguments[2:] or any(text in walk.name for text in arguments[2:])
    ]
    work = Work(Path(arguments[0]), 2, console=Console(stderr=True))
    seconds = [sum(stage.seconds for stage in walk.stages) for walk in wanted]
    weights = dict(zip(wanted, seconds, strict=True))
    made = work.each("walks", followed, wanted, weight=lambda walk: weights[walk])
    print(table(wanted, made))
    return 0


if __name__ == "__main__":
    # By its own name, which workers know: what is kept rests on the module's source.
    from adaptive_contact_studies import hours

    sys.exit(hours.main(sys.argv[1:]))
