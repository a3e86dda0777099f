"""The default detector itself, sample by sample, on many streams at once."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

from adaptive_contact.leg_group import LegGroup
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events
from adaptive_contact.wire import ContactEvent, ServoSample
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.paper.data import Stream

__all__ = ["play_streams"]


def play_streams(
    robot: Robot, baselines: Mapping[int, Baseline], streams: Sequence[Stream]
) -> list[Events]:
    """Feed every stream to a learner of its own.

    The same calls as in the service; streams side by side share the evaluation of their
    libraries, which does not change a number (a test compares with one at a time).

    Args:
        robot: its description.
        baselines: what the learners start from, by seed of the robot.
        streams: of any length.

    Returns:
        The events of each.
    """
    learners = [
        ContactLearner(robot, s.leg, baselines[s.piece.leg_run.robot_seed]) for s in streams
    ]
    samples: list[list[ServoSample]] = [samples_of(s.run, s.leg) for s in streams]
    events: list[list[ContactEvent]] = [[] for _ in streams]
    team = LegGroup(learners)
    for tick in itertools.zip_longest(*samples):
        for own, event in zip(events, team.advance(tick), strict=True):
            if event is not None:
                own.append(event)
    return [Events.of(own) for own in events]
