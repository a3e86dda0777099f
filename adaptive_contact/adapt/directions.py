r"""Directions in which a leg's coefficients move when the leg itself changes.

A hundred coefficients cannot be found again from two swings, but a leg that has changed has
mostly changed in few ways: its drive is weaker or softer (supply, winding, compliance), it rubs
more (friction), it carries more (mud).  Each way moves a joint's coefficients along a known
direction: the terms of the drive together, the friction shape, the gravity terms.  Loosening the
recursion along these, and little elsewhere, lets two swings say what happened.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.identify import LegModel

__all__ = ["core_support", "drift_directions", "speaks_of"]

Array = NDArray[np.float64]

# Standard deviation of a change of a whole family of terms, as a share of itself.
FAMILY_SHARE: Final = 0.3
# Of the slope of the control law: what goes over to a law half as stiff.
SLOPE_SHARE: Final = 0.5
# Of a single term of a joint's own drive, in noise units.
TERM_UNITS: Final = 1.0
# Of its friction: four times as much moves a prediction by 2 to 4 units, six times by up to 7.
FRICTION_UNITS: Final = 3.0
# Of everything else.
OTHER_UNITS: Final = 0.2
# Of what says where the leg is: along a lift it can look like friction, and then it goes astray at
# the end of descents, which is never learned.
PLACE_UNITS: Final = 0.1


def core_support(model: LegModel) -> NDArray[np.bool_]:
    """The model's support, and the terms a change of the leg may need.

    Returns:
        (p, J) bool: what the recursion may move.
    """
    support = model.support.copy()
    for joint, name in enumerate(model.library.joints):
        for term in _own_terms(name):
            row = _row(model, term)
            if row is not None:
                support[row, joint] = True
        for row, term in enumerate(model.library.names):
            if term == "1" or term.startswith(("cos φ", "sin φ")):
                support[row, joint] = True
    return support


def drift_directions(model: LegModel, scale: Array, noise: Array) -> Array:
    """Likely changes of the coefficients.

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
        families = [
            [i for i, t in enumerate(library.names) if t.startswith(kind) and speaks_of(t, name)]
            for kind in ("sat(", "v_", "Δu_")
        ]
        for family in families:
            move = np.zeros(p)
            move[family] = FAMILY_SHARE * own[family]
            rows.append(move)
        rows.append(FAMILY_SHARE * own)
        rows.append(_softer(model, joint, families[0]))
        support = core_support(model)[:, joint]
        for row in np.flatnonzero(support):
            move = np.zeros(p)
            move[row] = _units(library.names[row], name) * noise[joint] / scale[row]
            rows.append(move)
        every.append(rows)
    most = max(map(len, every))
    out = np.zeros((len(every), most, p))
    for joint, rows in enumerate(every):
        out[joint, : len(rows)] = rows
    return out


def speaks_of(term: str, joint: str) -> bool:
    """Whether a term is of a joint; one whose name begins alike is another."""
    return re.search(rf"_{re.escape(joint)}(?!\w)", term) is not None


def _softer(model: LegModel, joint: int, law: Sequence[int]) -> Array:
    """The control law with a gentler slope: its terms give way to the one of twice the slope."""
    move = np.zeros(model.library.size)
    gentle = _row(model, f"sat(e_{model.library.joints[joint]}/2s)")
    if gentle is not None:
        own = model.coefficients[law, joint]
        move[law] = -SLOPE_SHARE * own
        move[gentle] += SLOPE_SHARE * own.sum()
    return move


def _units(term: str, joint: str) -> float:
    """How far a single term may move, in noise units."""
    if term in (f"tanh(v_{joint}/v₀)", f"v_{joint}"):
        return FRICTION_UNITS
    if term.startswith(("θ_", "cos φ", "sin φ")):
        return PLACE_UNITS
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
    )


def _row(model: LegModel, term: str) -> int | None:
    try:
        return model.library.names.index(term)
    except ValueError:  # the paper's library has no such term
        return None
