"""The learners that a scenario compares: which variants, and what each starts from."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Final

from adaptive_contact.errors import BaselineError
from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_studies.scenarios.spec import BaselineChoice, Variant

HEXAPOD: Final = "hexapod"
# The leg diagonally opposite: of the other side, and of the other end.
OPPOSITE: Final = {"lf": "rr", "lm": "rm", "lr": "rf", "rf": "lr", "rm": "lm", "rr": "lf"}


@functools.cache
def reference_baseline(name: str = HEXAPOD) -> Baseline:
    """The baseline that ships for it.

    Raises:
        BaselineError: none ships.
    """
    found = shipped_baseline(simulated_robot(name).description.name)
    if found is None:
        raise BaselineError(
            f"no baseline ships for '{name}'; make one with `adaptive-contact sim baseline "
            f"--robot {name}`"
        )
    return found


def baseline_for(choice: BaselineChoice, leg: str, name: str = HEXAPOD) -> Baseline | None:
    """What a leg's learner starts from."""
    shipped = reference_baseline(name)
    if choice == "none":
        return None
    if choice == "other_leg":
        return replace(shipped, legs={leg: shipped.legs[OPPOSITE[leg]]})
    return shipped


def learner(
    leg: str, choice: BaselineChoice, variant: Variant, name: str = HEXAPOD
) -> ContactLearner:
    """A new learner of a leg of the robot of this name."""
    baseline = baseline_for(choice, leg, name)
    robot = simulated_robot(name).description
    return ContactLearner(robot, leg, baseline, mode=LearnerMode(variant.value))
