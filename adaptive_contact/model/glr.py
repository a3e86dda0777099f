r"""Computes the likelihood-ratio statistic of a contact.

Free residuals are :math:`r \sim N(0, \Sigma_c)` in context c; a contact that began w ticks ago
adds an unknown mean to the last w of them.  The generalised likelihood ratio of that against no
contact is

.. math:: T_w = \Big\| W_{c,w} \sum_{i<w} r[k-i] \Big\|^2 , \qquad
          W_{c,w}^\top W_{c,w} = \mathrm{cov}\Big(\sum_{i<w} r[k-i]\Big)^{-1} ,

for w = 1, 2, 3, so that a hard contact shows in one tick and a soft one adds up.  A contact holds
the leg back: windows whose whitened sum does not oppose the predicted motion count as zero.  How
far the last tick is from free motion in *any* direction is returned beside it: a foot that is still
loaded after a stance is pushed along, not held back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.model.noise import WINDOWS, NoiseModel


class Statistic(NamedTuple):
    """Holds the statistic of a tick's residuals."""

    # (..., windows) T, zero where it does not oppose the motion, NaN where the window reaches
    # further back than the sound residuals
    value: Array
    distance: Array  # (...,) T of the last tick alone, whatever its direction


def statistic(residual: Array, increment: Array, whiten: Array, usable: Ints) -> Statistic:
    """Compute T for every window.

    Args:
        residual: (..., 3, J) rad, measured minus predicted, lag 0 first.
        increment: (..., 3, J) rad, the movement that was predicted for those ticks.
        whiten: (..., windows, J, J) of each tick's context.
        usable: (...,) how many of the lags belong to this swing and are sound; windows that
            reach further back give NaN.

    Returns:
        Each is chi-square with J degrees of freedom on free ticks.
    """
    square, product = whitened(np.stack([residual, increment]), whiten)
    within = np.asarray(usable)[..., None] >= np.asarray(WINDOWS)
    value = np.where(within, np.where(product < 0.0, square, 0.0), np.nan)
    return Statistic(value, square[..., 0])


def whitened(history: Array, whiten: Array) -> tuple[Array, Array]:
    """Compute the whitened sums of every window: squared length, product with the motion.

    Args:
        history: (2, ..., 3, J) rad, residuals and predicted increments, lag 0 first.
        whiten: (..., windows, J, J).

    Returns:
        (..., windows) twice: the residuals' square, and their product with the increments, which
        is negative where they oppose the motion.
    """
    z = np.matvec(whiten, history.cumsum(axis=-2))
    square, product = np.vecdot(z, z[0])
    return square, product


def stream_statistic(
    residual: Array, increment: Array, where: Ints, usable: Ints, noise: NoiseModel
) -> Array:
    """Compute T for every window of every tick of a stream.

    Args:
        residual: (n, 3, J) rad, lag 0 first.
        increment: (n, 3, J) rad.
        where: (n,) contexts.
        usable: (n,) sound lags.
        noise: covariances on free ticks.

    Returns:
        (n, windows).
    """
    return statistic(residual, increment, noise.whiten[where], usable).value
