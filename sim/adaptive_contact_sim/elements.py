"""The simulated robot's elements by name, resolved once to indices.

Every array of the simulator is ordered like :data:`LEGS` and :data:`JOINTS`: index
``3 * leg + joint`` for servos.  The model file names each element ``{leg}_{part}``; nothing else
relies on the order of elements in the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError

__all__ = ["JOINTS", "LEGS", "N_SERVOS", "PARTS", "Elements", "servo_indices"]

LEGS: Final = ("lf", "lm", "lr", "rf", "rm", "rr")
JOINTS: Final = ("coxa", "femur", "tibia")
N_SERVOS: Final = len(LEGS) * len(JOINTS)
# What of a leg may touch something, from the body outwards; each has a touch sensor.
PARTS: Final = ("coxa", "femur", "tibia", "foot")

IntArray = NDArray[np.intp]


def servo_indices(leg: str | None, joint: str | None) -> IntArray:
    """Indices of the servos meant by a leg and a joint, None standing for all.

    Raises:
        ConfigurationError: there is no such leg or joint.
    """
    if leg is not None and leg not in LEGS:
        raise ConfigurationError(
            f"no leg '{leg}'; the legs are {', '.join(LEGS)} (leave it out for all)"
        )
    if joint is not None and joint not in JOINTS:
        raise ConfigurationError(
            f"no joint '{joint}'; the joints are {', '.join(JOINTS)} (leave it out for all)"
        )
    legs = range(len(LEGS)) if leg is None else [LEGS.index(leg)]
    joints = range(len(JOINTS)) if joint is None else [JOINTS.index(joint)]
    return np.array([len(JOINTS) * a + b for a in legs for b in joints], dtype=np.intp)


@dataclass(frozen=True)
class Elements:
    """Indices into a compiled model, by meaning.

    Attributes:
        qpos, dof: slices of the 18 servo joints in ``qpos`` and ``qvel``.
        ctrl: slice of the 18 motors in ``ctrl``.
        touch: slice of the 6 x 4 touch sensors in ``sensordata``, part fastest.
        body: id of the floating base.
        foot_sites: (6,) ids of the foot points.
        payloads: (6,) body ids of the masses at the foot ends.
        geom_leg: (ngeom,) leg of a geom that collides, -1 for others.
        geom_part: (ngeom,) index into :data:`PARTS`, -1 for others.
        leg_geoms: per leg, ids of its colliding geoms.
    """

    qpos: slice
    dof: slice
    ctrl: slice
    touch: slice
    body: int
    foot_sites: IntArray
    payloads: IntArray
    geom_leg: IntArray
    geom_part: IntArray
    leg_geoms: tuple[IntArray, ...]

    @classmethod
    def resolve(cls, model: mujoco.MjModel) -> Elements:
        """Look up every element the simulator uses.

        Raises:
            ConfigurationError: the model file lacks one, or orders the servos otherwise.
        """
        servos = [f"{leg}_{joint}" for leg in LEGS for joint in JOINTS]
        joints = [_id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in servos]
        geom_leg = np.full(model.ngeom, -1, dtype=np.intp)
        geom_part = np.full(model.ngeom, -1, dtype=np.intp)
        for i, leg in enumerate(LEGS):
            for k, part in enumerate(PARTS):
                geom = _id(model, mujoco.mjtObj.mjOBJ_GEOM, f"{leg}_{part}")
                geom_leg[geom], geom_part[geom] = i, k
        return cls(
            qpos=_run(int(model.jnt_qposadr[joint]) for joint in joints),
            dof=_run(int(model.jnt_dofadr[joint]) for joint in joints),
            ctrl=_run(_id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name) for name in servos),
            touch=_run(
                int(model.sensor_adr[_id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{leg}_{part}_touch")])
                for leg in LEGS
                for part in PARTS
            ),
            body=_id(model, mujoco.mjtObj.mjOBJ_BODY, "body"),
            foot_sites=np.array(
                [_id(model, mujoco.mjtObj.mjOBJ_SITE, f"{leg}_foot") for leg in LEGS]
            ),
            payloads=np.array(
                [_id(model, mujoco.mjtObj.mjOBJ_BODY, f"{leg}_payload") for leg in LEGS]
            ),
            geom_leg=geom_leg,
            geom_part=geom_part,
            leg_geoms=tuple(np.flatnonzero(geom_leg == i) for i in range(len(LEGS))),
        )


def _id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    index = int(mujoco.mj_name2id(model, kind, name))
    if index < 0:
        what = kind.name.removeprefix("mjOBJ_").lower()
        raise ConfigurationError(f"the robot model has no {what} '{name}'; add it to the MJCF file")
    return index


def _run(addresses: Iterable[int]) -> slice:
    """Turn consecutive addresses into a slice, so that views of engine arrays can be kept."""
    found = [int(a) for a in addresses]
    if found != list(range(found[0], found[0] + len(found))):
        raise ConfigurationError(
            f"the robot model orders its elements as {found}; expected leg by leg "
            f"({', '.join(LEGS)}), from the body outwards"
        )
    return slice(found[0], found[0] + len(found))
