"""The product's learner with other settings, on the same streams: other aims, and ungated.

An aim moves more than a threshold: what is told as a contact is not learned from, so that every aim
is one more play of the streams.  The ungated learner is the design's: recursive least squares over
every tick, contact or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.online import play_streams
from adaptive_contact_studies.paper.plan import Piece, Plan

__all__ = ["AIMS", "aim_name", "at_other_aims", "play_at", "play_ungated"]

# False alarms per robot-hour beside the product's own aim of one: the default's curve.
AIMS: Final = (0.1, 10.0, 100.0)


def aim_name(per_hour: float) -> str:
    """Such as ``aim 0.1``."""
    return f"aim {per_hour:g}"


def at_other_aims(plan: Plan, piece: Piece) -> bool:
    """Whether a piece is one of those played at every aim.

    All collisions, so that the curve is of the same touches as every other; of the free motion
    that of the first robot: three more plays of everything would take longer than all the rest.
    """
    return piece.role == "touch" or piece.leg_run.robot_seed == plan.robots[0]


def play_at(
    per_hour: float, robot: Robot, baselines: Mapping[int, Baseline], streams: Sequence[Stream]
) -> list[Events]:
    """The default detector with another aim.

    Args:
        per_hour: false alarms per robot-hour that its thresholds aim at.
        robot: its description.
        baselines: what the learners start from, by seed of the robot.
        streams: of any length.

    Returns:
        The events of each.
    """
    detector = msgspec.structs.replace(robot.detector, false_alarms_per_hour=per_hour)
    return play_streams(msgspec.structs.replace(robot, detector=detector), baselines, streams)


def play_ungated(
    robot: Robot, baselines: Mapping[int, Baseline], streams: Sequence[Stream]
) -> list[Events]:
    """Learners that take every tick for free motion, one stream after the other.

    Args:
        robot: its description.
        baselines: what the learners start from, by seed of the robot.
        streams: of any length.

    Returns:
        The events of each.
    """
    found = []
    for stream in streams:
        learner = ContactLearner(
            robot,
            stream.leg,
            baselines[stream.piece.leg_run.robot_seed],
            mode=LearnerMode.UNGATED,
        )
        told = [learner.update(sample) for sample in samples_of(stream.run, stream.leg)]
        found.append(Events.of([event for event in told if event is not None]))
    return found
