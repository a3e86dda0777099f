"""Predicts where the commands of a swing take a leg that nothing touches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.wire import MAX_ANGLE_RAD

__all__ = ["rollout"]

Array = NDArray[np.float64]


def rollout(model: LegModel, window: Array, commands: Sequence[Sequence[float]]) -> list[Array]:
    """Predict positions several ticks ahead, each prediction taken for the next reading.

    Args:
        model: of the leg free of contact; of a library without preview.
        window: (w,) rad, measured and desired up to the tick before, as a prediction is made from.
        commands: (J,) rad each, from the next tick on.

    Returns:
        (J,) rad, where the leg would be at each of those ticks; fewer where the model, left to
        itself, runs away: one of polynomials does.
    """
    shape = model.library.window
    joints = len(model.library.joints)
    flat = window.copy()
    past = flat.reshape(-1, joints)
    measured, desired = past[: shape.past_measured + 1], past[shape.past_measured + 1 :]
    places: list[Array] = []
    for command in commands:
        now = measured[0] + model.library.evaluate_flat(flat) @ model.coefficients
        if not np.all(np.abs(now) <= MAX_ANGLE_RAD):  # neither does NaN
            break
        places.append(now)
        for rows, newest in ((measured, now), (desired, command)):
            rows[1:] = rows[:-1].copy()
            rows[0] = newest
    return places
