r"""What ground can do to a foot, told from what it cannot.

Ground pushes a foot up.  With joints that give alike, a force F on the foot moves them by
:math:`J^\top F`; for an upright one that is the gradient g of the foot's height.  With W the
whitening of a tick and r its residual,

.. math:: q = \frac{W g}{|W g|} \cdot W r, \qquad r_\perp = r - g \, \frac{q}{|W g|}

q is how many standard deviations the residual shows of such a push, :math:`r_\perp` what no
upright push accounts for.  A leg whose friction has changed is off in both; one that has just
touched is off in q.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Push", "push_of"]

Array = NDArray[np.float64]


class Push(NamedTuple):
    """What a residual shows of a foot being pushed up.

    Attributes:
        sigma: how far it lies that way, in its own standard deviations; negative for a foot below
            where it was foretold.
        aside: (J,) rad, the movement measured, without that part.
    """

    sigma: float
    aside: Array


def push_of(residual: Array, target: Array, whitening: Array, gradient: Array) -> Push:
    """Split a residual into a push from the ground and the rest.

    Args:
        residual: (J,) rad.
        target: (J,) rad, the movement that was measured.
        whitening: (J, J) of the tick.
        gradient: (J,) m per rad, of the foot's height.

    Returns:
        The push; infinite where no joint lifts the foot, so that nothing can be told.
    """
    along = whitening @ gradient
    length = float(np.sqrt(along @ along))
    if length == 0.0:
        return Push(math.inf, target)
    sigma = float(along @ (whitening @ residual)) / length
    return Push(sigma, target - gradient * (sigma / length))
