"""What a scenario is: recordings, what is done to the stage, phases, and what is expected.

A scenario is data.  It names its recordings (each a pure function of its settings), the learners'
baseline, the moments that matter and the figures it is held to; running, replaying and judging
know nothing of single scenarios.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple, Self, get_args

from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.walk import WalkSettings

# Learners that are compared.
Variant = Literal[
    "frozen",  # the baseline, never updated
    "rls",  # the product without sparse refits
    "full",  # the product
]


ALL_VARIANTS: Final[tuple[Variant, ...]] = get_args(Variant)

# What the learners start from: the shipped baseline, none, or that of the leg diagonally opposite.
BaselineChoice = Literal["shipped", "none", "other_leg"]


# What the full learner is held to; ``docs/adaptation.md`` says how each is measured.
Expect = Literal[
    "recover",  # a step that counts: soon as good as before; one that does not: no harm
    "follow",  # a slow change: nothing is lost on the way
    "unpoisoned",  # contacts only: nothing is lost, none is learned
    "unharmed",  # nothing changed: as good as the frozen learner
    "start",  # nothing, or the wrong thing, known: valid soon, then as with a baseline
    "quiet",  # free of change, for hours: few false alarms
]


class Mark(NamedTuple):
    """A moment from which recovery is counted, s of simulated time."""

    name: str
    at_s: float


class Phase(NamedTuple):
    """A stretch of time with figures of its own: the swings that begin in it."""

    name: str
    from_s: float
    to_s: float


@dataclass(frozen=True)
class Staging:
    """What the simulator's own settings cannot say."""

    # from which second on which share of descents meets an obstacle, in order of time; empty leaves
    # the motion's own share
    contacts: tuple[tuple[float, float], ...] = ()
    level_m: float | None = None  # height in the coxa's frame at which every obstacle stands, m
    # from when to when the foot of the moving leg is held by a spring
    caught_s: tuple[float, float] | None = None
    # the foot is not held then, but trails something that pulls against its motion, N
    trails_n: float | None = None


@dataclass(frozen=True)
class RecordingSpec:
    """Everything that decides a recording."""

    settings: SimulationSettings  # of the simulator
    seconds: float  # simulated
    legs: tuple[str, ...]  # that are kept
    staging: Staging = field(default_factory=Staging)  # what is done besides

    @property
    def walks(self) -> bool:
        """Whether the robot walks; else some of its legs move in pose."""
        return isinstance(self.settings.motion, WalkSettings)

    def with_settings(self, **changes: Any) -> Self:
        """The same with some of the simulator's settings changed; its randomness stays."""
        return replace(self, settings=replace(self.settings, **changes))


@dataclass(frozen=True)
class ReplaySpec:
    """A recording as some learners see it."""

    recording: RecordingSpec  # what is replayed
    baseline: BaselineChoice = "shipped"  # what the learners start from
    variants: tuple[Variant, ...] = ALL_VARIANTS  # replayed side by side


@dataclass(frozen=True)
class Scenario:
    """A scenario; its name and seeds are permanent."""

    name: str  # such as `step-friction4`
    about: str  # one line
    expect: Expect  # what it is held to
    recordings: tuple[RecordingSpec, ...]  # what is replayed
    # stretches with figures of their own, the last one being that after all
    phases: tuple[Phase, ...]
    # names of the phases over which recall lost and false alarms are held to something
    judged: tuple[str, ...]
    marks: tuple[Mark, ...] = ()  # moments from which recovery is counted
    # turns a recording into the one it is compared against
    twin: Callable[[RecordingSpec], RecordingSpec] = lambda recording: recording
    baseline: BaselineChoice = "shipped"  # what the learners start from
    variants: tuple[Variant, ...] = ALL_VARIANTS  # that are replayed
    # swings with and without contact come mixed, so that recovery needs some of each
    mixed: bool = True
    # there is much contact to be learned by mistake; what is, is held to a limit
    poisonous: bool = False

    @property
    def motion(self) -> Literal["pose", "walk"]:
        """How its robot moves."""
        return "walk" if self.recordings[0].walks else "pose"

    @property
    def robot(self) -> str:
        """The name of the robot that it is about."""
        return self.recordings[0].settings.robot

    @property
    def replays(self) -> tuple[ReplaySpec, ...]:
        """One per recording."""
        return tuple(ReplaySpec(r, self.baseline, self.variants) for r in self.recordings)

    @property
    def references(self) -> tuple[ReplaySpec, ...]:
        """What each is compared against: the same recording without what the scenario does."""
        return tuple(
            replace(replay, recording=self.twin(replay.recording), baseline="shipped")
            for replay in self.replays
        )

    @property
    def leg_runs(self) -> int:
        """Legs of all recordings."""
        return sum(len(recording.legs) for recording in self.recordings)

    @property
    def seconds(self) -> float:
        """Simulated in all, what it is compared against not counted."""
        return sum(recording.seconds for recording in self.recordings)

    def phase(self, name: str) -> Phase:
        """The phase of this name."""
        return next(phase for phase in self.phases if phase.name == name)
