"""One robot, one controller, one tick at a time.

A control tick reads all positions, asks the controller for goals, writes them, and lets the
physics run until the next.  Nothing here reads a clock or a socket: who wants real time or Zenoh
wraps :meth:`Simulation.tick`.  The same settings give the same trajectory, bit for bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import ContactTruth, Drift, Phase, ServoSample
from adaptive_contact_sim.drift import DriftSchedule, Injection
from adaptive_contact_sim.encoder import Encoder, EncoderSettings, Reading
from adaptive_contact_sim.gait import GaitName
from adaptive_contact_sim.motion import Goal, World
from adaptive_contact_sim.obstacles import ObstacleCourse
from adaptive_contact_sim.plant import Plant
from adaptive_contact_sim.pose import PoseMotion, PoseSettings
from adaptive_contact_sim.pose_group import PoseGroup, PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.scene import build
from adaptive_contact_sim.servo import manufactured
from adaptive_contact_sim.terrain import Terrain, TerrainSettings
from adaptive_contact_sim.truth import Change, TruthTracker
from adaptive_contact_sim.walk import WalkMotion, WalkSettings

MotionSettings: TypeAlias = PoseSettings | PoseGroupSettings | WalkSettings

# Streams of randomness of one run.  Their order is part of what a seed means: only append.
_STREAMS: Final = ("encoder", "motion", "obstacles", "drift")


@dataclass(frozen=True)
class SimulationSettings:
    """Everything that decides a run."""

    # pose, of one leg or a group, or walk; and how
    motion: MotionSettings = field(default_factory=PoseSettings)
    seed: int = 0  # of the run: motion, obstacles, noise, faults
    robot_seed: int = 0  # which robot of its kind, see `manufactured`
    # ground of a walk; a pose stands on flat ground
    terrain: TerrainSettings = field(default_factory=lambda: TerrainSettings(kind="flat"))
    encoder: EncoderSettings = field(default_factory=EncoderSettings)  # reading noise and faults
    drift: tuple[Injection, ...] = ()  # what changes during the run
    epoch_ns: int = 0  # time stamp of tick 0
    run: int | None = None  # the `run` of the samples
    period_s: float = 0.02  # control tick
    robot: str = "hexapod"  # which of `ROBOTS`; `from_robot` has its defaults

    def __post_init__(self) -> None:
        robot = simulated_robot(self.robot)
        legs = robot.layout.legs
        moves = () if isinstance(self.motion, WalkSettings) else self.motion.legs
        if any(leg not in legs for leg in moves):
            raise ConfigurationError(
                f"legs to move are {list(moves)}; expected some of {', '.join(legs)}"
            )
        if isinstance(self.motion, PoseSettings):
            found, own = self.motion.workspace, robot.pose and robot.pose.workspace
            if own is None or (found == "hung") != (own == "hung"):
                raise ConfigurationError(
                    f"robot '{self.robot}' does not move in workspace '{found}'; expected "
                    f"{own or 'a walk'}"
                )

    @classmethod
    def from_robot(
        cls, robot: str, mode: Literal["walk", "pose"], gait: GaitName | None = None
    ) -> SimulationSettings:
        """Return the settings of a robot by default, in its usual gait or the one given.

        Raises:
            ConfigurationError: there is no such robot, or it does not walk, or has no pose.
        """
        known = simulated_robot(robot)
        motion = known.walking(gait) if mode == "walk" else known.pose
        if motion is None:
            other = "pose" if mode == "walk" else "walk"
            raise ConfigurationError(
                f"robot '{robot}' ({known.about}) has no {mode}; expected `sim {other}`"
            )
        ground = TerrainSettings(relief_m=known.relief_m)
        period_s = known.description.period_s
        return cls(motion=motion, terrain=ground, period_s=period_s, robot=robot)


class Truth(NamedTuple):
    """A change of a leg's contact."""

    leg: str
    message: ContactTruth


class Tick(NamedTuple):
    """What one control tick gave: a sample per leg, and changes of contact since the last."""

    samples: dict[str, ServoSample]
    truth: list[Truth]


