"""Tries what is known of any leg on legs of which nothing is known.

No leg here was learned from: the robots that ship, each with its own servos, drawn legs of other
seeds, and legs of the second generator.  Each is played without a baseline and again with one: the
shipped one, or one fitted to free swings of the same drawn leg.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit.train import learn
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import LegOutcome
from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_studies.evaluate import play, score_run
from adaptive_contact_studies.family.legs import LEG, DrawnLeg, Motion, draw_leg, record
from adaptive_contact_studies.show.pages import found_of, per_hour, row
from adaptive_contact_studies.training import stretch_of
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# What is tried, and how many runs; of a hexapod's walk six legs each, in pose three, of a
# quadruped's four.
KINDS: Final = {
    "hexapod walking": 10,
    "hexapod in pose, obstacles": 12,
    "quadruped12 trotting": 9,
    "leg5 in pose, plates": 24,
    "drawn legs in pose": 24,
    "drawn legs stepping": 24,
    "second generator in pose": 18,
    "second generator stepping": 18,
}
EARLY: Final = 100  # swings
# A drawn leg's own baseline: some ten minutes of free swings.
_FREE_SWINGS: Final = 800


class Figures(NamedTuple):
    """What one leg did from the swing of its first touch found without a baseline."""

    # touches, found: from the swing after that one to swing 100
    touches: int
    found: int
    alarms: int  # false ones up to swing 100, from the start
    later: tuple[int, int]  # touches and those found from swing 100 on


class LegTrial(NamedTuple):
    """What one leg did without a baseline, and with one."""

    kind: str  # of `KINDS`
    first: int | None  # swing of the first touch found, None for none; from 1
    chances: int  # swings until then with a touch to be found, that one included
    ticks: int  # judged up to swing 100
    without: Figures  # baseline
    known: Figures | None  # the same with a baseline; None where none could be fitted


def trials(
    work: Work, kinds: Sequence[str] = tuple(KINDS), *, runs: int | None = None
) -> list[LegTrial]:
    """Try every kind; so many runs of each, if not as many as is usual."""
    wanted = [(kind, number) for kind in kinds for number in range(runs or KINDS[kind])]
    return [leg for legs in work.each("trying", legs_of_run, wanted) for leg in legs]


def table(found: Sequence[LegTrial]) -> str:
    """Write what was found, a row per kind, as Markdown."""
    rows = {kind: [leg for leg in found if leg.kind == kind] for kind in KINDS}
    rows["all"] = list(found)
    lines = [
        "| legs without a baseline | legs | first touch found: swing, median / p95 "
        "| after chances | found from there to swing 100 | with a baseline "
        "| false alarms per robot-hour | with a baseline | from swing 100 on | with a baseline |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [_row(kind, legs) for kind, legs in rows.items() if legs]
    return "\n".join(lines)


@rests_on(*SIMULATOR, *LEARNER, "adaptive_contact_studies.family.legs")
def legs_of_run(_: Work, wanted: tuple[str, int]) -> list[LegTrial]:
    """Try the legs of a run of a kind."""
    kind, number = wanted
    run, robot, baseline = _recorded(kind, 20_000 + number)
    played = play(run, robot, None)
    known: dict[str, LegOutcome] = {}
    if baseline is not None:
        again = score_run(run, robot, play(run, robot, baseline).events)
        known = {outcome.leg: outcome for outcome in again}
    found = []
    for outcome in score_run(run, robot, played.events):
        touches, swings = outcome.touches, outcome.swings
        hits = touches.swing[touches.counted & touches.found]
        first = int(hits[0]) if len(hits) else None
        after = EARLY if first is None else first
        before = touches.counted & (touches.swing < min(after, EARLY))
        found.append(
            LegTrial(
                kind,
                None if first is None else first + 1,
                len(np.unique(touches.swing[before])) + (first is not None),
                int(swings.judged[:EARLY].sum()),
                _figures(outcome, after),
                _figures(known[outcome.leg], after) if known else None,
            )
        )
    return found


def _figures(outcome: LegOutcome, after: int) -> Figures:
    touches = outcome.touches
    early = touches.counted & (touches.swing > after) & (touches.swing < EARLY)
    late = touches.counted & (touches.swing >= EARLY)
    return Figures(
        int(early.sum()),
        int((early & touches.found).sum()),
        int((outcome.alarm_swing < EARLY).sum()),
        (int(late.sum()), int((late & touches.found).sum())),
    )


def _recorded(kind: str, seed: int) -> tuple[Run, Robot, Baseline | None]:
    """A run of a kind, of a robot with servos of its own, and its baseline."""
    if kind.startswith(("drawn", "second")):
        leg = draw_leg(seed, second=kind.startswith("second"))
        motion: Motion = "gait" if kind.endswith("stepping") else "pose"
        run = record(leg, motion, 200, seed, plates={"pose": 0.5, "gait": 0.9}[motion])
        return run, leg.robot, _own_baseline(leg, motion, seed + 50_000)
    name, how = kind.split()[:2]
    walks = how in ("walking", "trotting")
    settings = SimulationSettings.from_robot(name, "walk" if walks else "pose")
    seconds = {"hexapod": 290.0, "quadruped12": 140.0}[name] if walks else 200.0
    if kind == "hexapod in pose, obstacles":
        obstacles = ObstacleSettings(probability=0.5)
        poses = (PoseSettings(legs=(leg,), obstacles=obstacles) for leg in TRIPODS[seed % 2])
        settings = dataclasses.replace(settings, motion=PoseGroupSettings(tuple(poses)))
    elif name == "leg5":
        pose = settings.motion
        assert isinstance(pose, PoseSettings)
        plates = dataclasses.replace(pose.obstacles, probability=0.5)
        settings = dataclasses.replace(settings, motion=dataclasses.replace(pose, obstacles=plates))
    settings = dataclasses.replace(settings, seed=seed, robot_seed=seed)
    robot = simulated_robot(name).description
    return record_arrays(settings, seconds), robot, shipped_baseline(robot.name)


def _own_baseline(leg: DrawnLeg, motion: Motion, seed: int) -> Baseline | None:
    """Fit a drawn leg to free swings of its own; None where they do not suffice."""
    free = stretch_of(record(leg, motion, _FREE_SWINGS, seed), LEG, leg.robot.period_s)
    try:
        return learn(leg.robot, {LEG: [free]}, origin="free swings of its own").baseline
    except IdentificationError:
        return None


def _row(kind: str, legs: Sequence[LegTrial]) -> str:
    never = sum(leg.first is None for leg in legs)
    first = [np.inf if leg.first is None else leg.first for leg in legs]
    chances = [np.inf if leg.first is None else leg.chances for leg in legs]
    without = [leg.without for leg in legs]
    known = [leg.known for leg in legs if leg.known]
    both = (without, known)
    late = [[leg.later for leg in of] for of in both]
    return row(
        kind, str(len(legs)), _middle(first) + (f" ({never} none)" if never else ""),
        _middle(chances),
        *(found_of(sum(leg.found for leg in of), sum(leg.touches for leg in of)) for of in both),
        per_hour(sum(leg.alarms for leg in without), sum(leg.ticks for leg in legs)),
        per_hour(sum(leg.alarms for leg in known), sum(leg.ticks for leg in legs if leg.known)),
        *(found_of(sum(hits for _, hits in of), sum(all_ for all_, _ in of)) for of in late),
    )  # fmt: skip


def _middle(values: Sequence[float]) -> str:
    middle, late = (
        "none" if value == np.inf else f"{value:g}"
        for value in np.quantile(values, (0.5, 0.95), method="higher")
    )
    return f"{middle} / {late}"
