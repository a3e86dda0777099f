"""Whether a learner finds after hours what it found at first, on both engines.

An hour of one gait on flat ground, where every swing touches at one place; eight hours in half
hours of changing gaits, with three drifts that stay.  Learners begin with nothing.  Each stage is a
start of the robot's program; the learners go on, and are kept: a walk that is interrupted goes on
with the stage that it was in.

``python -m adaptive_contact_studies.hours FOLDER [SHARE [WALK ...]]``: SHARE of these times, for a
try.
"""

from __future__ import annotations

import dataclasses
import itertools
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import typer

from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.robot import Robot
from adaptive_contact_bullet.gait import GAITS
from adaptive_contact_bullet.plant import Ground
from adaptive_contact_bullet.record import Plan, record
from adaptive_contact_bullet.robots import SHAPES
from adaptive_contact_sim import SimulationSettings, record_arrays, simulated_robot
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.scenario import parse_drift
from adaptive_contact_studies.evaluate import feed, parts_of, samples_of, score_run
from adaptive_contact_studies.show.pages import row
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

_SECOND: Final = "bullet-"  # before the names of robots of the second engine
_HOUR: Final = ", an hour"  # ends the name of a walk of one stage, counted by parts
_PARTS: Final = 6
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
    return Walk(f"{robot} {gait}{_HOUR}", (Stage(robot, gait, 3600.0),))


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


class Followed(NamedTuple):
    """How far a walk has been followed."""

    learners: tuple[ContactLearner, ...]  # as they are then, together: they share their arrays
    parts: tuple[Part, ...]
    after_ns: int  # from the walk's beginning to that of the next stage


def recorded(stage: Stage) -> tuple[Robot, Run]:
    """Record a stage on flat, hard ground."""
    name = stage.robot.removeprefix(_SECOND)
    if name != stage.robot:
        drifts: Any = tuple((drift, 0.0) for drift in stage.drifts)
        plan = Plan(
            name, GAITS[stage.gait], Ground("hard"), stage.seconds, stage.seed, _SEED, drifts=drifts
        )
        return SHAPES[name].description, record(plan).run
    settings = SimulationSettings.from_robot(name, "walk", stage.gait)  # type: ignore[arg-type]
    settings = dataclasses.replace(
        settings, seed=stage.seed, robot_seed=_SEED,
        terrain=dataclasses.replace(settings.terrain, kind="flat"),
        drift=tuple(parse_drift(text) for text in stage.drifts),
    )  # fmt: skip
    return simulated_robot(name).description, record_arrays(settings, stage.seconds)


@rests_on("adaptive_contact_bullet", "adaptive_contact_studies.evaluate", *SIMULATOR, *LEARNER)
def followed(work: Work, walk: Walk) -> Followed:
    """Follow a walk from nothing; what was kept of its first stages is not followed again."""
    *earlier, stage = walk.stages
    # One recording at a time is in memory.
    before = work.one(followed, walk._replace(stages=tuple(earlier))) if earlier else None
    robot, run = recorded(stage)
    standing = Standing()
    learners, parts, after_ns = before or Followed(
        tuple(ContactLearner(robot, leg, standing=standing) for leg in robot.leg_ids), (), 0
    )
    streams = [
        [
            msgspec.structs.replace(sample, run=len(earlier), t_ns=sample.t_ns + after_ns)
            for sample in samples_of(run, leg)
        ]
        for leg in robot.leg_ids
    ]
    count = _PARTS if walk.name.endswith(_HOUR) else 1
    ends = {len(run.t_ns) * (k + 1) // count - 1 for k in range(count)}
    sizes: list[int] = []

    def weigh(k: int) -> None:
        if k in ends:
            sizes.append(sum(len(pickle.dumps(learner)) for learner in learners))

    told = feed(learners, streams, weigh)
    events = {
        leg: [
            msgspec.structs.replace(
                event, t_ns=event.t_ns - after_ns, onset_ns=event.onset_ns - after_ns
            )
            for event in own
        ]
        for leg, own in zip(robot.leg_ids, told, strict=True)
    }
    after_ns += int(run.t_ns[-1] - run.t_ns[0]) + _PAUSE_NS
    summaries = parts_of(run, score_run(run, robot, events), count)
    made = [
        Part(one.counted.touches, one.counted.found, one.false_alarms, size)
        for one, size in zip(summaries, sizes, strict=True)
    ]
    return Followed(learners, (*parts, *made), after_ns)


def table(walks: Sequence[Walk], parts_of: Sequence[Sequence[Part]]) -> str:
    """Write what was found as Markdown."""
    lines = [
        "| walk, from nothing | touches | found by parts, % | false alarms by parts "
        "| learners, kB |",
        "|---|---|---|---|---|",
    ]
    for walk, parts in zip(walks, parts_of, strict=True):
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


def main(
    folder: Annotated[Path, typer.Argument(help="Where what was followed is kept.")],
    share: Annotated[float, typer.Argument(help="Of the walks' times, for a try.")] = 1.0,
    names: Annotated[list[str] | None, typer.Argument(help="Parts of names of walks.")] = None,
) -> None:
    """Follow the walks, or some of them, and print what was found."""
    wanted = [
        walk._replace(
            stages=tuple(stage._replace(seconds=share * stage.seconds) for stage in walk.stages)
        )
        for walk in WALKS
        if not names or any(text in walk.name for text in names)
    ]
    made = Work(folder, 2, shown=True).each("walks", followed, wanted)
    print(table(wanted, [of.parts for of in made]))


if __name__ == "__main__":
    # By its own name, which workers know: what is kept rests on the module's source.
    from adaptive_contact_studies import hours

    typer.run(hours.main)
