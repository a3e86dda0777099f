r"""Locates a touch: where the foot is, and which way it is pushed.

With the foot's place :math:`p(q)` and its Jacobian :math:`J`, at the deciding sample:

- the foot is at :math:`p(q)`, with :math:`\sigma_k^2 = \sum_j J_{kj}^2 (\Delta^2/12 + s_j^2/2)`, of
  the position step :math:`\Delta` and the residuals' deviation :math:`s`, half of which is of the
  reading that they begin with;
- the push is along :math:`J r`, by which the foot is off its predicted place, of the last two
  ticks.  Of one tick it tells posts from ground nearly as well (AUC 0.99), of two always.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from adaptive_contact.robot import Chain

PUSH_TICKS: Final = 2
_STEP_RAD: Final = 1e-6


class TouchPoint(NamedTuple):
    """Holds a touch in the frame of the leg."""

    foot_m: list[float]  # (3,)
    foot_sd_m: list[float]  # (3,)
    push: list[float] | None  # (3,) unit vector; None where the residual says none
    push_up: float | None  # its vertical share, the square of its third part


def locate(
    chain: Chain, q: Sequence[float], off: Sequence[float], deviation: Sequence[float]
) -> TouchPoint:
    """Locate a touch; plain floats, as an event waits for it.

    Args:
        chain: of the leg.
        q: (J,) rad, the reading.
        off: (J,) rad, measured minus predicted, of the ticks that show it.
        deviation: (J,) rad, of the reading.
    """
    foot = chain.point(q)
    push = [0.0, 0.0, 0.0]
    variance = [0.0, 0.0, 0.0]
    for j in range(len(q)):
        moved = chain.point([a + _STEP_RAD * (i == j) for i, a in enumerate(q)])
        for k in range(3):
            arm = (moved[k] - foot[k]) / _STEP_RAD
            push[k] += arm * off[j]
            variance[k] += (arm * deviation[j]) ** 2
    length = math.hypot(*push)
    known = 0.0 < length < math.inf
    return TouchPoint(
        list(foot),
        [math.sqrt(one) for one in variance],
        [one / length for one in push] if known else None,
        (push[2] / length) ** 2 if known else None,
    )
