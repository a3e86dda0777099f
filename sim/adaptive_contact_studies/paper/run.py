"""All experiments in one run: stage by stage, resumable, with progress."""

from __future__ import annotations

import os
import platform
from typing import Any, get_args

import msgspec

from adaptive_contact_studies.paper.data import streams_of
from adaptive_contact_studies.paper.detection import detection
from adaptive_contact_studies.paper.evaluation import evaluate, jobs_of, learned, tuned
from adaptive_contact_studies.paper.identification import identification
from adaptive_contact_studies.paper.plan import Plan, Role
from adaptive_contact_studies.training import record_all
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, digest


def run_paper(work: Work, plan: Plan) -> dict[str, Any]:
    """Run the experiments.

    Args:
        work: how it is done, and where it is kept.
        plan: how much of everything.

    Returns:
        A tree of figures, by stage.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    record_all(work, [*plan.paper_runs("train"), *plan.paper_runs("tune")])
    results: dict[str, Any] = {
        "plan": plan,
        "machine": {"cores": os.cpu_count(), "python": platform.python_version()},
        "simulator": digest(*SIMULATOR),
        "learner": digest(*LEARNER),
        "dataset": _dataset(work, plan),
        "identification": identification(work, plan),
        "detection": _detection(work, plan),
    }
    # Arrays become lists; what is not a number, or infinite, None.
    text = msgspec.json.encode(results, enc_hook=lambda array: array.tolist())
    return dict(msgspec.json.decode(text))


def _dataset(work: Work, plan: Plan) -> dict[str, Any]:
    """The paper's two datasets (4.1)."""
    streams = streams_of(work, [*plan.paper_runs("train"), *plan.paper_runs("tune")])
    return {
        "leg": streams[0].leg,
        "segments": [plan.train_segments, plan.test_segments],
        "ticks": sum(len(stream.run.t_ns) for stream in streams),
        # At time 0 the leg stands: that is where it comes from, no touch.
        "touches": sum(o.t_ns > 0 for stream in streams for o in stream.arrays.onsets),
    }


def _detection(work: Work, plan: Plan) -> dict[str, Any]:
    """What ten trials cannot show."""
    record_all(work, [run for role in get_args(Role) for run in plan.runs(role)])
    work.each("learning the legs of each robot", learned, [(plan, robot) for robot in plan.robots])
    work.each("choosing lags, joints and thresholds on tuning streams", tuned, [plan])
    jobs = jobs_of(plan, "touch") + jobs_of(plan, "free")
    what = "every detector on every stream"
    found = work.each(what, evaluate, jobs)
    return detection(plan, jobs, found)
