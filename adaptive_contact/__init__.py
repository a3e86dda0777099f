"""Detects foot contacts from servo positions alone.

Without Zenoh::

    learner = ContactLearner(load_robot(path), leg="rf", baseline=load_baseline(file))
    event = learner.update(ServoSample(...))

The command ``adaptive-contact serve`` wraps the same learners for a whole robot.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.core.leg_learner import ContactLearner
    from adaptive_contact.model.model_file import load_baseline
    from adaptive_contact.robot import load_robot
    from adaptive_contact.wire import ContactEvent, LearnerStatus, ServoSample

__all__ = [
    "ContactEvent",
    "ContactLearner",
    "LearnerBank",
    "LearnerStatus",
    "ServoSample",
    "load_baseline",
    "load_robot",
]
__version__ = "0.1.0"

# Loaded when asked for: the command line begins here, too, and its help needs no linear algebra.
_PLACES: Final = {
    "ContactEvent": "wire",
    "ContactLearner": "core.leg_learner",
    "LearnerBank": "core.bank",
    "LearnerStatus": "wire",
    "ServoSample": "wire",
    "load_baseline": "model",
    "load_robot": "robot",
}


def __getattr__(name: str) -> Any:
    place = _PLACES.get(name)
    if place is None:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{place}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
