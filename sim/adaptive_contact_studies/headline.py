"""The headline figures: the default detector on runs it has not seen.

``pose_contacts`` and ``pose_free`` are the paper's set-up, over its subspaces and the whole reach
of every leg; ``walk_rough`` is half an hour of tripod walking over rough ground, where legs stop
60 ms after the true touch.  Seeds lie apart from those of learning (1000 and up).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import LegOutcome, Summary, summarise
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import Workspace
from adaptive_contact_studies.evaluate import play, score_run
from adaptive_contact_studies.training import PlannedRun, planned_run, record_all
from adaptive_contact_studies.work import Work


def _pose(row: str, seed: int, seconds: float, workspace: Workspace, share: float) -> PlannedRun:
    obstacles = ObstacleSettings(probability=share)
    return planned_run(
        row, "hexapod", seed, seconds, legs=LEGS, workspace=workspace, obstacles=obstacles
    )


HEADLINE_RUNS: Final = (
    planned_run("walk_rough", "hexapod", 2001, 600.0, "rough"),
    planned_run("walk_rough", "hexapod", 2002, 600.0, "rough"),
    planned_run("walk_rough", "hexapod", 2003, 600.0, "rough"),
    _pose("pose_free", 2011, 1500.0, "paper", 0.0),
    _pose("pose_free", 2012, 1500.0, "whole", 0.0),
    _pose("pose_contacts", 2021, 400.0, "paper", 0.5),
    _pose("pose_contacts", 2022, 400.0, "whole", 0.5),
)


def run_headline(
    robot: Robot, baseline: Baseline, work: Work, runs: Sequence[PlannedRun] = HEADLINE_RUNS
) -> dict[str, Summary]:
    """Simulate, detect and score.

    Returns:
        The figures of every row.
    """
    rows: dict[str, list[LegOutcome]] = {}
    for spec, run in zip(runs, record_all(work, runs), strict=True):
        outcomes = score_run(run, robot, play(run, robot, baseline).events)
        rows.setdefault(spec.name, []).extend(outcomes)
    return {row: summarise(outcomes) for row, outcomes in rows.items()}
