"""The robot's MJCF put on a ground, with obstacles that can be moved.

An obstacle sits on a mocap body: a static geom that is moved at run time keeps its old bounds in
the broad phase.  Obstacles collide with one leg at a time, so that a wide plate under one leg never
lifts its neighbours: there is one set of them for whichever leg moves (:func:`expose`), or one for
every leg of a group.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from typing import Final

import mujoco
import numpy as np

from adaptive_contact_sim.elements import HEXAPOD, Elements, Layout
from adaptive_contact_sim.terrain import HARD_SOLREF, Terrain, soft_contact

# Bits of contype and conaffinity: what collides with the ground, and with obstacles.
_GROUND_BIT: Final = 1
_OBSTACLE_BIT: Final = 2

# Obstacles by name: geom type, half sizes in m.  ``plate`` is a block wide enough for any
# foothold, ``sphere`` a round stone, ``edge`` a rail of 5 mm radius, ``post`` an upright.
OBSTACLES: Final = {
    "plate": (mujoco.mjtGeom.mjGEOM_BOX, (0.06, 0.06, 0.10)),
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, (0.03, 0.0, 0.0)),
    "edge": (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.005, 0.06, 0.0)),
    "post": (mujoco.mjtGeom.mjGEOM_BOX, (0.01, 0.05, 0.10)),
}
# From an obstacle's centre up to its top, upright.
OBSTACLE_TOP_M: Final = {"plate": 0.10, "sphere": 0.03, "edge": 0.005, "post": 0.10}
# Where obstacles wait: out of sight, far from everything.
PARKED_M: Final = (0.0, 0.0, -3.0)


def robot_xml(name: str = "hexapod") -> str:
    """A robot's MJCF text, as shipped in ``adaptive_contact_models``."""
    file = resources.files("adaptive_contact_models").joinpath(name, f"{name}.xml")
    return file.read_text(encoding="utf-8")


def obstacle_name(shape: str, owner: str | None = None) -> str:
    """Name of an obstacle's geom and body: of the common set, or of a leg's own."""
    return f"obstacle_{shape}" if owner is None else f"obstacle_{owner}_{shape}"


def build(
    terrain: Terrain,
    *,
    obstacles: Sequence[str | None] = (),
    looks: bool = True,
    name: str = "hexapod",
    layout: Layout = HEXAPOD,
) -> mujoco.MjModel:
    """Compile the robot on a ground.

    Args:
        terrain: the ground.
        obstacles: owners of a set of the movable obstacles of :data:`OBSTACLES`, parked: a leg, or
            None for whichever leg they are exposed to.
        looks: with all that is only there to be seen, two geoms in three; without, a step takes
            less time and comes to the same, bit for bit.
        name: of the robot.
        layout: of it.
    """
    spec = mujoco.MjSpec.from_string(robot_xml(name))
    _add_surroundings(spec)
    terrain.add_to(spec)
    for owner in obstacles:
        bit = _OBSTACLE_BIT << (0 if owner is None else 1 + layout.legs.index(owner))
        # The engine's body filter is the union of the geoms' bits as compiled: legs must start
        # with all of them, or `expose` could never let them through.
        for leg in layout.legs if owner is None else (owner,):
            for part in layout.parts:
                spec.geom(f"{leg}_{part}").contype |= _GROUND_BIT | bit
        for shape, (kind, size) in OBSTACLES.items():
            name = obstacle_name(shape, owner)
            body = spec.worldbody.add_body(name=name, mocap=True, pos=list(PARKED_M))
            body.add_geom(
                name=name,
                type=kind,
                size=list(size),
                contype=0,
                conaffinity=bit,
                priority=2,
                friction=[0.9, 0.005, 0.0001],
                solref=list(HARD_SOLREF),
                material="obstacle",
            )
    spec.compiler.discardvisual = not looks
    model = spec.compile()
    terrain.set_stiffness(model, f"{layout.legs[0]}_foot")
    return model


def expose(model: mujoco.MjModel, elements: Elements, leg: int) -> None:
    """Let the common set of obstacles collide with one leg only."""
    for i, geoms in enumerate(elements.leg_geoms):
        model.geom_contype[geoms] = _GROUND_BIT | (_OBSTACLE_BIT if i == leg else 0)


def set_surface(
    model: mujoco.MjModel, geom: int, stiffness_n_m: float | None, inverse_mass: float
) -> None:
    """Make a geom hard (None), or as stiff as a spring under a body of that inverse mass, 1/kg."""
    model.geom_solref[geom], model.geom_solimp[geom] = (
        (HARD_SOLREF, (0.9, 0.95, 0.001, 0.5, 2.0))
        if stiffness_n_m is None
        else soft_contact(stiffness_n_m, inverse_mass)
    )


def _add_surroundings(spec: mujoco.MjSpec) -> None:
    """Sky, floor pattern, lights: for pictures only."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.55, 0.70, 0.88],
        rgb2=[0.93, 0.95, 0.97],
        width=256,
        height=256,
    )
    spec.add_texture(
        name="checker",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.66, 0.63, 0.57],
        rgb2=[0.58, 0.55, 0.50],
        mark=mujoco.mjtMark.mjMARK_EDGE,
        markrgb=[0.48, 0.46, 0.42],
        width=256,
        height=256,
    )
    for name, rgba in (("ground", [1.0, 1.0, 1.0, 1.0]), ("obstacle", [0.80, 0.42, 0.30, 1.0])):
        material = spec.add_material(name=name, rgba=rgba, specular=0.1, shininess=0.1)
        if name == "ground":
            textures = material.textures
            textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "checker"
            material.textures = textures
            material.texrepeat = np.array([5.0, 5.0])
            material.texuniform = True
    # On the robot, so that its shadow map goes with it; direction fixed in the world.
    light = spec.body("body").add_light(
        name="sun",
        pos=[0.9, -1.3, 2.4],
        dir=[-0.3, 0.45, -0.85],
        diffuse=[0.65, 0.63, 0.60],
        specular=[0.2, 0.2, 0.2],
        castshadow=True,
    )
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
