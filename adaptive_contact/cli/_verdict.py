"""Judges what was learned: how good every leg's fit is, and whether it is a model at all.

Behind ``fit`` and ``robot learn``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from adaptive_contact.fit.train import Training
from adaptive_contact.model.glr import free_quantile
from adaptive_contact.robot import Robot

if TYPE_CHECKING:
    from adaptive_contact.service.worth import Worth

# A model is good where it errs little more than readings do; half a step of noise and the step's
# own rounding are 0.58 steps, of two readings (the change from one to the next) 0.82.
_NOISE_STEPS: Final = 0.82
_GOOD, _FAIR = 2.5, 4.0


def verdict(
    robot: Robot, training: Training, tried: Mapping[str, Worth] | None = None
) -> list[str]:
    """Describe in words how well every leg was learned, and what to do about it.

    Args:
        robot: its description.
        training: what was learned.
        tried: what came of a trial, by leg.
    """
    tried = tried or {}
    lines = []
    for leg, figures in training.figures.items():
        noise = _NOISE_STEPS * robot.quantum(leg)
        worst = float(np.max(figures.held_out_rms)) / noise
        # Free ticks per term of the library at which held-out error has settled.
        wanted = 12 * figures.library_size
        if figures.rows < wanted:
            more = wanted / max(figures.rows, 1)
            word = f"too little: {figures.rows} of {wanted} free ticks; swing {more:.1f} x as long"
        elif leg in tried and not tried[leg].good:
            word = "errs where it matters; record more and other swings, at every speed"
        elif worst <= _GOOD:
            word = "good"
        elif worst <= _FAIR or leg in tried:
            word = "usable; longer and more varied swings may help"
        else:
            word = "poor; check lengths, signs, servo.slope_rad, and that nothing was touched"
        found = f"; held out: {tried[leg]}" if leg in tried else ""
        lines.append(f"leg {leg}: {word} (errs by {worst:.1f} x the noise of its readings{found})")
    for leg in robot.leg_ids:
        if leg not in training.figures:
            why = training.skipped.get(leg, "it was not swung")
            lines.append(f"leg {leg}: not learned: {why}")
    return lines


def unusable(robot: Robot, training: Training) -> str | None:
    """Say in one line why what was learned is of no use; None where it is usable."""
    # One score in a thousand of free ticks is above the chi-square quantile of so many joints, 16.3
    # of three.  Thresholds are for far rarer ones: 35 and more of good recordings, below 0.2 where
    # readings are copies of commands or a swing never ends.
    least = float(free_quantile(1e-3))
    lowest = float(training.baseline.thresholds(robot.detector.false_alarms_per_hour).min())
    if lowest >= least:
        return None
    return (
        f"thresholds are as low as {lowest:.2g}, expected {least:.1f} and more: residuals do "
        "not vary as those of free swings do; publish positions that were read, and phase = "
        "swing only while the foot is off the ground"
    )
