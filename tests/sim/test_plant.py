from __future__ import annotations

import mujoco
import numpy as np
import pytest

from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact_sim import (
    ObstacleSettings,
    PoseSettings,
    Simulation,
    SimulationSettings,
    WalkSettings,
)
from adaptive_contact_sim.elements import LEGS, PARTS
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.scene import build
from adaptive_contact_sim.servo import ServoParameters
from adaptive_contact_sim.terrain import Terrain, TerrainSettings

ROBOTS = {
    "rough": SimulationSettings(motion=WalkSettings(), terrain=TerrainSettings(kind="rough")),
    "steps": SimulationSettings(
        motion=WalkSettings(gait="ripple"), terrain=TerrainSettings(kind="steps")
    ),
    "obstacles": SimulationSettings(
        motion=PoseSettings(obstacles=ObstacleSettings(probability=1.0))
    ),
}


def flat_plant() -> Plant:
    return Plant(build(Terrain(TerrainSettings(kind="flat", seed=0))), ServoParameters())


@pytest.mark.parametrize("name", ROBOTS)
def test_touch_sensors_tell_the_contact_forces(name: str) -> None:
    """Against mj_contactForce, contact by contact, in the same physics step."""
    sim = Simulation(ROBOTS[name])
    plant = sim.plant
    worst, touched = 0.0, 0
    for _ in range(250):
        sim.advance()
        # The engine's contacts are those of the tick's last step, and so is the last row.
        expected = np.zeros((len(LEGS), len(PARTS)))
        wrench = np.zeros(6)
        for k in range(plant.data.ncon):
            mujoco.mj_contactForce(plant.model, plant.data, k, wrench)
            for geom in plant.data.contact[k].geom:
                leg = plant.elements.geom_leg[geom]
                if leg >= 0:
                    expected[leg, plant.elements.geom_part[geom]] += wrench[0]
        sensed = plant.data.sensordata[plant.elements.touch].reshape(expected.shape)
        worst = max(worst, float(np.abs(sensed - expected).max()))
        worst = max(worst, float(np.abs(plant.forces[-1] - expected.sum(axis=1)).max()))
        touched += int((expected > 0.0).sum())
    assert touched > 500
    assert worst < 1e-9


@pytest.mark.parametrize("bad", [np.nan, 1e4])
def test_divergence_raises(bad: float) -> None:
    sim = Simulation(SimulationSettings())
    sim.advance()
    sim.plant.data.qvel[8] = bad
    with pytest.raises(SimulationDivergedError, match="at 0"):
        sim.advance()


@pytest.mark.parametrize("last", [(0, 0, 0, 0.05, 0, 0.02), (0, 0, 0, 0, 0, 0)])
def test_payload_never_compounds(last: tuple[float, ...]) -> None:
    """Any way to a mass gives the model of that mass, and nothing gives the first one back."""
    direct, changed = flat_plant(), flat_plant()
    if any(last):
        direct.set_payload(np.array(last))
    for masses in ([0.1] * 6, [0.0] * 6, [0.3, 0, 0, 0.05, 0, 0], last, last):
        changed.set_payload(np.array(masses, dtype=float))
    for name in (
        *("body_mass", "body_inertia", "body_subtreemass", "body_invweight0"),
        *("dof_invweight0", "dof_M0", "actuator_acc0"),
    ):
        assert np.array_equal(getattr(direct.model, name), getattr(changed.model, name)), name


def test_payload_is_felt_and_leaves_the_state_alone() -> None:
    plant = flat_plant()
    joints = np.tile([0.0, 0.3, -1.2], 6)
    plant.place(np.array([0.0, 0.0, 0.5]), np.array([1.0, 0, 0, 0]), joints)
    qpos = plant.data.qpos.copy()
    before = plant.data.qfrc_bias.copy()
    plant.set_payload(np.array([0.0, 0, 0, 0.1, 0, 0]))
    assert np.array_equal(plant.data.qpos, qpos)
    mujoco.mj_forward(plant.model, plant.data)
    change = plant.data.qfrc_bias - before
    weight = 0.1 * 9.81
    # On the femur of rf: the weight times its level distance from the femur's axis.
    arm = 0.066 * np.cos(0.3) + 0.125 * np.cos(0.3 - 1.2)
    femur = plant.model.joint("rf_femur").dofadr[0]
    assert change[femur] == pytest.approx(weight * arm, rel=1e-3)
    assert change[plant.model.joint("lf_femur").dofadr[0]] == pytest.approx(0.0, abs=1e-9)
