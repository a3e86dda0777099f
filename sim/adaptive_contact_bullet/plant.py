"""The physics: one robot on its ground in Bullet, step by step."""

from __future__ import annotations

import dataclasses
import functools
import math
import tempfile
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import pybullet as bullet

from adaptive_contact.arrays import Array, Mask
from adaptive_contact_bullet.robots import Shape, rest_angles
from adaptive_contact_bullet.servo import Drives

STEP_S: Final = 0.001
_G: Final = 9.81
_HUNG_M: Final = 1.0  # a body that hangs
_PARKED: Final = (0.0, 0.0, -3.0)
_PLATE_M: Final = (0.06, 0.06, 0.005)  # half extents
_GROUND_M: Final = 2000.0  # half of the ground: hours of walking
_AREA_M: Final = 1.6  # bumps are so far ahead, behind and beside at most

Kind = Literal["hard", "soft", "tilted", "rough", "none"]


@dataclasses.dataclass(frozen=True)
class Ground:
    """What the feet meet."""

    kind: Kind = "hard"
    stiffness_n_m: float = 1500.0  # of soft ground
    tilt_rad: float = 0.12


class State(NamedTuple):
    """A state to go back to: all but what the engine remembers of its contacts."""

    place: Any
    turn: Any
    velocity: Any  # of the body, linear and angular
    angles: Array
    speeds: Array
    drives: Any


class _Bound:
    """The engine's functions for one world."""

    def __init__(self, world: int) -> None:
        self._world = world

    def __getattr__(self, name: str) -> Any:
        function = functools.partial(getattr(bullet, name), physicsClientId=self._world)
        setattr(self, name, function)
        return function


