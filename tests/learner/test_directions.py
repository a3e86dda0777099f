"""The directions in which a changed leg's coefficients move, and the terms that may."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.core.learn.lifecycle import ready_for_changes
from adaptive_contact.core.learn.rls import RecursiveLeastSquares
from adaptive_contact.model import Baseline, LegBaseline, Rows, stack
from adaptive_contact.model.change_prior import change_directions, core_support

from .conftest import FakeLeg


@pytest.fixture(scope="module")
def known(baseline: Baseline) -> LegBaseline:
    return ready_for_changes(baseline.legs["rf"])


def heard_in_lifts(known: LegBaseline, moved: Rows, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """What forty ticks of lifts make of a changed leg, in noise units of descents never learned.

    Returns:
        How far the leg is off its model there, and how far once the lifts have been learned.
    """
    noise = np.asarray(known.noise.rms)
    model = known.model
    theta = model.library.evaluate(moved.measured, moved.desired, moved.preview)
    phase = moved.tick % 28
    lifts = np.flatnonzero((moved.tick >= 28) & (phase < 10))[:40]
    descents = (moved.tick >= 28 * 8) & (phase >= 13) & (phase < 18)
    rls = RecursiveLeastSquares(model.coefficients, core_support(model), known.scale, noise)
    rls.inflate(change_directions(model, known.scale, noise))
    for row in lifts:
        rls.learn(np.append(theta[row], moved.increment[row])[None], 0)
    off = moved.increment - theta @ model.coefficients
    left = moved.increment - theta @ rls.coefficients
    return off[descents, joint] / noise[joint], left[descents, joint] / noise[joint]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


@pytest.mark.parametrize("knee", [0.4, 0.8, 2.0])
def test_friction_heard_in_lifts_is_predicted_in_descents(known: LegBaseline, knee: float) -> None:
    """Along four lifts places and constants could explain it as well, and be wrong further on."""
    measured, desired, _, _ = FakeLeg(seed=41).run(30)
    cut = stack(measured, desired, known.model.library.window)
    joint, noise = 2, known.noise.rms
    rollout = known.model.increment(cut.measured, cut.desired, cut.preview)
    held_back = 10.0 * noise[joint] * np.tanh(rollout[:, joint] / (knee * 0.02))
    rubbed = cut.increment.copy()
    rubbed[:, joint] -= held_back
    off, left = heard_in_lifts(known, cut._replace(increment=rubbed), joint)
    assert rms(off) > 4.0
    # Between the knees there is none of its own; what the leg errs anyway is one.
    assert rms(left) < 1.6
