from __future__ import annotations

import mujoco
import numpy as np
import pytest

from adaptive_contact_sim.scene import build
from adaptive_contact_sim.terrain import Terrain, TerrainSettings, soft_contact


@pytest.mark.parametrize(
    ("kind", "error_m"), [("flat", 1e-9), ("steps", 1e-6), ("rough", 0.004), ("holes", 0.02)]
)
def test_heights_are_the_engines(kind: str, error_m: float) -> None:
    """Asked by a ray from above; the rough field's cells are triangles there, bilinear here."""
    terrain = Terrain(TerrainSettings(kind=kind, seed=3))
    model = build(terrain)
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.0, 0.0, 5.0  # out of the way
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-2.5, 2.5, (2, 300))
    expected = terrain.height_at(x, y)
    groups = np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
    found = np.zeros(1, dtype=np.int32)
    down, normal = np.array([0.0, 0.0, -1.0]), np.zeros(3)
    heights = np.array(
        [
            1.0
            - mujoco.mj_ray(model, data, np.array([a, b, 1.0]), down, groups, 1, -1, found, normal)
            for a, b in zip(x, y, strict=True)
        ]
    )
    assert np.abs(heights - expected).max() < error_m


@pytest.mark.parametrize("stiffness", [300.0, 1000.0, 5000.0])
def test_soft_ground_is_as_stiff_as_it_says(stiffness: float) -> None:
    """A known weight on one foot, let down gently: it sinks by weight over stiffness."""
    mass = 0.5
    xml = f"""<mujoco><option timestep="0.001" integrator="implicitfast" cone="pyramidal"/>
      <worldbody>
        <geom name="ground" type="plane" size="1 1 .1" contype="0" conaffinity="1" priority="1"/>
        <body name="ball" pos="0 0 0.0081"><freejoint/>
          <geom name="ball" type="sphere" size="0.008" mass="{mass}" contype="1" conaffinity="0"/>
        </body>
      </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    solref, solimp = soft_contact(stiffness, float(model.body_invweight0[1, 0]))
    model.geom_solref[0], model.geom_solimp[0] = solref, solimp
    deepest = 0.0
    for _ in range(4000):
        mujoco.mj_step(model, data)
        deepest = max(deepest, 0.008 - data.qpos[2])
    sunk = 0.008 - data.qpos[2]
    assert sunk == pytest.approx(mass * 9.81 / stiffness, rel=0.1)
    assert deepest < 3.0 * sunk  # damped, not bouncing about
