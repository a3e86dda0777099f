"""A run as arrays, for science: no messages, no files.

The same streams as :meth:`Simulation.tick` gives, leg by leg, plus what only a simulator knows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adaptive_contact_sim.servo import ServoParameters
from adaptive_contact_sim.simulation import Simulation, SimulationSettings

__all__ = ["LegArrays", "Onset", "Run", "record_arrays"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Onset:
    """A contact that began.

    Attributes:
        t_ns: of the physics step.
        tick: the tick during whose physics it began, so the first *sample* that can know of it
            is ``tick + 1``.
        force_n: mean over 20 ms from there on.
        speed_m_s, part, surface, grazing: as in :class:`adaptive_contact.wire.ContactTruth`.
    """

    t_ns: int
    tick: int
    force_n: float
    speed_m_s: float | None
    part: str | None
    surface: str | None
    grazing: bool


@dataclass(frozen=True, eq=False)
class LegArrays:
    """One leg's stream, row k being control tick k.

    Attributes:
        measured: (n, J) rad, read at the start of tick k.
        desired: (n, J) rad, written right after, in force until tick k + 1.
        valid: (n, J) readings known to be good.
        swing: (n,) the phase of tick k.
        contact: (n,) whether the leg touches at the start of tick k.
        force_n: (n,) mean contact force over the 20 ms *after* the start of tick k.
        angle: (n, J) rad, the joints' true angles at the start of tick k.
        onsets: contacts that began, in order.
        releases_ns: times at which contacts ended.
    """

    measured: Array
    desired: Array
    valid: NDArray[np.bool_]
    swing: NDArray[np.bool_]
    contact: NDArray[np.bool_]
    force_n: Array
    angle: Array
    onsets: tuple[Onset, ...]
    releases_ns: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Run:
    """A recorded run.

    Attributes:
        t_ns: (n,) time stamps of the ticks.
        legs: the streams, by leg.
        position_m: (n, 3) true position of the body.
        rotation: (n, 3, 3) true attitude of the body.
    """

    t_ns: NDArray[np.int64]
    legs: dict[str, LegArrays]
    position_m: Array
    rotation: Array


def record_arrays(
    settings: SimulationSettings, seconds: float, *, parameters: ServoParameters | None = None
) -> Run:
    """Simulate as fast as possible into arrays.

    Args:
        settings: what to simulate.
        seconds: simulated time.
        parameters: the robot's servos; drawn from the settings where left out.

    Returns:
        The run.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    sim = Simulation(settings, parameters)
    layout = sim.layout
    n, legs, joints = round(seconds / settings.period_s), len(layout.legs), len(layout.joints)
    measured = np.zeros((n, legs * joints))
    desired, angle = np.zeros_like(measured), np.zeros_like(measured)
    valid = np.ones((n, legs * joints), dtype=np.bool_)
    swing = np.zeros((n, legs), dtype=np.bool_)
    force = np.zeros((n, legs))
    position, rotation = np.zeros((n, 3)), np.zeros((n, 3, 3))
    onsets: list[list[Onset]] = [[] for _ in layout.legs]
    releases: list[list[int]] = [[] for _ in layout.legs]
    for k in range(n):
        angle[k] = sim.plant.joint_angles
        position[k], rotation[k] = sim.plant.body_pose()
        sim.advance()
        measured[k], desired[k], valid[k] = sim.reading.angle_rad, sim.desired, sim.reading.valid
        swing[k] = [phase == "swing" for phase in sim.phase]
        force[k] = sim.plant.forces.mean(axis=0)
        for change in sim.changes:
            t_ns = sim.time_of_step(change.step)
            if not change.contact:
                releases[change.leg].append(t_ns)
                continue
            touch = change.touch
            onsets[change.leg].append(
                Onset(
                    t_ns=t_ns,
                    # Physics step s ends tick (s - 1) // substeps's physics.
                    tick=max(change.step - 1, 0) // sim.plant.substeps,
                    force_n=change.force_n,
                    speed_m_s=None if touch is None else touch.speed_m_s,
                    part=None if touch is None else layout.parts[touch.part],
                    surface=None if touch is None else sim.surface_of(touch.other),
                    grazing=touch is not None and touch.grazing,
                )
            )
    t_ns_all = settings.epoch_ns + np.arange(n, dtype=np.int64) * round(settings.period_s * 1e9)
    shape = (n, legs, joints)
    return Run(
        t_ns=t_ns_all,
        legs={
            leg: LegArrays(
                measured=measured.reshape(shape)[:, i],
                desired=desired.reshape(shape)[:, i],
                valid=valid.reshape(shape)[:, i],
                swing=swing[:, i],
                contact=_contact(t_ns_all, onsets[i], releases[i]),
                force_n=force[:, i],
                angle=angle.reshape(shape)[:, i],
                onsets=tuple(onsets[i]),
                releases_ns=tuple(releases[i]),
            )
            for i, leg in enumerate(layout.legs)
        },
        position_m=position,
        rotation=rotation,
    )


def _contact(
    t_ns: NDArray[np.int64], onsets: list[Onset], releases_ns: list[int]
) -> NDArray[np.bool_]:
    """Contact at every tick, from the times of change."""
    begun = np.searchsorted([o.t_ns for o in onsets], t_ns, side="right")
    ended = np.searchsorted(releases_ns, t_ns, side="right")
    # A leg that starts in the air reports one end before any beginning.
    if releases_ns and (not onsets or releases_ns[0] < onsets[0].t_ns):
        ended = np.maximum(ended - 1, 0)
    return np.asarray(begun > ended)
