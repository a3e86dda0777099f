"""Foot contacts from servo positions alone.

Without Zenoh::

    learner = ContactLearner(load_robot(path), leg="rf", baseline=load_baseline(file))
    event = learner.update(ServoSample(...))

The command ``adaptive-contact serve`` wraps the same learners for a whole robot.
"""

from __future__ import annotations

from adaptive_contact.adapt import ContactLearner, load_baseline
from adaptive_contact.robot import load_robot
from adaptive_contact.wire import ContactEvent, LearnerStatus, ServoSample

__all__ = [
    "ContactEvent",
    "ContactLearner",
    "LearnerStatus",
    "ServoSample",
    "load_baseline",
    "load_robot",
]
__version__ = "0.1.0"
