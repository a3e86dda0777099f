"""Servos of a robot on a stand: MuJoCo links and servo laws, goals only from the bus.

The body is fixed; all legs hang free, or reach the floor where the stand is low enough.  Physics
runs in steps of 1 ms as time goes by, so a goal written at any moment acts from that moment on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.elements import LEGS, N_SERVOS, PARTS
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import on_a_stand
from adaptive_contact_sim.servo import QUANTUM_RAD, manufactured
from adaptive_contact_sim.terrain import HARD_SOLREF
from adaptive_contact_sim.truth import TruthTracker
from adaptive_contact_sim.virtual.horns import STEP_S, Horns, OnStand

OnTruth = Callable[[str, ContactTruth], None]

# Of the body over the floor, with the legs out of reach of it.
HUNG_M: Final = 1.0
# Contact truth is judged in batches of a control tick.
_BATCH: Final = 20


class PassiveBackend(OnStand):
    """A hexapod on a stand; a backend of virtual servos.

    Args:
        horns: how the servos are mounted.
        height_m: of the body over the floor.
        epoch_ns: wall clock of the start, for the truth's time stamps.
        on_truth: gets changes of contact.
    """

    def __init__(
        self,
        horns: Horns,
        *,
        height_m: float = HUNG_M,
        epoch_ns: int = 0,
        on_truth: OnTruth = lambda *_: None,
    ) -> None:
        self.plant = Plant(_on_a_stand(height_m), manufactured(0), period_s=STEP_S)
        super().__init__(horns, self.plant, np.zeros(N_SERVOS), epoch_ns)  # stretched out level
        self.plant.joint_angles[:] = 0.0
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self._written: Array | None = None
        self._truth = TruthTracker(STEP_S, _BATCH)
        self._forces = np.zeros((_BATCH, len(LEGS)))
        self._on_truth = on_truth
        self._begun = False

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's compliance slope."""
        self.plant.servos.parameters.slope_steps[index] = slope_rad / QUANTUM_RAD
        self.plant.servos.refresh()

    def step(self) -> None:
        """Make one step, and judge contacts when a batch is full."""
        plant, target = self.plant, self.target()
        if self._written is None or not np.array_equal(target, self._written):
            plant.servos.write_goal(target)
            self._written = target
        plant.advance()
        row = (plant.steps - 1) % _BATCH
        self._forces[row] = plant.forces[0]
        if row == _BATCH - 1:
            self._judge()

    def _judge(self) -> None:
        plant, changes = self.plant, []
        if not self._begun:
            self._begun = True
            changes = self._truth.start(self._forces.mean(axis=0), plant.steps - _BATCH)
        changes += self._truth.update(self._forces, plant.touches, plant.steps)
        for change in changes:
            t_ns = self._epoch_ns + change.step * round(STEP_S * 1e9)
            self._on_truth(LEGS[change.leg], change.message(t_ns, PARTS, lambda _: "hard"))


def _on_a_stand(height_m: float) -> mujoco.MjModel:
    """The robot with its body fixed over a hard floor."""
    spec = on_a_stand(height_m)
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2.0, 2.0, 0.1],
        contype=0,
        conaffinity=1,
        friction=[0.9, 0.005, 0.0001],
        solref=list(HARD_SOLREF),
    )
    return spec.compile()
