from __future__ import annotations

import mujoco
import numpy as np
import pytest

from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact_sim.elements import JOINTS, LEGS, PARTS
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.scene import build
from adaptive_contact_sim.servo import ServoParameters
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import Terrain, TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

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


def test_model_file_agrees_with_the_robot_description() -> None:
    """Feet where the closed form puts them, for any joint angles within limits."""
    plant, geometry = flat_plant(), LegGeometry()
    rng = np.random.default_rng(0)
    for _ in range(20):
        joints = rng.uniform(geometry.lower_rad, geometry.upper_rad, (len(LEGS), len(JOINTS)))
        plant.place(np.array([0.0, 0.0, 0.5]), np.array([1.0, 0, 0, 0]), joints.reshape(-1))
        feet = geometry.to_body(geometry.feet(joints)) + np.array([0.0, 0.0, 0.5])
        assert np.allclose(plant.foot_positions(), feet, atol=1e-5)
    for leg in LEGS:
        for k, joint in enumerate(JOINTS):
            limits = plant.model.joint(f"{leg}_{joint}").range
            assert limits[0] == pytest.approx(geometry.lower_rad[k], abs=1e-3)
            assert limits[1] == pytest.approx(geometry.upper_rad[k], abs=1e-3)


def test_legs_touch_ground_and_obstacles_only() -> None:
    sim = Simulation(ROBOTS["obstacles"])
    legs = sim.plant.elements.geom_leg
    for _ in range(200):
        sim.advance()
        for pair in sim.plant.data.contact.geom:
            assert (legs[pair] >= 0).sum() <= 1
            for geom, other in (tuple(pair), tuple(reversed(pair))):
                if sim.plant.model.geom(int(other)).name.startswith("obstacle_"):
                    assert legs[geom] == LEGS.index("rf")


@pytest.mark.parametrize("bad", [np.nan, 1e4])
def test_divergence_raises(bad: float) -> None:
    sim = Simulation(SimulationSettings())
    sim.advance()
    sim.plant.data.qvel[8] = bad
    with pytest.raises(SimulationDivergedError, match="at 0"):
        sim.advance()


def test_payload_never_compounds() -> None:
    """Any way to a mass gives the model of that mass, and nothing gives the first one back."""
    names = [
        *("body_mass", "body_inertia", "body_subtreemass", "body_invweight0"),
        *("dof_invweight0", "dof_M0", "actuator_acc0"),
    ]

    def state(plant: Plant) -> dict[str, np.ndarray]:
        return {name: getattr(plant.model, name).copy() for name in names}

    fresh = flat_plant()
    before = state(fresh)
    direct = flat_plant()
    direct.set_payload(np.array([0, 0, 0, 0.05, 0, 0.02]))
    for masses in ([0.1] * 6, [0.0] * 6, [0.3, 0, 0, 0.05, 0, 0], [0, 0, 0, 0.05, 0, 0.02]):
        fresh.set_payload(np.array(masses, dtype=float))
        fresh.set_payload(np.array(masses, dtype=float))
    for name, value in state(direct).items():
        assert np.array_equal(state(fresh)[name], value), name
    total = fresh.model.body_subtreemass[fresh.elements.body]
    fresh.set_payload(np.zeros(6))
    for name, value in before.items():
        assert np.array_equal(state(fresh)[name], value), name
    assert total - fresh.model.body_subtreemass[fresh.elements.body] == pytest.approx(0.07)


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
