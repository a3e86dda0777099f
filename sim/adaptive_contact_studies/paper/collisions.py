"""The paper's ten collisions (section 4.3), with what Figure 5 draws of one.

Everything stands on the paper's own dataset: models of its training segments, and for the paper's
rule the threshold "experimentally found", here the largest value on the judged free ticks of the
test segments.  The default detector has its own threshold, from the same segments.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.fit.train import learn, swing_ticks
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Window
from adaptive_contact.robot import shipped_robot
from adaptive_contact.robot.gait_phase import directions
from adaptive_contact.score import find_swings
from adaptive_contact_sim.arrays import Run, record_run
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PERIOD_S, PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_studies.evaluate import feed, samples_of
from adaptive_contact_studies.paper.data import Stream, simulation_of
from adaptive_contact_studies.paper.detectors import (
    JUDGED_AFTER_TICKS,
    Prediction,
    alarm_ticks,
    rule,
)
from adaptive_contact_studies.paper.identification import fitted_model, paper_streams
from adaptive_contact_studies.paper.plan import Plan
from adaptive_contact_studies.paper.rows import PAPER_WINDOW
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

_TICK_MS: Final = 1e3 * PERIOD_S


@rests_on(
    *(*SIMULATOR, *LEARNER, "adaptive_contact_studies.paper.data"),
    *("adaptive_contact_studies.paper.detectors", "adaptive_contact_studies.paper.rows"),
)
def ten_collisions(work: Work, plan: Plan) -> dict[str, Any]:
    """Record collisions within the paper's subspaces, and detect them.

    Returns:
        A table of collisions, and the traces of one of them.

    Raises:
        IdentificationError: too little to learn from.
    """
    robot = shipped_robot()
    train, test = paper_streams(work, plan)
    run = _recorded(train)
    own = run.legs[train.leg]
    touches = [onset for onset in own.onsets if onset.t_ns > 0 and onset.speed_m_s is not None]
    # λ of both models, in units of the residual: the plateau of the identification study.
    model, _ = fitted_model(robot, train, "paper", PAPER_WINDOW, 0.1)
    free = rule(Prediction.of(model, test.measured, test.desired).residual)
    free = free[swing_ticks(test.swing) > JUDGED_AFTER_TICKS]
    limit = free[np.isfinite(free).all(axis=1)].max(axis=0)
    residual = Prediction.of(model, own.measured, own.desired).residual
    judged = swing_ticks(own.swing) > JUDGED_AFTER_TICKS
    score = np.where(judged, (rule(residual) / limit).max(axis=1), np.nan)
    number = find_swings(run.t_ns, own.swing).of_tick
    falling = np.roll(directions(own.desired, robot.leg(train.leg)), 1) == 1
    training = learn(
        robot,
        {train.leg: [train.stretch, test.stretch]},
        origin="the paper's dataset",
        window=Window(),
    )
    learner = ContactLearner(robot, train.leg, training.baseline)
    (events,) = feed([learner], [samples_of(run, train.leg)])
    found = {
        "paper": alarm_ticks(score, number, 1.0, falling & judged),
        "default": np.array([event.seq for event in events if event.contact], dtype=np.int64),
    }
    onsets_ms = [touch.t_ns / 1e6 for touch in touches[: plan.collisions]]
    table = [
        {
            "onset_ms": onset_ms,
            "speed_m_s": touch.speed_m_s,
            "force_n": touch.force_n,
            **{f"{name}_ms": _latency(ticks, onset_ms) for name, ticks in found.items()},
        }
        for touch, onset_ms in zip(touches, onsets_ms, strict=False)
    ]
    drawn = next((i for i, row in enumerate(table) if row["paper_ms"] is not None), 0)
    return {
        "table": table,
        "limit_deg": np.degrees(limit),
        "drawn": drawn,
        "trace": _trace(onsets_ms[drawn], number, own.desired, own.measured, residual)
        | {f"{name}_ms": _TICK_MS * ticks for name, ticks in found.items()},
    }


def _recorded(train: Stream) -> Run:
    plates = ObstacleSettings(probability=1.0, shapes=("plate",))
    motion = PoseSettings(legs=(train.leg,), obstacles=plates)
    robot = train.piece.leg_run.robot_seed
    settings = SimulationSettings(motion=motion, seed=13, robot_seed=robot)
    return record_run(simulation_of(settings), 60.0, legs=(train.leg,))


def _latency(ticks: Ints, onset_ms: float) -> float | None:
    """To the first event after the touch, if it is one of it."""
    late = _TICK_MS * ticks - onset_ms
    # An event so late is none of the touch's.
    late = late[(late > 0.0) & (late <= 120.0)]
    return float(late[0]) if len(late) else None


def _trace(
    onset_ms: float, number: Ints, desired: Array, measured: Array, residual: Array
) -> dict[str, Any]:
    """One collision's swing, in ms of the recording."""
    inside = np.flatnonzero(number == number[int(onset_ms // _TICK_MS)])
    # What a drawing shows, ticks: the hold before the swing (no more, or the collision before would
    # be drawn), and some ticks from its last on.
    ticks = np.arange(max(inside[0] - 3, 0), min(inside[-1] + 10, len(number) - 1) + 1)
    return {
        "tick_ms": _TICK_MS * ticks,
        "tracking_deg": np.degrees(desired[np.maximum(ticks - 1, 0)] - measured[ticks]),
        "residual_deg": np.degrees(residual[ticks]),
        "difference_deg": np.degrees(rule(residual)[ticks]),
        "moves_ms": _TICK_MS * inside[0],
        "onset_ms": onset_ms,
    }
