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
from adaptive_contact_sim.simulation import Simulation, SimulationSettings


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
    changes: tuple[ContactTruth, ...]  # of contact, in order of time

    @property
    def onsets(self) -> list[ContactTruth]:
        """Contacts that began, in order."""
        return [change for change in self.changes if change.contact]

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


def record_arrays(settings: SimulationSettings, seconds: float) -> Run:
    """Simulate as fast as possible into arrays.

    Args:
        settings: what to simulate.
        seconds: simulated time.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    return record_run(Simulation(settings), seconds)


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
    changes: list[list[ContactTruth]] = [[] for _ in layout.legs]

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
            changes[change.leg].append(sim.truth_of(change).message)
    t_ns = settings.epoch_ns + np.arange(n, dtype=np.int64) * round(settings.period_s * 1e9)
    return Run(
        t_ns=t_ns,
        legs={
            leg: LegArrays(
                measured=measured[:, i],
                desired=desired[:, i],
                valid=valid[:, i],
                swing=swing[:, i],
                contact=contact_at(t_ns, changes[row]),
                force_n=force[:, i],
                angle=angle[:, i],
                changes=tuple(changes[row]),
            )
            for i, (leg, row) in enumerate(kept.items())
        },
        position_m=position,
        rotation=rotation,
    )


def contact_at(t_ns: Ints, changes: Sequence[ContactTruth]) -> Mask:
    """Contact at every tick, from changes in order of time."""
    changed = np.searchsorted([change.t_ns for change in changes], t_ns, side="right")
    return np.array([False, *(change.contact for change in changes)])[changed]
