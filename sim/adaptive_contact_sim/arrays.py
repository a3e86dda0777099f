"""A run as arrays, for science: no messages, no files.

The same streams as :meth:`Simulation.tick` gives, leg by leg, plus what only a simulator knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.score import TruthChanges, truth_changes
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.servo import ServoParameters
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.truth import Change


@dataclass(frozen=True)
class Onset:
    """A contact that began."""

    t_ns: int  # of the physics step
    # the tick during whose physics it began, so the first *sample* that can know of it is `tick +
    # 1`
    tick: int
    force_n: float  # mean over 20 ms from there on
    # speed_m_s, part, surface, grazing: as in `ContactTruth`
    speed_m_s: float | None
    part: str | None
    surface: str | None
    grazing: bool


@dataclass(frozen=True, eq=False)
class LegArrays:
    """One leg's stream, row k being control tick k."""

    measured: Array  # (n, J) rad, read at the start of tick k
    desired: Array  # (n, J) rad, written right after, in force until tick k + 1
    valid: Mask  # (n, J) readings known to be good
    swing: Mask  # (n,) the phase of tick k
    contact: Mask  # (n,) whether the leg touches at the start of tick k
    force_n: Array  # (n,) mean contact force over the 20 ms *after* the start of tick k
    angle: Array  # (n, J) rad, the joints' true angles at the start of tick k
    onsets: tuple[Onset, ...]  # contacts that began, in order
    releases_ns: tuple[int, ...]  # times at which contacts ended

    @property
    def changes(self) -> list[ContactTruth]:
        """Changes of contact as messages, in order of time."""
        onsets = [
            ContactTruth(
                t_ns=o.t_ns,
                contact=True,
                force=o.force_n,
                speed_m_s=o.speed_m_s,
                surface=o.surface,
                part=o.part,
                grazing=o.grazing,
            )
            for o in self.onsets
        ]
        releases = [ContactTruth(t_ns=t, contact=False, force=0.0) for t in self.releases_ns]
        return sorted([*onsets, *releases], key=lambda change: (change.t_ns, change.contact))

    @property
    def truth(self) -> TruthChanges:
        """Changes of contact as the scoring takes them."""
        return truth_changes(self.changes)


@dataclass(frozen=True, eq=False)
class Run:
    """A recorded run."""

    t_ns: Ints  # (n,) time stamps of the ticks
    legs: dict[str, LegArrays]  # the streams, by leg
    position_m: Array  # (n, 3) true position of the body
    rotation: Array  # (n, 3, 3) true attitude of the body


def record_arrays(
    settings: SimulationSettings, seconds: float, *, parameters: ServoParameters | None = None
) -> Run:
    """Simulate as fast as possible into arrays.

    Args:
        settings: what to simulate.
        seconds: simulated time.
        parameters: the robot's servos; drawn from the settings where left out.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    return record_run(Simulation(settings, parameters), seconds)


def record_run(
    sim: Simulation,
    seconds: float,
    *,
    legs: Sequence[str] | None = None,
    before_tick: Callable[[], None] = lambda: None,
) -> Run:
    """Advance a simulation as fast as possible, and keep what it does as arrays.

    Args:
        sim: not advanced yet.
        seconds: simulated time.
        legs: that are kept, all by default.
        before_tick: called before each tick.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    settings, layout = sim.settings, sim.layout
    kept = {leg: layout.legs.index(leg) for leg in (layout.legs if legs is None else legs)}
    n, rows, joints = round(seconds / settings.period_s), list(kept.values()), len(layout.joints)
    measured, desired, angle = (np.zeros((n, len(rows), joints)) for _ in range(3))
    valid = np.ones(measured.shape, dtype=np.bool_)
    swing = np.zeros((n, len(rows)), dtype=np.bool_)
    force = np.zeros((n, len(rows)))
    position, rotation = np.zeros((n, 3)), np.zeros((n, 3, 3))
    onsets: list[list[Onset]] = [[] for _ in layout.legs]
    releases: list[list[int]] = [[] for _ in layout.legs]

    def own(of_servos: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(of_servos).reshape(len(layout.legs), joints)[rows]

    for k in range(n):
        before_tick()
        angle[k] = own(sim.plant.joint_angles)
        position[k], rotation[k] = sim.plant.body_pose()
        sim.advance()
        measured[k], desired[k] = own(sim.reading.angle_rad), own(sim.desired)
        valid[k] = own(sim.reading.valid)
        swing[k] = [sim.phase[row] == "swing" for row in rows]
        force[k] = [sim.plant.forces[:, row].mean() for row in rows]
        for change in sim.changes:
            if change.contact:
                onsets[change.leg].append(_onset(sim, change))
            else:
                releases[change.leg].append(sim.time_of_step(change.step))
    t_ns = settings.epoch_ns + np.arange(n, dtype=np.int64) * round(settings.period_s * 1e9)
    return Run(
        t_ns=t_ns,
        legs={
            leg: LegArrays(
                measured=measured[:, i],
                desired=desired[:, i],
                valid=valid[:, i],
                swing=swing[:, i],
                contact=contact_at(t_ns, onsets[row], releases[row]),
                force_n=force[:, i],
                angle=angle[:, i],
                onsets=tuple(onsets[row]),
                releases_ns=tuple(releases[row]),
            )
            for i, (leg, row) in enumerate(kept.items())
        },
        position_m=position,
        rotation=rotation,
    )


def _onset(sim: Simulation, change: Change) -> Onset:
    # Physics step s ends tick (s - 1) // substeps's physics.
    tick = max(change.step - 1, 0) // sim.plant.substeps
    truth = sim.truth_of(change).message
    return Onset(
        t_ns=truth.t_ns,
        tick=tick,
        force_n=truth.force,
        speed_m_s=truth.speed_m_s,
        part=truth.part,
        surface=truth.surface,
        grazing=truth.grazing,
    )


def contact_at(t_ns: Ints, onsets: list[Onset], releases_ns: list[int]) -> Mask:
    """Contact at every tick, from the times of change."""
    begun = np.searchsorted([o.t_ns for o in onsets], t_ns, side="right")
    ended = np.searchsorted(releases_ns, t_ns, side="right")
    # A leg that starts in the air reports one end before any beginning.
    if releases_ns and (not onsets or releases_ns[0] < onsets[0].t_ns):
        ended = np.maximum(ended - 1, 0)
    return np.asarray(begun > ended)
