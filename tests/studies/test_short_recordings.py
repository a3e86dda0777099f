"""Fits to few swings, beside fits to many of the same leg.

``pytest -s`` prints the errors, on swings that neither has seen.  The legs are drawn as those
of the family were, with seeds of their own.  (A threshold needs more ticks than one such leg has.)
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from adaptive_contact.fit.train import Stretch, gather_rows, learn_leg
from adaptive_contact.model import LegModel, leg_library, stack
from adaptive_contact.service.worth import part
from adaptive_contact_studies.family.legs import LEG, draw_leg, record
from adaptive_contact_studies.training import stretch_of

MANY = 240
UNSEEN = 160  # swings behind them


def first(stretch: Stretch, swings: int) -> Stretch:
    """The first so many swings of a stretch."""
    begins = np.flatnonzero(np.diff(stretch.swing.astype(int), prepend=0) == 1)
    return part(stretch, 0, int(begins[swings]))


def rms(model: LegModel, stretch: Stretch) -> float:
    """Error of a tick's prediction in swings, rad, in the mean over joints."""
    rows = stack(stretch.measured, stretch.desired, model.library.window)
    swing: NDArray[np.bool_] = (stretch.swing & stretch.free & stretch.sound)[rows.tick + 1]
    theta = model.library.evaluate(rows.measured, rows.desired, rows.preview)[swing]
    errors = rows.increment[swing] - theta @ model.coefficients
    return float(np.sqrt(np.square(errors).mean(axis=0)).mean())


@pytest.mark.parametrize("seed", [28102, 28108])
def test_a_fit_to_sixty_swings_errs_little_more_than_one_to_many(seed: int) -> None:
    leg = draw_leg(seed)
    whole = stretch_of(record(leg, "pose", MANY + UNSEEN, seed), LEG, leg.robot.period_s)
    unseen = part(whole, len(first(whole, MANY).measured), len(whole.measured))
    described = leg.robot.legs[0]
    library = leg_library(leg.robot, described)
    errors, strengths = {}, {}
    for swings in (MANY, 60):
        some = first(whole, swings)
        with threadpool_limits(1):
            step = leg.robot.quantum(LEG)
            rows = gather_rows(described, library, [some], step)
            known, figures, _ = learn_leg(described, library, rows, step, None)
        errors[swings] = rms(known.model, unseen)
        strengths[swings] = figures.strength
    for swings, error in errors.items():
        print(f"{seed}: {swings} swings {error / errors[MANY]:.2f} strength {strengths[swings]}")
    assert errors[60] < 1.25 * errors[MANY]
