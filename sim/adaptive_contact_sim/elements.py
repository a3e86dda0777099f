"""The simulated robot's elements by name, resolved once to indices.

A :class:`Layout` names a robot's legs, their joints and their parts.  Every array of the simulator
is ordered like it: index ``J * leg + joint`` for servos.  The model file names each element
``{leg}_{part}``; nothing else relies on the order of elements in the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from adaptive_contact.arrays import Ints
from adaptive_contact.errors import ConfigurationError


@dataclass(frozen=True)
class Layout:
    """Names of a robot's elements, in the order of the simulator's arrays."""

    legs: tuple[str, ...]  # their ids
    joints: tuple[str, ...]  # of every leg, from the body outwards
    parts: tuple[str, ...]  # what of a leg may touch something, likewise; each has a touch sensor

    @property
    def n_servos(self) -> int:
        """Of all legs."""
        return len(self.legs) * len(self.joints)

    @property
    def servos(self) -> list[tuple[str, str]]:
        """(leg, joint) of all, in order."""
        return [(leg, joint) for leg in self.legs for joint in self.joints]

    def servo_indices(self, leg: str | None, joint: str | None) -> Ints:
        """Indices of the servos meant by a leg and a joint, None standing for all.

        Raises:
            ConfigurationError: there is no such leg or joint.
        """
        if leg is not None and leg not in self.legs:
            raise ConfigurationError(
                f"no leg '{leg}'; the legs are {', '.join(self.legs)} (leave it out for all)"
            )
        if joint is not None and joint not in self.joints:
            raise ConfigurationError(
                f"no joint '{joint}'; the joints are {', '.join(self.joints)} "
                "(leave it out for all)"
            )
        legs = range(len(self.legs)) if leg is None else [self.legs.index(leg)]
        joints = range(len(self.joints)) if joint is None else [self.joints.index(joint)]
        return np.array([len(self.joints) * a + b for a in legs for b in joints], dtype=np.intp)


# The hexapod's, which experiments, scenarios and the virtual bus are made for.
LEGS: Final = ("lf", "lm", "lr", "rf", "rm", "rr")
JOINTS: Final = ("coxa", "femur", "tibia")
N_SERVOS: Final = len(LEGS) * len(JOINTS)
PARTS: Final = ("coxa", "femur", "tibia", "foot")
HEXAPOD: Final = Layout(LEGS, JOINTS, PARTS)


@dataclass(frozen=True)
class Elements:
    """Indices into a compiled model, by meaning."""

    layout: Layout  # names, in the order of the indices
    # qpos, dof: slices of the servo joints in `qpos` and `qvel`
    qpos: slice
    dof: slice
    ctrl: slice  # slice of the motors in `ctrl`
    touch: slice  # slice of the touch sensors in `sensordata`, part fastest
    body: int  # id of the base
    floats: bool  # whether the base moves freely; otherwise it hangs on the world
    foot_sites: Ints  # (L,) ids of the foot points
    payloads: Ints  # (L,) body ids of the masses at the foot ends
    geom_leg: Ints  # (ngeom,) leg of a geom that collides, -1 for others
    geom_part: Ints  # (ngeom,) index into the layout's parts, -1 for others
    leg_geoms: tuple[Ints, ...]  # per leg, ids of its colliding geoms

    @classmethod
    def resolve(cls, model: mujoco.MjModel, layout: Layout = HEXAPOD) -> Elements:
        """Look up every element the simulator uses.

        Raises:
            KeyError: the model file lacks one.
            ConfigurationError: it orders the servos otherwise.
        """
        legs, parts = layout.legs, layout.parts
        servos = [f"{leg}_{joint}" for leg, joint in layout.servos]
        of_legs = [f"{leg}_{part}" for leg in legs for part in parts]
        joints = [model.joint(name) for name in servos]
        geoms = [model.geom(name).id for name in of_legs]
        geom_leg = np.full(model.ngeom, -1, dtype=np.intp)
        geom_part = geom_leg.copy()
        geom_leg[geoms] = np.repeat(np.arange(len(legs)), len(parts))
        geom_part[geoms] = np.tile(np.arange(len(parts)), len(legs))
        body = model.body("body").id
        return cls(
            layout=layout,
            qpos=_run(int(joint.qposadr[0]) for joint in joints),
            dof=_run(int(joint.dofadr[0]) for joint in joints),
            ctrl=_run(model.actuator(name).id for name in servos),
            touch=_run(int(model.sensor(f"{name}_touch").adr[0]) for name in of_legs),
            body=body,
            floats=bool(model.body_dofnum[body]),
            foot_sites=np.array([model.site(f"{leg}_foot").id for leg in legs]),
            payloads=np.array([model.body(f"{leg}_payload").id for leg in legs]),
            geom_leg=geom_leg,
            geom_part=geom_part,
            leg_geoms=tuple(np.flatnonzero(geom_leg == i) for i in range(len(legs))),
        )


def _run(addresses: Iterable[int]) -> slice:
    """Turn consecutive addresses into a slice, so that views of engine arrays can be kept."""
    found = [int(a) for a in addresses]
    if found != list(range(found[0], found[0] + len(found))):
        raise ConfigurationError(
            f"the robot model orders its elements as {found}; expected leg by leg, "
            "from the body outwards"
        )
    return slice(found[0], found[0] + len(found))
