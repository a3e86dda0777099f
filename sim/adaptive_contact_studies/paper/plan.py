"""What is simulated for what: the seeds, sizes and settings of every experiment.

Training, tuning and reporting never share a seed.  A *leg-run* is one leg of one manufactured
robot: its servos differ from every other's, and it has models of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.obstacles import Approach, ObstacleSettings
from adaptive_contact_sim.pose import PERIOD_S, PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings

# What a stretch is for: learning, choosing settings, false alarms (`free` hung up by the body,
# `stand` as in the paper), collisions.
Role = Literal["train", "tune", "free", "stand", "touch"]

# Soft ground: foam, turf, packed soil under a foot of 8 mm radius (assumed range of the simulator).
STIFFNESS_N_M: Final = (300.0, 1000.0, 3000.0)
# Seeds by role: ranges that cannot meet.
_SEEDS: Final = {
    "train": 1_000_000,
    "tune": 2_000_000,
    "free": 3_000_000,
    "touch": 4_000_000,
    "stand": 5_000_000,
}
# Those of the paper's dataset, below all others.
_PAPER_SEEDS: Final = {"train": 100_000, "tune": 200_000}


@dataclass(frozen=True)
class LegRun:
    """One leg of one robot."""

    robot_seed: int
    leg: str

    @property
    def name(self) -> str:
        """Such as ``0-rf``."""
        return f"{self.robot_seed}-{self.leg}"


@dataclass(frozen=True)
class GantrySettings:
    """A robot hung up by its body, every leg moving."""

    # what each leg does, (6,)
    motions: tuple[PoseSettings, ...] = tuple(PoseSettings(legs=(leg,)) for leg in LEGS)
    # seed, robot_seed: as in `SimulationSettings`
    seed: int = 0
    robot_seed: int = 0
    encoder: EncoderSettings = field(default_factory=EncoderSettings)  # reading noise and faults


class Shot(NamedTuple):
    """One simulation: what it is of, how long it takes, and the legs that are kept."""

    settings: SimulationSettings | GantrySettings
    seconds: float
    legs: tuple[str, ...]


@dataclass(frozen=True)
class Piece:
    """One stretch of simulation of one leg."""

    leg_run: LegRun  # whose
    role: Role  # what it is for
    kind: str  # how the leg moves and what it meets
    seconds: float  # simulated
    settings: SimulationSettings | GantrySettings  # all that decides it

    @property
    def shot(self) -> Shot:
        """The simulation that it is of: six pieces of a robot hung up share one."""
        hung = isinstance(self.settings, GantrySettings)
        return Shot(self.settings, self.seconds, LEGS if hung else (self.leg_run.leg,))


@dataclass(frozen=True)
class Plan:
    """How much of everything."""

    name: Literal["full", "quick"]  # ``full`` or ``quick``
    robots: tuple[int, ...]  # seeds of the robots; each has the `legs`
    legs: tuple[str, ...]
    # train_segments, test_segments: the paper's dataset (4.1), one leg of robot 0
    train_segments: int
    test_segments: int
    # train_s, tune_s: free motion per leg-run by kind, s
    train_s: dict[str, float]
    tune_s: dict[str, float]
    # train_hung_s, tune_hung_s: the same of every robot hung up by its body, s
    train_hung_s: dict[str, float]
    tune_hung_s: dict[str, float]
    free_s: dict[str, float]  # reported free motion by kind, s, of every robot hung up by its body
    stand_s: dict[str, float]  # the same per leg-run, standing on five legs
    touch_s: dict[str, float]  # reported collisions per leg-run by kind, s
    # collisions per leg-run by kind, s, on which baselines choose their settings
    tune_touch_s: dict[str, float]
    seed: int = 0

    @property
    def leg_runs(self) -> tuple[LegRun, ...]:
        """Every leg of every robot."""
        return tuple(LegRun(robot, leg) for robot in self.robots for leg in self.legs)

    def pieces(self, role: Role) -> list[Piece]:
        """All stretches of a role."""
        found = self._hung_up(role)
        if role == "free":
            return found
        for index, leg_run in enumerate(self.leg_runs):
            base = self._base(role) + 1000 * index
            for seed, (kind, seconds) in enumerate(_parts(self._times(role)), base):
                settings = SimulationSettings(
                    motion=_motion(leg_run.leg, kind), seed=seed, robot_seed=leg_run.robot_seed
                )
                found.append(Piece(leg_run, role, kind, seconds, settings))
        return found

    def paper_pieces(self, role: Literal["train", "tune"]) -> list[Piece]:
        """The paper's own dataset (4.1): both subspaces, one leg, the segments asked for.

        In parts, so that every core has one to simulate; each begins with the leg standing.
        """
        segments = self.train_segments if role == "train" else self.test_segments
        leg_run = LegRun(self.robots[0], "rf")
        motion = PoseSettings(legs=(leg_run.leg,), workspace="paper")
        trials = segments // 2
        parts = max(1, round(segments / 500))  # simulated at a time
        found = []
        for part in range(parts):
            own = trials * (part + 1) // parts - trials * part // parts
            settings = SimulationSettings(
                motion=motion,
                seed=_PAPER_SEEDS[role] + 1000 * self.seed + part,
                robot_seed=leg_run.robot_seed,
            )
            # A trial in pose is ascent, descent and hold; before the first, the leg rises.
            ticks = own * 23 + 50
            found.append(Piece(leg_run, role, "paper", ticks * PERIOD_S, settings))
        return found

    def _hung_up(self, role: Role) -> list[Piece]:
        """Free motion of whole robots: six pieces share their settings and one simulation."""
        times = {"free": self.free_s, "train": self.train_hung_s, "tune": self.tune_hung_s}
        found: list[Piece] = []
        for robot in self.robots:
            # Below 900,000 of a role's seeds lie those of its leg-runs.
            base = self._base(role) + 1000 * robot + (0 if role == "free" else 900_000)
            for seed, (kind, seconds) in enumerate(_parts(times.get(role, {})), base):
                motions = tuple(_motion(leg, kind) for leg in LEGS)
                settings = GantrySettings(motions=motions, seed=seed, robot_seed=robot)
                found += [
                    Piece(LegRun(robot, leg), role, kind, seconds, settings) for leg in self.legs
                ]
        return found

    def _base(self, role: Role) -> int:
        return _SEEDS[role] + 10_000_000 * self.seed

    def _times(self, role: Role) -> dict[str, float]:
        if role == "train":
            return self.train_s
        if role == "tune":
            return self.tune_s | self.tune_touch_s
        return self.stand_s if role == "stand" else self.touch_s


def _parts(times: dict[str, float]) -> Iterator[tuple[str, float]]:
    """The pieces that so much of every kind is simulated in: kind and length, s."""
    for kind, seconds in times.items():
        # Pieces of this many simulated seconds: long enough to be worth a process's time, short
        # enough that an interruption loses little.
        parts = max(1, round(seconds / 300.0))
        yield from [(kind, seconds / parts)] * parts


def _motion(leg: str, kind: str) -> PoseSettings:
    """Motion over the whole workspace, by kind.

    Kinds of free motion carry the name of the approach; the others meet something.
    """
    kinds: dict[str, tuple[Approach, ObstacleSettings]] = {
        "descent": ("descent", ObstacleSettings()),
        "slow": ("slow", ObstacleSettings()),
        "forward": ("forward", ObstacleSettings()),
        "hard": ("descent", ObstacleSettings(probability=0.6)),
        "hard slow": ("slow", ObstacleSettings(probability=0.9)),
        "hard forward": ("forward", ObstacleSettings(probability=0.6)),
        "graze": ("graze", ObstacleSettings(probability=0.6)),
    }
    for stiffness in STIFFNESS_N_M:
        soft = ObstacleSettings(probability=0.6, soft=1.0, stiffness_n_m=(stiffness, stiffness))
        kinds[f"soft {stiffness:.0f}"] = ("descent", soft)
    approach, obstacles = kinds[kind]
    return PoseSettings(legs=(leg,), workspace="whole", approach=approach, obstacles=obstacles)


_TOUCH_S: Final = {
    "hard": 100.0,
    "hard forward": 50.0,
    "hard slow": 80.0,
    **{f"soft {stiffness:.0f}": 25.0 for stiffness in STIFFNESS_N_M},
    "graze": 40.0,
}

# 24 leg-runs; four robots x 5,250 s x six legs hold a little more than 5.4 million swing ticks.
FULL: Final = Plan(
    name="full",
    robots=(0, 1, 2, 3),
    legs=LEGS,
    train_segments=5000,
    test_segments=1000,
    train_s={"descent": 160.0, "slow": 60.0, "forward": 40.0},
    tune_s={"descent": 100.0, "slow": 40.0, "forward": 25.0},
    train_hung_s={"descent": 600.0, "slow": 150.0, "forward": 150.0},
    tune_hung_s={"descent": 300.0, "slow": 75.0, "forward": 75.0},
    free_s={"descent": 3700.0, "slow": 800.0, "forward": 800.0},
    stand_s={"descent": 210.0, "slow": 50.0, "forward": 50.0},
    touch_s=_TOUCH_S,
    tune_touch_s={"hard": 40.0, "hard forward": 20.0},
)
QUICK: Final = Plan(
    name="quick",
    robots=(0,),
    legs=("rf", "lm", "rr"),
    train_segments=1500,
    test_segments=400,
    train_s=FULL.train_s,
    tune_s=FULL.tune_s,
    train_hung_s=FULL.train_hung_s,
    tune_hung_s=FULL.tune_hung_s,
    free_s={"descent": 240.0, "slow": 60.0, "forward": 60.0},
    stand_s={"descent": 60.0, "slow": 20.0, "forward": 20.0},
    touch_s={kind: 0.6 * seconds for kind, seconds in _TOUCH_S.items()},
    tune_touch_s={"hard": 40.0, "hard forward": 20.0},
)
