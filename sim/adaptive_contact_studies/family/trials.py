"""Tries what is known of any leg on legs of which nothing is known.

No leg here was learned from: the robots that ship, each with its own servos, drawn legs of other
seeds, and legs of the second generator.  Each starts without a baseline; those that ship one start
with it as well, for what comes after swing 100.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot
from adaptive_contact.score import LegOutcome
from adaptive_contact.score.summary import clopper_pearson, poisson_mean
from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_studies.evaluate import play, score_run
from adaptive_contact_studies.family.legs import draw_leg, record
from adaptive_contact_studies.workers import worker_pool

__all__ = ["KINDS", "LegTrial", "table", "trials"]

# What is tried, and how many runs; of a hexapod's walk six legs each, in pose three, of a
# quadruped's four.
KINDS: Final = {
    "hexapod walking": 4,
    "hexapod in pose, obstacles": 3,
    "quadruped12 trotting": 4,
    "leg5 in pose, plates": 4,
    "drawn legs in pose": 14,
    "drawn legs stepping": 14,
    "second generator in pose": 7,
    "second generator stepping": 7,
}
EARLY: Final = 100  # swings
_FIRST_SEED: Final = 20_000
_PLATES: Final = {"pose": 0.5, "stepping": 0.9}


class LegTrial(NamedTuple):
    """What one leg did without a baseline.

    Attributes:
        kind: of :data:`KINDS`.
        first: swing of the first touch found, None for none; from 1.
        chances: swings until then with a touch to be found, that one included.
        touches, found: from that swing to swing 100.
        alarms, ticks: false ones, and those judged, up to swing 100.
        later: touches and those found from swing 100 on.
        with_baseline: the same with the shipped baseline; None where there is none.
        status: at the end.
    """

    kind: str
    first: int | None
    chances: int
    touches: int
    found: int
    alarms: int
    ticks: int
    later: tuple[int, int]
    with_baseline: tuple[int, int] | None
    status: str


def trials(
    kinds: Sequence[str] = tuple(KINDS),
    *,
    runs: int | None = None,
    processes: int = 2,
    progress: Callable[[str], None] = lambda _: None,
) -> list[LegTrial]:
    """Try every kind.

    Args:
        kinds: of :data:`KINDS`.
        runs: of each; as many as :data:`KINDS` says where None.
        processes: to work in; the result does not depend on it.
        progress: called with what is done.
    """
    wanted = [(kind, number) for kind in kinds for number in range(runs or KINDS[kind])]
    found: list[LegTrial] = []
    with worker_pool(processes) as pool:
        for done, legs in enumerate(pool.map(_of_run, *zip(*wanted, strict=True)), 1):
            found += legs
            progress(f"{done} of {len(wanted)} runs")
    return found


def table(found: Sequence[LegTrial]) -> str:
    """Write what was found, a row per kind, as Markdown."""
    rows = {kind: [leg for leg in found if leg.kind == kind] for kind in KINDS}
    rows["all"] = list(found)
    lines = [
        "| legs without a baseline | legs | first touch found: swing, median / p95 "
        "| after chances | found from there to swing 100 | false alarms per robot-hour "
        "| from swing 100 on | with baseline |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [_row(kind, legs) for kind, legs in rows.items() if legs]
    return "\n".join(lines)


# -- private -------------------------------------------------------------------------------------


def _of_run(kind: str, number: int) -> list[LegTrial]:
    run, robot, baseline = _recorded(kind, _FIRST_SEED + number)
    played = play(run, robot, None)
    outcomes = score_run(run, robot, played.events)
    known: dict[str, LegOutcome] = {}
    if baseline is not None:
        again = score_run(run, robot, play(run, robot, baseline).events)
        known = {outcome.leg: outcome for outcome in again}
    found = []
    for outcome in outcomes:
        touches, swings = outcome.touches, outcome.swings
        counted = touches.counted
        hits = touches.swing[counted & touches.found]
        first = int(hits[0]) if len(hits) else None
        tried = counted & (touches.swing < EARLY)
        after = tried & (touches.swing >= (EARLY if first is None else first))
        before = tried & ~after
        alarms = np.concatenate([outcome.alarm_swing, outcome.after_swing])
        found.append(
            LegTrial(
                kind,
                None if first is None else first + 1,
                len(np.unique(touches.swing[before])) + (first is not None),
                int(after.sum()),
                int((after & touches.found).sum()),
                int((alarms < EARLY).sum()),
                int(swings.judged[:EARLY].sum() + swings.judged_after[:EARLY].sum()),
                _later(outcome),
                _later(known[outcome.leg]) if known else None,
                played.learners[outcome.leg].status.status,
            )
        )
    return found


def _later(outcome: LegOutcome) -> tuple[int, int]:
    touches = outcome.touches
    late = touches.counted & (touches.swing >= EARLY)
    return int(late.sum()), int((late & touches.found).sum())


def _recorded(kind: str, seed: int) -> tuple[Run, Robot, Baseline | None]:
    """A run of a kind, of a robot with servos of its own."""
    if kind.startswith(("drawn", "second")):
        leg = draw_leg(seed, second=kind.startswith("second"))
        way = "stepping" if kind.endswith("stepping") else "pose"
        run = record(leg, "gait" if way == "stepping" else "pose", 200, seed, plates=_PLATES[way])
        return run, leg.robot, None
    name, how = kind.split()[0], kind.split()[1]
    settings = SimulationSettings.of(name, "walk" if how in ("walking", "trotting") else "pose")
    seconds = {"hexapod walking": 290.0, "quadruped12 trotting": 140.0}.get(kind, 200.0)
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


def _row(kind: str, legs: Sequence[LegTrial]) -> str:
    never = sum(leg.first is None for leg in legs)
    first = [np.inf if leg.first is None else leg.first for leg in legs]
    chances = [np.inf if leg.first is None else leg.chances for leg in legs]
    touches, found = sum(leg.touches for leg in legs), sum(leg.found for leg in legs)
    alarms, hours = sum(leg.alarms for leg in legs), sum(leg.ticks for leg in legs)
    rate = poisson_mean(alarms)
    each = ROBOT_HOUR_TICKS / hours
    cells = [
        kind, str(len(legs)), _middle(first) + (f" ({never} none)" if never else ""),
        _middle(chances), _share(found, touches),
        f"{alarms * each:.0f} ({rate.low * each:.0f} to {rate.high * each:.0f})",
        _share(*_sum([leg.later for leg in legs])[::-1]),
        _share(*_sum([leg.with_baseline for leg in legs if leg.with_baseline])[::-1]),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def _middle(values: Sequence[float]) -> str:
    middle, late = np.quantile(values, (0.5, 0.95), method="higher")
    return f"{middle:g} / {late:g}"


def _sum(pairs: Sequence[tuple[int, int]]) -> tuple[int, int]:
    return sum(pair[0] for pair in pairs), sum(pair[1] for pair in pairs)


def _share(found: int, touches: int) -> str:
    if not touches:
        return ""
    ends = clopper_pearson(found, touches)
    return f"{100 * found / touches:.1f} % ({100 * ends.low:.1f} to {100 * ends.high:.1f})"
