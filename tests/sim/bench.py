"""Eighteen servos on a test bench: light arms on the world, nothing else."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.gear import GearTrain
from adaptive_contact_sim.servo import ServoBank, ServoParameters


class Bench(NamedTuple):
    model: mujoco.MjModel
    data: mujoco.MjData
    servos: ServoBank
    gears: GearTrain

    def step(self) -> None:
        self.servos.drive()
        if self.gears.active:
            self.gears.step()
        mujoco.mj_step(self.model, self.data)
        self.servos.rub()
        if self.gears.active:
            self.gears.rub()


def make_bench(
    parameters: ServoParameters | None = None,
    *,
    load_nm: float = 0.0,
    inertia_kgm2: float = 1e-4,
) -> Bench:
    """Build it; ``load_nm`` pulls every arm down while it is near level."""
    mass, arm = 1.0, load_nm / 9.81
    body = (
        '<body pos="0 {i} 0"><joint name="j{i}" axis="0 -1 0" solreffriction="0.004 1"'
        ' solimpfriction="0.995 0.995 0.001"/><inertial pos="{arm} 0 0" mass="{mass}"'
        ' diaginertia="{j} {j} {j}"/></body>'
    )
    j = inertia_kgm2
    xml = "".join(body.format(i=i, arm=arm, mass=mass, j=j) for i in range(N_SERVOS))
    motors = "".join(f'<motor joint="j{i}"/>' for i in range(N_SERVOS))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.001" integrator="implicitfast"/>'
        f"<worldbody>{xml}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    data = mujoco.MjData(model)
    parameters = parameters or ServoParameters()
    model.dof_armature[:] = parameters.armature_kgm2
    servos = ServoBank(
        parameters,
        position=data.qpos,
        velocity=data.qvel,
        acceleration=data.qacc,
        torque=data.ctrl,
        friction=model.dof_frictionloss,
        damping=model.dof_damping,
    )
    gears = GearTrain(servos, model.dof_armature, model.opt.timestep)
    set_const(model)
    return Bench(model, data, servos, gears)


def set_const(model: mujoco.MjModel) -> None:
    mujoco.mj_setConst(model, mujoco.MjData(model))


def every(value: float) -> np.ndarray:
    return np.full(N_SERVOS, value)
