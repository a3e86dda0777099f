"""What is simulated for what: the seeds, sizes and settings of every experiment.

Training, tuning and reporting never share a seed.  A *leg-run* is one leg of one manufactured
robot: its servos differ from every other's, and it has models of its own.  But for the paper's own
dataset, the legs of a tripod move together while the robot stands on the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from adaptive_contact_sim.obstacles import Approach, ObstacleSettings
from adaptive_contact_sim.pose import PERIOD_S, PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_studies.training import PlannedRun

# What a run is for: learning, choosing settings, false alarms, collisions.
Role = Literal["train", "tune", "free", "touch"]

# Soft ground: foam, turf, packed soil under a foot of 8 mm radius (assumed range of the simulator).
STIFFNESS_N_M: Final = (300.0, 1000.0, 3000.0)
# Seeds by role: ranges that cannot meet.
_SEEDS: Final = {"train": 1_000_000, "tune": 2_000_000, "free": 3_000_000, "touch": 4_000_000}
# Those of the paper's dataset, below all others.
_PAPER_SEEDS: Final = {"train": 100_000, "tune": 200_000}
PAPER_LEG: Final = "rf"


@dataclass(frozen=True)
class Plan:
    """How much of everything."""

    name: Literal["full", "quick"]  # ``full`` or ``quick``
    robots: tuple[int, ...]  # seeds of the robots
    tripods: tuple[tuple[str, ...], ...]  # legs that move together, of each robot
    # train_segments, test_segments: the paper's dataset (4.1), one leg of robot 0
    train_segments: int
    test_segments: int
    # of each tripod by kind, s: free motion to learn from, to tune with, and to report
    train_s: dict[str, float]
    tune_s: dict[str, float]
    free_s: dict[str, float]
    touch_s: dict[str, float]  # likewise, reported collisions
    # likewise, collisions on which baselines choose their settings
    tune_touch_s: dict[str, float]
    seed: int = 0

    @property
    def leg_runs(self) -> int:
        """How many: every leg of every robot."""
        return len(self.robots) * sum(map(len, self.tripods))

    def runs(self, role: Role) -> list[PlannedRun]:
        """All runs of a role, by the kind of motion."""
        times = {
            "train": self.train_s,
            "tune": self.tune_s | self.tune_touch_s,
            "free": self.free_s,
            "touch": self.touch_s,
        }[role]
        groups = [(robot, tripod) for robot in self.robots for tripod in self.tripods]
        found = []
        for index, (robot, tripod) in enumerate(groups):
            base = _SEEDS[role] + 10_000_000 * self.seed + 1000 * index
            for seed, (kind, seconds) in enumerate(_parts(times), base):
                poses = tuple(_motion(leg, kind) for leg in tripod)
                settings = SimulationSettings(PoseGroupSettings(poses), seed, robot)
                found.append(PlannedRun(kind, settings, seconds))
        return found

    def paper_runs(self, role: Literal["train", "tune"]) -> list[PlannedRun]:
        """The paper's own dataset (4.1): both subspaces, one leg, the segments asked for.

        In parts, so that every core has one to simulate; each begins with the leg standing.
        """
        segments = self.train_segments if role == "train" else self.test_segments
        motion = PoseSettings(legs=(PAPER_LEG,))
        trials = segments // 2
        parts = max(1, round(segments / 500))  # simulated at a time
        first = _PAPER_SEEDS[role] + 1000 * self.seed
        found = []
        for part in range(parts):
            own = trials * (part + 1) // parts - trials * part // parts
            # A trial in pose is ascent, descent and hold; before the first, the leg rises.
            seconds = (own * 23 + 50) * PERIOD_S
            settings = SimulationSettings(motion, first + part, self.robots[0])
            found.append(PlannedRun("paper", settings, seconds))
        return found


def _parts(times: dict[str, float]) -> Iterator[tuple[str, float]]:
    """The runs that so much of every kind is simulated in: kind and length, s."""
    for kind, seconds in times.items():
        # Runs of this many simulated seconds: long enough to be worth a process's time, short
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

# 24 leg-runs; eight tripods x 5,500 s x three legs hold a little more than 5.4 million swing ticks.
FULL: Final = Plan(
    name="full",
    robots=(0, 1, 2, 3),
    tripods=TRIPODS,
    train_segments=5000,
    test_segments=1000,
    train_s={"descent": 760.0, "slow": 210.0, "forward": 190.0},
    tune_s={"descent": 400.0, "slow": 115.0, "forward": 100.0},
    free_s={"descent": 3800.0, "slow": 850.0, "forward": 850.0},
    touch_s=_TOUCH_S,
    tune_touch_s={"hard": 40.0, "hard forward": 20.0},
)
QUICK: Final = Plan(
    name="quick",
    robots=(0,),
    tripods=TRIPODS[1:],
    train_segments=1500,
    test_segments=400,
    train_s=FULL.train_s,
    tune_s=FULL.tune_s,
    free_s={"descent": 300.0, "slow": 80.0, "forward": 80.0},
    touch_s={kind: 0.6 * seconds for kind, seconds in _TOUCH_S.items()},
    tune_touch_s=FULL.tune_touch_s,
)