class Simulation:
    """A running simulation.

    Args:
        settings: what is simulated.
        looks: with all that is only there to be seen; it comes to the same, bit for bit.

    Raises:
        ConfigurationError: the settings do not fit together.
    """

    def __init__(self, settings: SimulationSettings, *, looks: bool = False) -> None:
        self.settings = settings
        self.robot = simulated_robot(settings.robot)
        self.layout = self.robot.layout
        self.geometry = self.robot.geometry()
        seeds = np.random.SeedSequence(settings.seed).spawn(len(_STREAMS))
        rng = {name: np.random.default_rng(s) for name, s in zip(_STREAMS, seeds, strict=True)}

        motion, ground = settings.motion, settings.terrain
        if not isinstance(motion, WalkSettings):
            ground = TerrainSettings(kind="flat")
        if ground.seed is None:
            ground = replace(ground, seed=settings.seed)
        self.terrain = Terrain(ground)
        owners: tuple[str | None, ...] = ()
        if isinstance(motion, PoseGroupSettings):
            owners = motion.legs
        elif isinstance(motion, PoseSettings):
            owners = (None,)
        self.plant = Plant(
            build(
                self.terrain,
                obstacles=owners,
                looks=looks,
                name=settings.robot,
                layout=self.layout,
            ),
            manufactured(
                settings.robot_seed, self.robot.servo.make_parameters(self.layout.n_servos)
            ),
            period_s=settings.period_s,
            layout=self.layout,
            kind=self.robot.servo,
        )
        self.courses: tuple[ObstacleCourse, ...] = ()
        self.motion: PoseMotion | PoseGroup | WalkMotion
        if isinstance(motion, PoseSettings):
            self.courses = (ObstacleCourse(motion.obstacles, self.plant, rng["obstacles"]),)
            self.motion = PoseMotion(
                motion, self.geometry, self.courses[0], rng["motion"], self.layout.legs
            )
        elif isinstance(motion, PoseGroupSettings):
            poses = motion.poses
            draws = rng["obstacles"].spawn(len(poses))
            self.courses = tuple(
                ObstacleCourse(pose.obstacles, self.plant, draw, pose.legs[0])
                for pose, draw in zip(poses, draws, strict=True)
            )
            draws = rng["motion"].spawn(len(poses))
            self.motion = PoseGroup(
                [
                    PoseMotion(pose, self.geometry, course, draw)
                    for pose, course, draw in zip(poses, self.courses, draws, strict=True)
                ]
            )
        else:
            self.motion = WalkMotion(
                motion,
                self.geometry,
                rng["motion"],
                field_m=self.terrain.settings.size_m,
                period_s=settings.period_s,
            )
        servos = self.layout.n_servos
        self.encoder = Encoder(
            settings.encoder, rng["encoder"], servos, self.robot.servo.quantum_rad
        )
        self.drift = DriftSchedule(
            settings.drift, dropout=settings.encoder.dropped, layout=self.layout
        )
        legs = self._legs = len(self.layout.legs)
        self.truth = TruthTracker(self.plant.step_s, self.plant.substeps, legs)
        self.ticks = 0
        self._reported: list[int | None] = [None] * legs
        self._tick_ns = round(settings.period_s * 1e9)
        self._step_ns = round(self.plant.step_s * 1e9)
        self._opening = self._settle()
        # What the last tick read and wrote, for who wants arrays instead of messages.
        self.reading = Reading(np.zeros(servos), np.ones(servos, dtype=np.bool_))
        self.desired = np.zeros(servos)
        self.phase: tuple[Phase, ...] = tuple("stance" for _ in self.layout.legs)
        self.changes: list[Change] = []

    @property
    def t_ns(self) -> int:
        """Time stamp of the tick to come."""
        return self.settings.epoch_ns + self.ticks * self._tick_ns

    @property
    def time_s(self) -> float:
        """Simulated time since tick 0."""
        return self.ticks * self.settings.period_s

    def inject(self, drift: Drift) -> None:
        """Let a drift begin now.

        Raises:
            ConfigurationError: it is of no known kind, leg or joint, or out of range.
        """
        self.drift.add(Injection(drift, self.time_s))

    def now_holds(self) -> dict[str, dict[str, dict[str, float]]]:
        """Drifts in force at the tick to come, by kind, leg and joint; nominal left out."""
        if self.drift.due(self.time_s):
            self._apply_drift()
        return self.drift.holds()

    def notify_contact(self, leg: str, contact: bool = True) -> None:
        """Report to the gait that a leg touches, as the service says."""
        if leg in self.layout.legs:
            self._reported[self.layout.legs.index(leg)] = self.ticks if contact else None

    def advance(self) -> None:
        """Make one control tick, without composing messages."""
        plant = self.plant
        if self.drift.due(self.time_s):
            self._apply_drift()
        self.reading = self.encoder.read(plant.joint_angles + plant.servos.offset_rad)
        goal = self._goal()
        self.desired = plant.servos.write_goal(goal.joints_rad.reshape(-1))
        self.phase = goal.phase
        plant.advance()
        self.changes = self._opening + self.truth.update(plant.forces, plant.touches, plant.steps)
        self._opening = []
        self.ticks += 1

    def tick(self) -> Tick:
        """Make one control tick.

        Returns:
            The samples read and written at its start, and the changes of contact that became
            certain by its end.

        Raises:
            SimulationDivergedError: the physics blew up.
        """
        t_ns, seq = self.t_ns, self.ticks
        self.advance()
        measured = self.reading.angle_rad.reshape(self._legs, -1).tolist()
        desired = self.desired.reshape(self._legs, -1).tolist()
        valid: list[list[bool]] | None = None
        if not self.reading.valid.all():
            valid = self.reading.valid.reshape(self._legs, -1).tolist()
        samples = {
            leg: ServoSample(
                t_ns=t_ns,
                seq=seq,
                measured=measured[i],
                desired=desired[i],
                phase=self.phase[i],
                valid=None if valid is None else valid[i],
                run=self.settings.run,
            )
            for i, leg in enumerate(self.layout.legs)
        }
        return Tick(samples, [self.truth_of(change) for change in self.changes])

    def run(self, seconds: float) -> Iterator[Tick]:
        """Make the control ticks of some simulated time."""
        for _ in range(round(seconds / self.settings.period_s)):
            yield self.tick()

    def surface_of(self, geom: int) -> Literal["hard", "soft"]:
        """What kind of surface a geom is."""
        name = self.plant.model.geom(geom).name
        for course in self.courses:
            if name in course.names:
                return course.surface
        return self.terrain.surface

    def _goal(self) -> Goal:
        position, rotation = self.plant.body_pose()
        return self.motion.step(
            World(
                tick=self.ticks,
                step=self.plant.steps,
                step_s=self.plant.step_s,
                measured_rad=self.reading.angle_rad.reshape(self._legs, -1),
                position_m=position,
                rotation=rotation,
                feet_m=self.plant.foot_positions(),
                touch_step=tuple(self.truth.recent),
                reported_tick=tuple(self._reported),
            )
        )

    def _settle(self) -> list[Change]:
        """Stand up and come to rest before time zero."""
        joints = self.motion.start_joints.reshape(-1)
        plant, g = self.plant, self.geometry
        feet = g.to_body(g.feet(self.motion.start_joints))
        ground = float(self.terrain.height_at(feet[:, 0], feet[:, 1]).max())
        # Above the ground at first, m: a height field is touched nowhere at the start.
        height = ground + self.motion.start_height_m + 0.01
        plant.place(np.array([0.0, 0.0, height]), np.array([1.0, 0.0, 0.0, 0.0]), joints)
        plant.servos.write_goal(joints)
        # Standing still before time zero, so that a run does not start with a fall.
        for _ in range(round(1.0 / self.settings.period_s)):
            plant.advance()
        plant.start_clock()
        return self.truth.start(plant.forces.mean(axis=0), 0)

    def _apply_drift(self) -> None:
        values = self.drift.values(self.time_s)
        plant = self.plant
        for kind, name in _SERVO_CONDITIONS.items():
            plant.set_servos(name, values[kind].reshape(-1))
        plant.set_backlash(values["backlash"].reshape(-1))
        plant.set_payload(values["mass"].max(axis=1))
        self.encoder.dropped[:] = values["dropout"].reshape(-1)

    def truth_of(self, change: Change) -> Truth:
        """A change as it is published."""
        t_ns = self.settings.epoch_ns + change.step * self._step_ns
        message = change.message(t_ns, self.layout.parts, self.surface_of)
        return Truth(self.layout.legs[change.leg], message)


# Drift kinds that are a condition of the servos, and what each is called there.
_SERVO_CONDITIONS: Final = {
    "friction": "friction_factor",
    "viscous": "viscous_factor",
    "compliance": "compliance_factor",
    "winding": "winding_factor",
    "supply": "supply_v",
    "offset": "offset_rad",
}
