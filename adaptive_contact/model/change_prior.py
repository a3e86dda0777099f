r"""Models how a leg's coefficients move when the leg itself changes.

A hundred coefficients cannot be found again from two swings, but a leg that has changed has
mostly changed in few ways, and each moves a joint's coefficients along a known direction: friction
and softness have terms of their own (:class:`~adaptive_contact.model.ChangeLibrary`), a drive
that is weaker scales the terms of its law, mud moves gravity and the speeds.  The
covariance of the recursion is inflated along these directions, and little elsewhere.  Then one or
two swings identify the change, and the prediction is certain again everywhere, not only where the
leg has been since (decision 21).
"""

from __future__ import annotations

import re
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import friction_terms, soft_term

# Of a single term of a joint's own drive.
TERM_UNITS: Final = 0.3
# Of everything else, what says where the leg is included: along a lift that can look like friction,
# and then it goes astray at the end of descents, which is never learned.
OTHER_UNITS: Final = 0.1


def core_support(model: LegModel) -> Mask:
    """Return the terms that the recursion may move: the support, and what a change may need.

    Returns:
        (p, J) bool: what the recursion may move.
    """
    support = model.support.copy()
    for joint, name in enumerate(model.library.joints):
        own = _own_terms(name)
        for row, term in enumerate(model.library.names):
            if term in own or term.startswith(("cos φ", "sin φ")):
                support[row, joint] = True
    return support


def change_directions(model: LegModel, scale: Array, noise: Array) -> Array:
    """Compute the likely changes of the coefficients, a deviation along each direction.

    Args:
        model: in force.
        scale: (p,) typical size of each regressor.
        noise: (J,) rad.

    Returns:
        (J, d, p) standard deviations along each direction, in raw units.
    """
    library, p = model.library, model.library.size
    every = []
    for joint, name in enumerate(library.joints):
        own = model.coefficients[:, joint]
        rows = []
        for kind in ("sat(", "v_", "Δu_"):
            terms = enumerate(library.names)
            family = [i for i, t in terms if t.startswith(kind) and speaks_of(t, name)]
            move = np.zeros(p)
            # Standard deviation of a change of a whole family of terms, as a share of itself.  A
            # battery that sags from 12 V to 9.4 V takes a fifth off a drive's; a wider prior leaves
            # the end of a descent, where the law saturates, uncertain for ten swings.
            move[family] = 0.1 * own[family]
            rows.append(move)
        support = core_support(model)[:, joint]
        for row in np.flatnonzero(support):
            term = library.names[row]
            move = np.zeros(p)
            soft = term == soft_term(name)
            # Of the softness that the first model predicts: 1 is a servo half as stiff.
            move[row] = 0.5 if soft else _units(term, name) * noise[joint] / scale[row]
            rows.append(move)
        every.append(rows)
    most = max(map(len, every))
    out = np.zeros((len(every), most, p))
    for joint, rows in enumerate(every):
        out[joint, : len(rows)] = rows
    return out


def speaks_of(term: str, joint: str) -> bool:
    """Return whether a term names a joint, whole: ``hip`` is not part of ``hip2``."""
    return re.search(rf"_{re.escape(joint)}(?!\w)", term) is not None


def _units(term: str, joint: str) -> float:
    """Return how far a single term may move, in noise units."""
    if term in friction_terms(joint):
        # Of friction against the movement that the first model predicts, at each knee, in noise
        # units: four times as much moves a prediction by 2 to 4 units, six times by up to 7.
        return 2.0
    if term in (f"tanh(v_{joint}/v₀)", f"v_{joint}"):
        # Of what friction against the last movement and a joint's own speed add to that.
        return 0.5
    return TERM_UNITS if term != "1" and term in _own_terms(joint) else OTHER_UNITS


def _own_terms(joint: str) -> tuple[str, ...]:
    return (
        "1",
        f"e_{joint}/s",
        f"sat(e_{joint}/s)",
        f"sat(e_{joint}/0.5s)",
        f"sat(e_{joint}/2s)",
        f"sat(e⁻_{joint}/s)",
        f"sat((e_{joint}-v_{joint}/2)/s)",
        f"tanh(v_{joint}/v₀)",
        f"v_{joint}",
        f"Δu_{joint}",
        *friction_terms(joint),
        soft_term(joint),
    )
