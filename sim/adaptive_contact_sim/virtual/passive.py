"""Servos of a robot on a stand: MuJoCo links and servo laws, goals only from the bus.

The body is fixed; all legs hang free, or reach the floor where the stand is low enough.  Physics
runs in steps of 1 ms as time goes by, so a goal written at any moment acts from that moment on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.elements import JOINTS, LEGS, N_SERVOS, PARTS
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import robot_xml
from adaptive_contact_sim.servo import QUANTUM_RAD, manufactured
from adaptive_contact_sim.terrain import HARD_SOLREF
from adaptive_contact_sim.truth import TruthTracker
from adaptive_contact_sim.virtual.horns import Horns

__all__ = ["HUNG_M", "PassiveBackend"]

Array = NDArray[np.float64]
OnTruth = Callable[[str, ContactTruth], None]

# Of the body over the floor, with the legs out of reach of it.
HUNG_M: Final = 1.0
_STEP_S: Final = 0.001
# Contact truth is judged in batches of a control tick.
_BATCH: Final = 20
# Steps made at one call: more would keep the bus waiting.
_MOST_STEPS: Final = 5
_LET_GO_S: Final = 0.5


class PassiveBackend:
    """A hexapod on a stand; a backend of virtual servos.

    Args:
        horns: how the servos are mounted.
        height_m: of the body over the floor.
        robot_seed: which robot of its kind.
        start_rad: (18,) joint angles at first; legs stretched out level where left out.
        epoch_ns: wall clock of the start, for the truth's time stamps.
        on_truth: gets changes of contact.
    """

    def __init__(
        self,
        horns: Horns,
        *,
        height_m: float = HUNG_M,
        robot_seed: int = 0,
        start_rad: Array | None = None,
        epoch_ns: int = 0,
        on_truth: OnTruth = lambda *_: None,
    ) -> None:
        self._horns = horns
        self.plant = Plant(_on_a_stand(height_m), manufactured(robot_seed), period_s=_STEP_S)
        start = np.zeros(N_SERVOS) if start_rad is None else np.array(start_rad, dtype=np.float64)
        self.plant.joint_angles[:] = start
        mujoco.mj_forward(self.plant.model, self.plant.data)
        self._goal = start.copy()
        self._on = np.zeros(N_SERVOS, dtype=np.bool_)
        self._changed = True
        self._truth = TruthTracker(_STEP_S, _BATCH)
        self._forces = np.zeros((_BATCH, len(LEGS)))
        self._epoch_ns = epoch_ns
        self._on_truth = on_truth
        self._begun = False
        self._start_s: float | None = None

    def advance(self, now_s: float) -> float:
        """Bring the robot up to a moment."""
        if self._start_s is None:
            self._start_s = now_s
        target = int((now_s - self._start_s) / _STEP_S)
        behind = target - self.plant.steps
        if behind * _STEP_S > _LET_GO_S:
            lost_s = behind * _STEP_S
            self._start_s += lost_s
            self._epoch_ns += round(lost_s * 1e9)
            target = self.plant.steps
        for _ in range(min(target - self.plant.steps, _MOST_STEPS)):
            self._step()
        return self._start_s + (self.plant.steps + 1) * _STEP_S

    def angle(self, index: int) -> float:
        """Angle of a servo's horn, rad."""
        return self._horns.horn(index, float(self.plant.joint_angles[index]))

    def speed(self, index: int) -> float:
        """Speed of a servo's horn, rad/s."""
        return float(self._horns.direction[index] * self.plant.joint_speeds[index])

    def set_goal(self, index: int, angle_rad: float) -> None:
        """Write a servo's goal."""
        self._goal[index] = self._horns.joint(index, angle_rad)
        self._changed = True

    def goal(self, index: int) -> float | None:
        """Nobody but the bus writes goals."""
        return None

    def set_torque(self, index: int, on: bool) -> None:
        """Switch a servo's drive on or off."""
        self._on[index] = on
        self._changed = True

    def set_slope(self, index: int, slope_rad: float) -> None:
        """Set a servo's compliance slope."""
        self.plant.servos.parameters.slope_steps[index] = slope_rad / QUANTUM_RAD
        self.plant.servos.refresh()

    # -- private -------------------------------------------------------------------------------

    def _step(self) -> None:
        plant = self.plant
        if self._changed or not self._on.all():
            # A servo without torque has its goal where it is: no error, no drive.
            plant.servos.write_goal(np.where(self._on, self._goal, plant.joint_angles))
            self._changed = False
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
            touch = change.touch
            self._on_truth(
                LEGS[change.leg],
                ContactTruth(
                    t_ns=self._epoch_ns + change.step * round(_STEP_S * 1e9),
                    contact=change.contact,
                    force=change.force_n,
                    speed_m_s=None if touch is None else touch.speed_m_s,
                    surface=None if touch is None else "hard",
                    part=None if touch is None else PARTS[touch.part],
                    grazing=touch is not None and touch.grazing,
                ),
            )


def order() -> list[tuple[str, str]]:
    """(leg, joint) in the order of the simulator's servos."""
    return [(leg, joint) for leg in LEGS for joint in JOINTS]


def _on_a_stand(height_m: float) -> mujoco.MjModel:
    """The robot with its body fixed over a hard floor."""
    spec = mujoco.MjSpec.from_string(robot_xml())
    spec.delete(spec.joint("body"))
    spec.body("body").pos = [0.0, 0.0, height_m]
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
