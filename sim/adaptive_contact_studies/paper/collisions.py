"""The paper's ten collisions (section 4.3), with what Figure 5 draws.

Truth at 1 kHz, readings and predictions at 50 Hz.

Everything stands on the paper's own dataset: models of its training segments, and for the paper's
rule the threshold "experimentally found", here the largest value on the judged free ticks of the
test segments.  The default detector has its own threshold, from the same segments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit.train import learn, swing_ticks
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import LegModel, Window
from adaptive_contact.robot import Robot
from adaptive_contact.robot.gait_phase import directions
from adaptive_contact.score import find_swings
from adaptive_contact.wire import ServoSample
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_studies.evaluate import feed
from adaptive_contact_studies.paper.comparison_rules import (
    JUDGED_AFTER_TICKS,
    Prediction,
    alarm_ticks,
    paper_rule,
)
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.identification import fitted
from adaptive_contact_studies.paper.recording import simulation_of
from adaptive_contact_studies.paper.rows import PAPER_WINDOW, predictions

_SEED: Final = 13
# λ of both models, in units of the residual: the plateau of the identification study.
_THRESHOLD: Final = 0.1
_LONGEST_S: Final = 60.0
# What a drawing shows, ticks: the hold before the swing (no more, or the collision before would
# be drawn), and some ticks from its last on.
_BEFORE: Final = 3
_MARGIN: Final = 10


@dataclass
class _Listener:
    """Takes down body and joints at every physics step; called by the plant."""

    sim: Simulation
    leg: int
    t_s: list[float] = field(default_factory=list)
    tilt: list[Array] = field(default_factory=list)
    torque: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        plant = self.sim.plant
        own = slice(3 * self.leg, 3 * self.leg + 3)

        def listen() -> None:
            self.t_s.append(plant.steps * plant.step_s)
            matrix = np.zeros(9)
            mujoco.mju_quat2Mat(matrix, plant.data.qpos[3:7])
            m = matrix.reshape(3, 3)
            roll, yaw = np.arctan2(m[2, 1], m[2, 2]), np.arctan2(m[1, 0], m[0, 0])
            self.tilt.append(np.array([roll, -np.arcsin(m[2, 0]), yaw]))
            ctrl = plant.data.ctrl[plant.elements.ctrl][own]
            self.torque.append(ctrl - plant.servos.back_emf[own] * plant.joint_speeds[own])

        plant.on_step = listen


def ten_collisions(
    robot: Robot, train: Stream, test: Stream, count: int, progress: Callable[[float], None]
) -> dict[str, Any]:
    """Record collisions within the paper's subspaces, and detect them.

    Returns:
        A table of collisions, the traces of one of them, and how each detector's fit ended: one
        that has nothing to go by finds nothing, and says why.
    """
    leg = LEGS.index(train.leg)
    motion = PoseSettings(
        legs=(train.leg,), obstacles=ObstacleSettings(probability=1.0, shapes=("plate",))
    )
    settings = SimulationSettings(
        motion=motion, seed=_SEED, robot_seed=train.piece.leg_run.robot_seed
    )
    sim = simulation_of(settings)
    listener = _Listener(sim, leg)
    rows: list[tuple[Array, Array, bool]] = []
    touches: list[tuple[int, float, float]] = []

    def advance() -> None:
        sim.advance()
        own = slice(3 * leg, 3 * leg + 3)
        rows.append(
            (sim.reading.angle_rad[own].copy(), sim.desired[own].copy(), sim.phase[leg] == "swing")
        )

    while len(touches) < count and sim.time_s < _LONGEST_S:
        advance()
        for change in sim.changes:
            if change.leg == leg and change.contact and change.touch is not None:
                touches.append((change.step, change.touch.speed_m_s, change.force_n))
    # The last touch's own swing, and the force that follows it.
    for _ in range(2 * _MARGIN):
        advance()
    measured, desired, swing = map(np.array, zip(*rows, strict=True))

    progress(0.2)
    model, status = fitted(robot, train, "paper", PAPER_WINDOW, _THRESHOLD)
    predicted = predictions(model, measured, desired)
    difference = paper_rule(Prediction.of(measured, predicted))
    limit = _found_threshold(model, test)
    progress(0.3)
    judged = swing_ticks(swing) > JUDGED_AFTER_TICKS
    score = np.where(judged, (difference / limit).max(axis=1), np.nan)
    t_ns = np.arange(len(swing), dtype=np.int64) * 20_000_000
    number = find_swings(t_ns, swing).of_tick
    falling = np.roll(directions(desired, robot.leg(train.leg)), 1) == 1
    paper_ticks = alarm_ticks(score, number, 1.0, falling & judged)
    reason = None
    try:
        default_ticks = _default(robot, train, test, measured, desired, swing)
    except IdentificationError as error:
        default_ticks, reason = np.zeros(0, dtype=np.int64), str(error)
    progress(0.5)
    table = []
    for step, speed, force in touches[:count]:
        onset_ms = step * sim.plant.step_s * 1e3
        table.append(
            {
                "onset_ms": onset_ms,
                "speed_m_s": speed,
                "force_n": force,
                "paper_ms": _latency(paper_ticks, onset_ms),
                "default_ms": _latency(default_ticks, onset_ms),
            }
        )
    shown = next((i for i, row in enumerate(table) if row["paper_ms"] is not None), 0)
    return {
        "seed": _SEED,
        "table": table,
        "limit_deg": np.degrees(limit).tolist(),
        "drawn": shown,
        "status": {
            "paper": status.value if model is None else None,
            "default": reason,
        },
        "trace": _trace(
            listener,
            table[shown],
            number,
            measured,
            desired,
            predicted,
            difference,
            paper_ticks,
            default_ticks,
        ),
    }


def _found_threshold(model: LegModel | None, test: Stream) -> Array:
    """(3,) the largest change of the absolute error on judged free ticks; NaN without a model."""
    predicted = predictions(model, test.measured, test.desired)
    change = paper_rule(Prediction.of(test.measured, predicted))
    judged = swing_ticks(test.swing) > JUDGED_AFTER_TICKS
    known = change[judged]
    known = known[np.isfinite(known).all(axis=1)]
    return known.max(axis=0) if len(known) else np.full(predicted.shape[1], np.nan)


def _default(
    robot: Robot,
    train: Stream,
    test: Stream,
    measured: Array,
    desired: Array,
    swing: Mask,
) -> Ints:
    """Ticks at which the default detector reports a contact.

    Raises:
        IdentificationError: too little to learn from.
    """
    training = learn(
        robot,
        {train.leg: [train.stretch, test.stretch]},
        origin="the paper's dataset",
        window=Window(),
    )
    learner = ContactLearner(robot, train.leg, training.baseline)
    samples = [
        ServoSample(
            t_ns=k * 20_000_000,
            seq=k,
            measured=measured[k].tolist(),
            desired=desired[k].tolist(),
            phase="swing" if swing[k] else "stance",
        )
        for k in range(len(swing))
    ]
    (events,) = feed([learner], [samples])
    return np.array([event.seq for event in events if event.contact], dtype=np.int64)


def _latency(ticks: Ints, onset_ms: float) -> float | None:
    """To the first event within 120 ms of the touch."""
    later = [20.0 * k - onset_ms for k in ticks if 0.0 < 20.0 * k - onset_ms <= 120.0]
    return later[0] if later else None


def _trace(
    listener: _Listener,
    touch: dict[str, Any],
    number: Ints,
    measured: Array,
    desired: Array,
    predicted: Array,
    difference: Array,
    paper_ticks: Ints,
    default_ticks: Ints,
) -> dict[str, Any]:
    """One collision's swing, in ms from the start of what is drawn."""
    at = int(touch["onset_ms"] // 20.0)
    inside = np.flatnonzero(number == number[at])
    first, last = max(inside[0] - _BEFORE, 0), min(inside[-1] + _MARGIN, len(number) - 1)
    ticks = np.arange(first, last + 1)
    start_ms = 20.0 * first
    t_ms = np.array(listener.t_s) * 1e3
    fine = (t_ms >= start_ms) & (t_ms <= 20.0 * last)
    tilt = np.degrees(np.array(listener.tilt)[fine])

    def events(which: Ints) -> list[float]:
        return [20.0 * k - start_ms for k in which if first <= k <= last]

    return {
        "fine_ms": t_ms[fine] - start_ms,
        "tilt_deg": tilt - tilt[0],
        "torque_nm": np.array(listener.torque)[fine],
        "tick_ms": 20.0 * ticks - start_ms,
        "tracking_deg": np.degrees(desired[np.maximum(ticks - 1, 0)] - measured[ticks]),
        "residual_deg": np.degrees(measured[ticks] - predicted[ticks]),
        "difference_deg": np.degrees(difference[ticks]),
        "moves_ms": 20.0 * inside[0] - start_ms,
        "onset_ms": touch["onset_ms"] - start_ms,
        "paper_ms": events(paper_ticks),
        "default_ms": events(default_ticks),
    }
