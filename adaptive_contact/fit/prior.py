r"""Makes the prior of a fit: what is known of any leg, and what a leg's joints have in common.

Motions that leave combinations of terms unexcited are fitted as well by coefficients that no servo
has, and the next motion shows it.  What is known beforehand then takes the place of what the
motions did not show:

1. A command acts through the servo's law, which saturates.  Terms that grow with the command
   without bound are left out: a fit to steps of half a degree predicts ten for a step of seventeen.
2. The joints of a leg have servos of one kind.  The coefficients that fit all joints' own terms at
   once, as a leg of the family (:mod:`~adaptive_contact.model.leg_prior`), are the mean.
3. Each joint's own differ from them as legs of the family differ; other joints' terms, gravity and
   the constant are as the family has them.

How firmly is chosen on stretches held out (:mod:`.held_out`), never on single ticks: neighbours in
time share posture and motion, and any of these fits explains them.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit.sparse_regression import Prior
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_prior import columns_of, leg_prior
from adaptive_contact.model.library import Library
from adaptive_contact.model.training_domain import BEYOND_DEVIATIONS, Domain

__all__ = ["STRENGTHS", "fit_prior", "inflated_domain"]

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

# How firmly a fit holds on: as the family's covariance divided by so much says, at the family's
# noise.  1 is right where errors are noise alone; errors that come from the motion repeat
# themselves from tick to tick, and rows count for less (decision 43).
STRENGTHS: Final = (1.0, 25.0, 400.0)


def fit_prior(factor: Factor, library: Library, quantum_rad: float, strength: float) -> Prior:
    """Make the prior of a leg's coefficients.

    Args:
        factor: the data, for what the joints have in common.
        library: its terms.
        quantum_rad: position step.
        strength: factor on the precision.

    Raises:
        ConfigurationError: the library is another than the family's.
    """
    known = leg_prior(library, quantum_rad)
    spread, mean = known.spread, known.model.coefficients.copy()
    assert spread is not None
    used = np.any(spread != 0.0, axis=1).T
    firm = np.sqrt(strength * np.diagonal(known.noise.covariance[0, 0]))
    rows = np.zeros(spread.shape)
    for joint in range(factor.outputs):
        mine = used[:, joint]
        # Of a covariance SᵀS the precision is that of the rows S⁻ᵀ.
        rows[joint][:, mine] = firm[joint] * np.linalg.inv(spread[joint][:, mine]).T
    unbounded = [
        group.first + j
        for group in library.groups
        if not group.bounded
        for j in range(factor.outputs)
    ]
    used[unbounded] = False
    own = [columns_of(library, joint).own for joint in range(factor.outputs)]
    own = [columns[used[columns, joint]] for joint, columns in enumerate(own)]
    shared = _in_common(factor, own, Prior(mean, rows, used))
    mean[:] = 0.0
    for joint, columns in enumerate(own):
        mean[columns, joint] = shared
    return Prior(mean, rows * used.T[:, None, :], used)


def inflated_domain(factor: Factor, library: Library, prior: Prior, inflation: float) -> Domain:
    """Make the domain of a fit that holds on to a prior.

    Args:
        factor: the data.
        library: its terms.
        prior: of the coefficients.
        inflation: factor on the leverage of the motion, beyond that of the position.
    """
    scale, outputs = factor.scale(), factor.outputs
    whole = Factor.merged([factor], factor.terms, outputs)
    # A domain is of all joints: a joint's terms are as free as they are for itself.
    for joint in range(outputs):
        own = columns_of(library, joint).own
        rows = np.zeros(prior.rows[joint].shape)
        rows[:, own] = prior.rows[joint][:, own]
        whole.add(rows, np.zeros((len(rows), outputs)))
    left_out = np.diag(scale / BEYOND_DEVIATIONS)[~prior.used.any(axis=1)]
    whole.add(left_out, np.zeros((len(left_out), outputs)))
    plain = Domain.of(whole, scale)
    return dataclasses.replace(plain, inflation=np.where(library.moves, inflation, 1.0))


def _in_common(factor: Factor, own: list[Ints], prior: Prior) -> Array:
    """(q,) coefficients that fit all joints' own terms at once.

    Args:
        factor: the data.
        own: of each joint, (q,) columns of its own terms.
        prior: of any leg.
    """
    r, qty = factor.system
    # Of the own terms it is the same for all joints, and counts once.
    known, target = prior.rows[0], prior.rows[0] @ prior.mean[:, 0]
    gram, aim = known[:, own[0]].T @ known[:, own[0]], known[:, own[0]].T @ target
    for joint, columns in enumerate(own):
        rest = prior.used[:, joint].copy()
        rest[columns] = False
        apart = np.concatenate([r[:, rest], prior.rows[joint][:, rest]])
        alike = np.concatenate([r[:, columns], np.zeros((len(apart) - len(r), len(columns)))])
        held = np.linalg.solve(apart.T @ apart, apart.T @ alike)
        # What gravity, the constant and the other joints explain is taken out.
        left = (alike - apart @ held)[: len(r)]
        gram += left.T @ r[:, columns]
        aim += left.T @ qty[:, joint]
    return np.asarray(np.linalg.solve(gram, aim))
