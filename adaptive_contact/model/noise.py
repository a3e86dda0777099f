r"""Estimates the covariance of residuals on free ticks, per context of the motion.

Residuals of a good leg model are nearly white, but not equally large everywhere: fast motion
carries model error, slow motion sticks and slips.  Contexts are formed from the command alone
(direction of the foot, commanded speed), which a contact cannot change, and each context has its
own covariance, shrunk towards that of its direction where it saw few ticks.  A direction is lift,
descent, or after the turn to stance, where the command stops or goes another way.

For every window of w = 1, 2, 3 ticks the covariance of the *sum* of residuals is estimated
directly, so that what autocorrelation is left is in it.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.errors import IdentificationError, TooLittleDataError

WINDOWS: Final = (1, 2, 3)
# Edges of the commanded speed, in position quanta per tick (largest joint): below one step per
# tick a leg sticks and slips, above a dozen it moves as fast as such servos can.
SPEED_EDGES_QUANTA: Final = (1.0, 4.0, 12.0)
SPEEDS: Final = len(SPEED_EDGES_QUANTA) + 1
# Directions: of a lift, a descent, and after the turn to stance.
LIFT, DESCENT, AFTER = range(3)
DIRECTIONS: Final = 3
CONTEXTS: Final = DIRECTIONS * SPEEDS
# A context's covariance weighs like this many ticks of its direction's.
SHRINK_TICKS: Final = 200.0
# A leg whose normalised innovation squared is above this, five times the noise, does not move as
# its model says.
UNFIT_LEVEL: Final = 25.0
# Fewer free ticks than this do not make a covariance worth a threshold.
MIN_TICKS: Final = 300


def context(desired: Array, before: Array, direction: Ints, quantum_rad: float) -> Ints:
    """Compute the context of a tick, from its command and the one before.

    Args:
        desired: (..., J) rad.
        before: (..., J) rad, the command of the previous tick.
        direction: (...,) one of ``LIFT``, ``DESCENT`` and ``AFTER``.
        quantum_rad: position step of the servos.

    Returns:
        (...,) index in ``0 .. CONTEXTS - 1``.
    """
    speed = np.abs(desired - before).max(axis=-1) / quantum_rad
    return np.asarray(direction * SPEEDS + np.searchsorted(SPEED_EDGES_QUANTA, speed, side="right"))


def lagged(values: Array, depth: int) -> Array:
    """Stack (n, J) into (n, depth, J), lag 0 first; rows before the start are NaN."""
    out = np.full((len(values), depth, values.shape[1]), np.nan)
    for lag in range(depth):
        out[lag:, lag] = values[: len(values) - lag]
    return out


@dataclasses.dataclass(frozen=True)
class NoiseModel:
    """Holds the covariances of residual sums on free ticks."""

    covariance: Array  # (contexts, windows, J, J) rad²
    ticks: Array  # (contexts,) free ticks behind each
    # (contexts, windows, J, J), inverse Cholesky factors of the covariances
    whiten: Array = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        if not np.isfinite(self.covariance).all():
            raise IdentificationError("noise: a covariance is not finite; fit a new one")
        try:
            factor = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError as error:
            raise IdentificationError(
                "noise: a covariance is not positive definite; fit a new one"
            ) from error
        object.__setattr__(self, "whiten", np.linalg.inv(factor))

    @property
    def rms(self) -> Array:
        """Return the root mean square of single residuals over all contexts, (J,) rad."""
        weight = self.ticks / self.ticks.sum()
        diagonal = np.diagonal(self.covariance[:, 0], axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(weight @ diagonal))


def fit_noise(
    residual: Array, where: Ints, quantum_rad: float, min_ticks: int = MIN_TICKS
) -> NoiseModel:
    """Estimate the covariances from free ticks.

    Args:
        residual: (n, depth, J) rad, lag 0 first, NaN where a lag is missing; depth ≥ 3.
        where: (n,) context of each tick.
        quantum_rad: position step; no variance may fall below that of rounding to it.
        min_ticks: that it takes.

    Returns:
        The noise model.

    Raises:
        TooLittleDataError: too few usable ticks.
    """
    usable = np.isfinite(residual[:, : WINDOWS[-1]]).all(axis=(1, 2))
    residual, where = residual[usable], where[usable]
    if len(residual) < min_ticks:
        raise TooLittleDataError(
            f"noise: {len(residual)} free ticks; expected at least {min_ticks}: record more swings",
            len(residual),
            min_ticks,
        )
    joints = residual.shape[-1]
    floor = np.eye(joints) * quantum_rad**2 / 12.0
    covariance = np.empty((CONTEXTS, len(WINDOWS), joints, joints))
    ticks = np.bincount(where, minlength=CONTEXTS).astype(np.float64)
    for column, width in enumerate(WINDOWS):
        total = residual[:, :width].sum(axis=1)
        whole = total.T @ total / len(total)
        for direction in range(DIRECTIONS):
            inside = where // SPEEDS == direction
            if direction == AFTER and not inside.any():  # as of the descent before
                covariance[-SPEEDS:, column] = covariance[-2 * SPEEDS : -SPEEDS, column]
                continue
            part = total[inside]
            prior = (part.T @ part + SHRINK_TICKS * whole) / (len(part) + SHRINK_TICKS)
            for speed in range(SPEEDS):
                index = direction * SPEEDS + speed
                own = total[where == index]
                estimate = (own.T @ own + SHRINK_TICKS * prior) / (len(own) + SHRINK_TICKS)
                covariance[index, column] = estimate + width * floor * 1e-3
                least = np.diagonal(covariance[index, column]) - np.diagonal(floor) * width
                lift = np.maximum(-least, 0.0)
                covariance[index, column] += np.diag(lift)
    return NoiseModel(covariance, ticks)
