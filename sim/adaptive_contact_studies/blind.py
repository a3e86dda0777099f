"""Blind walking: what contact events are worth to a gait.

The same ground is walked with five ways to end a swing, before and after a drift.  Body tilt, the
touches' force, swings that were stopped in the air, distance and work come from the simulator's
truth; events from learners in this process (:class:`~adaptive_contact_sim.live.InProcess`), so
that a walk depends on no clock.

Two of the five need no sensor.  A *fixed trajectory* is planned to the ground that it expects: the
command ends there, and the foot moves on as in stance.  *No detection* is the gait of the three
others, whose descents aim below the ground, with nothing that stops them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact_sim.live import InProcess
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.walk import WalkMotion
from adaptive_contact_studies.show.colours import BLUE, GREEN, GREY, ORANGE, RED
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

# By which a leg lifts higher that struck something, m, in walks that detect it.
RAISE_M: Final = 0.04
PHASES: Final = ("before", "after")


class Policy(NamedTuple):
    """A way to end a swing."""

    about: str
    colour: str
    motion: dict[str, Any]  # settings of the walk
    mode: LearnerMode | None = None  # of the learners whose events stop it


_UNSTOPPED: Final = {"stop_on": "never", "raise_m": 0.0}
_ON_EVENTS: Final = {"stop_on": "service", "raise_m": RAISE_M}
POLICIES: Final = {
    "fixed": Policy("fixed trajectory", GREY, {**_UNSTOPPED, "phase": "planned"}),
    "none": Policy("no detection", ORANGE, _UNSTOPPED),
    "service": Policy("the service's events", BLUE, _ON_EVENTS, LearnerMode.FULL),
    "frozen": Policy("the frozen model's events", RED, _ON_EVENTS, LearnerMode.FROZEN),
    "truth": Policy("a perfect sensor", GREEN, {"stop_on": "truth", "raise_m": RAISE_M}),
}


class Walk(NamedTuple):
    """A walk to be made."""

    policy: str
    settings: SimulationSettings  # of a walk; its policy changes the motion
    seconds: float


@dataclass(frozen=True, eq=False)
class Trace:
    """A walk, n ticks of L legs."""

    period_s: float
    tilt_deg: Array  # (n,) of the body, at the end of each tick
    position_m: Array  # (n, 2) likewise
    work_j: Array  # (n,) done in it by the motors, either way
    force_n: Array  # (n, L) largest in it
    # ticks in which swings began, were stopped on a report, and were stopped in the air
    swings: Ints
    stops: Ints
    in_air: Ints
    touches: Ints  # (k, 2) tick and leg of the first touch of each swing


@rests_on(*SIMULATOR, *LEARNER)
def walked(_: Work, walk: Walk) -> Trace:
    """Walk.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    policy = POLICIES[walk.policy]
    settings = walk.settings
    sim = Simulation(replace(settings, motion=replace(settings.motion, **policy.motion)))
    motion, plant, legs = sim.motion, sim.plant, len(sim.layout.legs)
    assert isinstance(motion, WalkMotion)
    learners = None if policy.mode is None else InProcess(sim, policy.mode)
    n, ctrl = round(walk.seconds / settings.period_s), plant.elements.ctrl
    tilt, place, work, force = np.zeros(n), np.zeros((n, 2)), np.zeros(n), np.zeros((n, legs))
    swing = np.zeros((n, legs), dtype=np.bool_)
    stopped, onset = swing.copy(), swing.copy()

    def on_step() -> None:
        torque = plant.data.ctrl[ctrl] - plant.servos.back_emf * plant.joint_speeds
        work[sim.ticks] += np.abs(torque * plant.joint_speeds).sum() * plant.step_s

    plant.on_step = on_step
    for k in range(n):
        tick = sim.tick()
        if learners is not None:
            learners.process_tick(tick)
        position, rotation = plant.body_pose()
        tilt[k] = np.degrees(np.arccos(min(rotation[2, 2], 1.0)))
        place[k], force[k] = position[:2], plant.forces.max(axis=0)
        swing[k] = [phase == "swing" for phase in sim.phase]
        stopped[k] = motion.stopped
        for change in sim.changes:
            if change.contact:
                onset[max(change.step - 1, 0) // plant.substeps, change.leg] = True
    began = swing & ~np.vstack([swing[:1], swing[:-1]])
    # A swing was stopped in the air if nothing pressed on the leg for 0.1 s before.
    air = round(0.1 / settings.period_s)
    stops = np.argwhere(stopped)
    in_air = [k for k, leg in stops if force[max(k - air, 0) : k, leg].max() <= 0.5]
    return Trace(
        settings.period_s, tilt, place, work, force,
        swings=np.argwhere(began)[:, 0], stops=stops[:, 0], in_air=np.array(in_air, dtype=np.int64),
        touches=_first_touches(began, onset),
    )  # fmt: skip


def _first_touches(began: Mask, onset: Mask) -> Ints:
    """(k, 2) tick and leg of the first onset after each begin of a swing."""
    found = []
    for leg in range(began.shape[1]):
        onsets = np.flatnonzero(onset[:, leg])
        after = np.searchsorted(onsets, np.flatnonzero(began[:, leg]))
        found += [(int(onsets[i]), leg) for i in np.unique(after[after < len(onsets)])]
    return np.array(sorted(found), dtype=np.int64).reshape(-1, 2)


class Figures(NamedTuple):
    """What a walk was like."""

    tilt_rms_deg: float
    tilt_p95_deg: float
    force_median_n: float
    force_p95_n: float
    swings: float
    stopped: float
    in_air: float
    distance_m: float
    work_j_per_m: float


def figures(trace: Trace, begin_s: float, end_s: float) -> Figures:
    """Figures of a stretch of a walk."""
    begin, end = (round(at / trace.period_s) for at in (begin_s, end_s))
    tilt = trace.tilt_deg[begin:end]
    # A touch's force is the largest within this time from its onset.
    impact = round(0.1 / trace.period_s)
    inside = (trace.touches[:, 0] >= begin) & (trace.touches[:, 0] < end)
    peaks = [trace.force_n[k : k + impact, leg].max() for k, leg in trace.touches[inside]]
    swings, stopped, in_air = (
        float(((ticks >= begin) & (ticks < end)).sum())
        for ticks in (trace.swings, trace.stops, trace.in_air)
    )
    # Of a place each second, so that the body's sway is no distance.
    way = np.diff(trace.position_m[begin : end : round(1.0 / trace.period_s)], axis=0)
    distance = float(np.hypot(way[:, 0], way[:, 1]).sum())
    work = float(trace.work_j[begin:end].sum())
    force = np.percentile(peaks, (50, 95)) if peaks else np.full(2, np.nan)
    return Figures(
        tilt_rms_deg=float(np.sqrt(np.mean(tilt**2))),
        tilt_p95_deg=float(np.percentile(tilt, 95)),
        force_median_n=float(force[0]),
        force_p95_n=float(force[1]),
        swings=swings,
        stopped=stopped,
        in_air=in_air,
        distance_m=distance,
        work_j_per_m=work / max(distance, 1e-3),
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Walks of all policies, by seed."""

    drift_s: float  # when the drift begins
    seconds: float
    traces: dict[str, list[Trace]]  # by policy

    def figures(self, policy: str, phase: str) -> list[Figures]:
        """Figures of each seed, before or after the drift."""
        ends = {"before": (0.0, self.drift_s), "after": (self.drift_s, self.seconds)}[phase]
        return [figures(trace, *ends) for trace in self.traces[policy]]


def compare(
    work: Work, settings: SimulationSettings, seconds: float, seeds: Sequence[int]
) -> Comparison:
    """Walk with every policy and seed; the first drift of the settings divides the walks.

    Raises:
        SimulationDivergedError: the physics of a walk blew up.
    """
    walks = [
        Walk(policy, replace(settings, seed=seed), seconds) for policy in POLICIES for seed in seeds
    ]
    traces = work.each("walking", walked, walks)
    each = {
        policy: traces[i * len(seeds) : (i + 1) * len(seeds)] for i, policy in enumerate(POLICIES)
    }
    return Comparison(min(drift.at_s for drift in settings.drift), seconds, each)