class Plant:
    """A robot on its ground; with ground ``none`` its body hangs.

    Args:
        shape: the robot.
        ground: under it.
        rng: of the ground and of readings.
        robot_seed: of the servos, which differ within their make.
        fixed: the body does not move.
    """

    def __init__(
        self,
        shape: Shape,
        ground: Ground,
        rng: np.random.Generator,
        *,
        robot_seed: int = 1,
        fixed: bool = False,
    ) -> None:
        self._shape = shape
        engine = self._engine = _Bound(bullet.connect(bullet.DIRECT))
        engine.setTimeStep(STEP_S)
        tilt = ground.tilt_rad if ground.kind == "tilted" else 0.0
        engine.setGravity(_G * math.sin(tilt), 0.0, -_G * math.cos(tilt))
        self._bumps_m = np.zeros((0, 2))  # centres
        self._grounds = [] if ground.kind == "none" else self._lay(ground, rng)
        rest = rest_angles(shape)
        hung = fixed or ground.kind == "none"
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "robot.urdf")
            path.write_text(shape.urdf())
            self._robot = engine.loadURDF(
                str(path),
                [0.0, 0.0, _HUNG_M if hung else self._standing_m(rest)],
                useFixedBase=hung,
                flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            )
        self._n = len(rest)
        self._joints = list(range(self._n))
        for link in range(-1, self._n):
            engine.changeDynamics(
                self._robot, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0,
                lateralFriction=0.9, restitution=0.0,
            )  # fmt: skip
        for joint, angle in enumerate(rest):
            engine.resetJointState(self._robot, joint, angle)
        engine.setJointMotorControlArray(
            self._robot, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * self._n
        )
        self.drives = Drives(shape.servo, rest, rng, STEP_S, robot_seed)
        self._read_joints()
        half = [*_PLATE_M]
        box = engine.createCollisionShape(bullet.GEOM_BOX, halfExtents=half)
        self._plates = [engine.createMultiBody(0.0, box, basePosition=_PARKED) for _ in shape.legs]
        if not fixed:
            for plate in self._plates:
                engine.removeBody(plate)
            self._plates = []
        for body in self._grounds + self._plates:
            self._surface(body, ground)

    def close(self) -> None:
        """Free the engine."""
        self._engine.disconnect()

    def _standing_m(self, rest: Array) -> float:
        robot = self._shape.description
        chain = robot.leg(self._shape.legs[0].id).chain
        assert chain is not None
        return float(-chain.foot(rest[: self._shape.joints])[2] + self._shape.sole_m + 0.03)

    def _lay(self, ground: Ground, rng: np.random.Generator) -> list[int]:
        engine = self._engine
        half = [_GROUND_M, _GROUND_M, 0.5]
        plane = engine.createCollisionShape(bullet.GEOM_BOX, halfExtents=half)
        laid = [engine.createMultiBody(0.0, plane, basePosition=[0.0, 0.0, -0.5])]
        if ground.kind != "rough":
            return laid
        self._bumps_m = np.zeros((220, 2))
        for at in self._bumps_m:
            height = rng.uniform(0.3, 1.0) * self._shape.bump_m
            sides = rng.uniform(0.03, 0.1, 2)
            box = engine.createCollisionShape(
                bullet.GEOM_BOX, halfExtents=[*sides.tolist(), height]
            )
            at[:] = rng.uniform(-_AREA_M, _AREA_M, 2)
            turn = engine.getQuaternionFromEuler([0.0, 0.0, rng.uniform(0.0, math.pi)])
            laid.append(engine.createMultiBody(0.0, box, -1, [*at.tolist(), 0.0], turn))
        return laid

    def _lay_ahead(self) -> None:
        """Move the bumps that the robot has left behind ahead of it: rough ground has no end."""
        engine, side = self._engine, 2.0 * _AREA_M
        here = np.array(engine.getBasePositionAndOrientation(self._robot)[0][:2])
        moves = side * np.round((here - self._bumps_m) / side)
        self._bumps_m += moves
        for bump in np.flatnonzero(moves.any(axis=1)).tolist():
            body, at = self._grounds[1 + bump], [*self._bumps_m[bump].tolist(), 0.0]
            turn = engine.getBasePositionAndOrientation(body)[1]
            engine.resetBasePositionAndOrientation(body, at, turn)

    def _surface(self, body: int, ground: Ground) -> None:
        self._engine.changeDynamics(body, -1, lateralFriction=0.9, restitution=0.0)
        if ground.kind == "soft":
            damping = 0.1 * math.sqrt(ground.stiffness_n_m)
            self._engine.changeDynamics(
                body, -1, contactStiffness=ground.stiffness_n_m, contactDamping=damping
            )

    def _read_joints(self) -> None:
        states = self._engine.getJointStates(self._robot, self._joints)
        self.angles = np.array([state[0] for state in states])
        self.speeds = np.array([state[1] for state in states])

    @property
    def pose(self) -> tuple[Array, Array]:
        """Position (3,) m and rotation (3, 3) of the body."""
        place, turn = self._engine.getBasePositionAndOrientation(self._robot)
        rotation = np.array(self._engine.getMatrixFromQuaternion(turn)).reshape(3, 3)
        return np.array(place), rotation

    @property
    def feet_m(self) -> Array:
        """(L, 3) m, tips of the legs in the world."""
        feet = []
        for i, leg in enumerate(self._shape.legs):
            link = (i + 1) * self._shape.joints - 1
            state = self._engine.getLinkState(self._robot, link)
            rotation = np.array(self._engine.getMatrixFromQuaternion(state[5])).reshape(3, 3)
            feet.append(np.array(state[4]) + rotation @ np.array(leg.origins_m[-1]))
        return np.array(feet)

    def advance(self, steps: int) -> Array:
        """Make so many steps; (steps, L) N, the normal force on each leg after each."""
        engine, robot, shape = self._engine, self._robot, self._shape
        forces = np.zeros((steps, len(shape.legs)))
        if len(self._bumps_m):
            self._lay_ahead()
        for step in range(steps):
            torques = self.drives.torques(self.angles, self.speeds)
            engine.setJointMotorControlArray(
                robot, self._joints, bullet.TORQUE_CONTROL, forces=torques.tolist()
            )
            engine.stepSimulation()
            self._read_joints()
            for touch in engine.getContactPoints(bodyA=robot):
                if touch[2] != robot and touch[3] >= 0:
                    forces[step, touch[3] // shape.joints] += touch[9]
        if not np.isfinite(self.angles).all() or np.abs(self.speeds).max() > 300.0:
            raise RuntimeError(f"{shape.name}: the physics diverged; take a smaller step")
        return forces

    def place_plate(self, leg: int, at_m: Array | None) -> None:
        """Put a leg's plate with its top at (3,) m of the leg's frame; None puts it away."""
        x, y, z = self._shape.legs[leg].mount_m
        mount = np.array([x, y, z + _HUNG_M - _PLATE_M[2]])
        where = _PARKED if at_m is None else mount + at_m
        self._engine.resetBasePositionAndOrientation(self._plates[leg], where, (0, 0, 0, 1))

    def load(self, leg: int, mass_kg: float) -> None:
        """Make a leg's last link heavier by so much."""
        link = (leg + 1) * self._shape.joints - 1
        mass = self._shape.legs[leg].masses_kg[-1]
        self._engine.changeDynamics(self._robot, link, mass=mass + mass_kg)

    @property
    def state(self) -> State:
        """The present state, for :meth:`resume`."""
        place, turn = self._engine.getBasePositionAndOrientation(self._robot)
        velocity = self._engine.getBaseVelocity(self._robot)
        return State(
            place, turn, velocity, self.angles.copy(), self.speeds.copy(), self.drives.state()
        )

    def resume(self, state: State) -> None:
        """Go back to a state."""
        self._engine.resetBasePositionAndOrientation(self._robot, state.place, state.turn)
        self._engine.resetBaseVelocity(self._robot, *state.velocity)
        for joint, angle, speed in zip(self._joints, state.angles, state.speeds, strict=True):
            self._engine.resetJointState(self._robot, joint, angle, speed)
        self.drives.resume(state.drives)
        self._read_joints()

    def keep(self) -> tuple[int, Any]:
        """Keep the present state whole, for :meth:`go_on`."""
        return self._engine.saveState(), self.drives.state()

    def go_on(self, kept: tuple[int, Any]) -> None:
        """Go back to a state that was kept whole, and free it."""
        self._engine.restoreState(stateId=kept[0])
        self._engine.removeState(kept[0])
        self.drives.resume(kept[1])
        self._read_joints()

    def let_through(self, leg: int, *, through: bool) -> None:
        """Let a leg pass through the ground and its plate, or not any more."""
        first = leg * self._shape.joints
        for body in self._grounds + self._plates:
            for link in range(first, first + self._shape.joints):
                self._engine.setCollisionFilterPair(self._robot, body, link, -1, int(not through))

    @property
    def touching(self) -> Mask:
        """(L,) whether each leg touches now."""
        now = np.zeros(len(self._shape.legs), dtype=bool)
        for touch in self._engine.getContactPoints(bodyA=self._robot):
            if touch[2] != self._robot and touch[3] >= 0 and touch[9] > 0.0:
                now[touch[3] // self._shape.joints] = True
        return now
