r"""Computes the likelihood-ratio statistic of a contact.

Free residuals are :math:`r \sim N(0, \Sigma_c)` in context c; a contact that began w ticks ago
adds an unknown mean to the last w of them.  The generalised likelihood ratio of that against no
contact is

for w = 1, 2, 3, so that a hard contact shows in one tick and a soft one adds up.  A contact holds
the leg back: the mean is a share of the predicted motion, against it.  With that direction known,

.. math:: T_w = \frac{\min(z_w^\top u_w, 0)^2}{\|u_w\|^2} , \quad
          z_w = W_{c,w} \sum_{i<w} r[k-i] , \quad u_w = W_{c,w} \sum_{i<w} \Delta\hat q[k-i] ,
          \quad W_{c,w}^\top W_{c,w} = \mathrm{cov}\Big(\sum_{i<w} r[k-i]\Big)^{-1} .

Noise counts in one direction of J only, and on one side.  On robots of two physics engines this
finds more at the same false alarms than :math:`\|z_w\|^2` (decision 51).  How far the last tick is
from free motion in *any* direction is returned beside it: a foot that is still loaded after a
stance is pushed along, not held back.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from adaptive_contact.arrays import Array, Ints, scipy
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
        On free ticks a value is zero half of the time, else chi-square with one degree of freedom.
    """
    z, motion = np.einsum("...ij,...j->...i", whiten, np.stack([residual, increment]).cumsum(-2))
    opposed = np.minimum((z * motion).sum(axis=-1), 0.0)
    way = (motion**2).sum(axis=-1)
    value = np.divide(opposed**2, way, out=np.zeros_like(way), where=way > 0.0)
    within = np.asarray(usable)[..., None] >= np.asarray(WINDOWS)
    return Statistic(np.where(within, value, np.nan), (z**2).sum(axis=-1)[..., 0])


def free_quantile(probability: ArrayLike) -> Array:
    """Compute the values that T of Gaussian free ticks exceeds with such probabilities."""
    return np.asarray(scipy.special.chdtri(1, np.minimum(2.0 * np.asarray(probability), 1.0)))


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
