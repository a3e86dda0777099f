r"""Makes a prior for a leg whose recording does not determine all terms.

Motions that leave combinations of terms unexcited are fitted as well by coefficients that no servo
has, and the next motion shows it.  What is known of any leg then takes the place of what the
motions did not show:

- A command acts through the servo's law, which saturates.  Terms that grow with the command without
  bound are left out: a fit to steps of half a degree predicts ten for a step of seventeen.
- The joints of a leg have servos of one kind: each joint's own terms are drawn towards the
  coefficients that fit all joints at once, scaled alike.
- A joint moves by its own servo: what others add is drawn towards nothing, ten times as firmly.

How firmly is chosen on stretches held out (:mod:`.train`), never on single ticks: neighbours in
time share posture and motion, and any of these fits explains them.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit.sparse_regression import Prior
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.library import Library
from adaptive_contact.model.training_domain import BEYOND_DEVIATIONS, Domain

__all__ = ["STRENGTHS", "inflated_domain", "shrinkage"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# A joint's own terms are drawn to those of all joints like by so many times the rows there are.
# 0.1 to 10 differ by 2 % on an arm's unseen motions, 0.01 leaves 5 to 8 % (decision 43).
STRENGTHS: Final = (0.01, 0.1, 1.0)
OTHERS: Final = 10.0  # times as firmly: other joints' terms
# Of gravity, the constant, a joint's position, and the coefficients that all joints share.
LEAST: Final = 1e-3


def shrinkage(factor: Factor, library: Library, strength: float) -> Prior:
    """Make the prior of a leg's coefficients from its own data.

    Args:
        factor: the data.
        library: its terms; one with :attr:`~Library.groups`.
        strength: of what joints share, in rows per row there is.

    Returns:
        What the leg's joints have in common, as the prior of each.
    """
    p, joints = factor.terms, factor.outputs
    own = [_columns(library, joint) for joint in range(joints)]
    rows = np.full((p, joints), OTHERS * strength)
    rows[_common(library)] = LEAST
    for joint, (alike, free) in enumerate(own):
        rows[alike, joint] = strength
        rows[free, joint] = LEAST
    for group in library.groups:
        if not group.bounded:
            rows[group.first : group.first + joints] = np.inf
    mean = np.zeros((p, joints))
    shared = _shared(factor, library, own)
    for joint, (alike, _) in enumerate(own):
        mean[alike, joint] = shared
    return Prior(mean, rows * max(factor.rows, 1.0))


def inflated_domain(factor: Factor, library: Library, prior: Prior, inflation: float) -> Domain:
    """Make the domain of a fit that holds on to a prior.

    Args:
        factor: the data.
        library: its terms.
        prior: of the coefficients.
        inflation: factor on the leverage of the motion, beyond that of the position.
    """
    scale = factor.scale()
    rows = prior.rows.min(axis=1)  # a domain is of all joints
    # What is left out is known to be nothing.
    weight = np.where(np.isfinite(rows), np.sqrt(rows), 1.0 / BEYOND_DEVIATIONS)
    whole = Factor.merged([factor], factor.terms, factor.outputs)
    whole.add(np.diag(weight * scale), np.zeros((factor.terms, factor.outputs)))
    plain = Domain.of(whole, scale)
    return dataclasses.replace(plain, inflation=np.where(library.moves, inflation, 1.0))


def _columns(library: Library, joint: int) -> tuple[Ints, Ints]:
    """A joint's own columns: those that are alike in all joints, and the others."""
    bounded = [group for group in library.groups if group.bounded]
    alike = [group.first + joint for group in bounded if group.alike]
    free = [group.first + joint for group in bounded if not group.alike]
    return np.array(alike, dtype=np.int64), np.array(free, dtype=np.int64)


def _common(library: Library) -> Ints:
    """Columns that are no joint's: the constant and gravity."""
    joints = len(library.joints)
    of_joints = {group.first + j for group in library.groups for j in range(joints)}
    return np.array([i for i in range(library.size) if i not in of_joints], dtype=np.int64)


def _shared(factor: Factor, library: Library, own: list[tuple[Ints, Ints]]) -> Array:
    """Coefficients that fit all joints' own terms at once, gravity being each joint's own."""
    r, qty = factor.system
    count = max(factor.rows, 1.0)
    gram, product = r.T @ r / count, r.T @ qty / count
    alike = np.array([columns for columns, _ in own])
    size = np.sqrt(np.maximum(np.diagonal(gram), 0.0))
    scale = np.sqrt(np.square(size[alike]).mean(axis=0))
    scale = np.where(scale > 1e-12, scale, 1.0)
    whole = LEAST * np.diag(np.square(scale))
    target = np.zeros(len(scale))
    for joint, (columns, free) in enumerate(own):
        rest = np.concatenate([_common(library), free])
        held = gram[np.ix_(rest, rest)] + np.diag(LEAST * np.square(size[rest]) + 1e-12)
        # What the constant and gravity explain is taken out.
        through = np.linalg.solve(held, gram[np.ix_(rest, columns)])
        whole += (gram[np.ix_(columns, columns)] - gram[np.ix_(columns, rest)] @ through) / len(own)
        target += (product[columns, joint] - through.T @ product[rest, joint]) / len(own)
    return np.asarray(np.linalg.solve(whole / np.outer(scale, scale), target / scale) / scale)
