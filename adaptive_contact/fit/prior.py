r"""Makes the prior of a fit: what is known of any leg, and what a leg's joints have in common.

Few swings leave combinations of terms undetermined, and a fit to them is then the posterior of the
family of legs (:mod:`~adaptive_contact.model.leg_prior`), at strength 1.

Motions that leave combinations of terms unexcited are fitted as well by coefficients that no servo
has, and the next motion shows it, however many ticks there are.  Then a fit holds on more firmly:

- A command acts through the servo's law, which saturates.  Terms that grow with the command without
  bound are left out: a fit to steps of half a degree predicts ten for a step of seventeen.
- The joints of a leg have servos of one kind.  The mean is the coefficients that fit all joints'
  own terms at once, as a leg of the family.
- Each joint's own differ from them as legs of the family differ; other joints' terms, gravity and
  the constant are as the family has them.

How firmly is chosen on stretches held out (:mod:`.held_out`), never on single ticks: neighbours in
time share posture and motion, and any of these fits explains them.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np

from adaptive_contact.fit.sparse_regression import Prior
from adaptive_contact.model.factor import Factor
from adaptive_contact.model.leg_prior import columns_of, leg_prior
from adaptive_contact.model.library import Library
from adaptive_contact.model.training_domain import BEYOND_DEVIATIONS, Domain

# How firmly a fit holds on: as the family's covariance divided by so much says, at the family's
# noise.  1 is right where errors are noise alone; errors that come from the motion repeat
# themselves from tick to tick, and rows count for less (decision 43).
STRENGTHS: Final = (1.0, 25.0, 400.0, 3600.0)


def fit_prior(factor: Factor, library: Library, quantum_rad: float, strength: float) -> Prior:
    """Make the prior of a leg's coefficients.

    Args:
        factor: the data, for what the joints have in common.
        library: its terms.
        quantum_rad: position step.
        strength: factor on the precision; 1 for the family as it is.

    Raises:
        ConfigurationError: the library is another than the family's.
    """
    known = leg_prior(library, quantum_rad)
    spread, joints = known.spread, factor.outputs
    assert spread is not None
    used = np.any(spread != 0.0, axis=1).T
    firm = np.sqrt(strength * np.diagonal(known.noise.covariance[0, 0]))
    rows = np.zeros(spread.shape)
    for joint in range(joints):
        mine = used[:, joint]
        # Of a covariance SᵀS the precision is that of the rows S⁻ᵀ.
        rows[joint][:, mine] = firm[joint] * np.linalg.inv(spread[joint][:, mine]).T
    prior = Prior(known.model.coefficients, rows, used)
    return prior if strength == 1.0 else _pool_alike_joints(factor, library, prior)


def posterior_domain(factor: Factor, library: Library, prior: Prior, inflation: float) -> Domain:
    """Make the domain of a fit that holds on to a prior.

    Args:
        factor: the data.
        library: its terms.
        prior: of the coefficients.
        inflation: factor on the leverage of the motion, beyond that of the position.
    """
    scale, outputs = factor.scale(), factor.outputs
    whole = Factor.merged([factor], factor.terms, outputs)
    # A domain is of all joints: a joint's terms are as free as they are for itself, gravity's as
    # for any.  The constant, by which a domain counts its rows, is known from these.
    gravity = columns_of(library, 0).common[1:]
    for joint in range(outputs):
        of_leg = [*columns_of(library, joint).own, *(gravity if joint == 0 else ())]
        rows = np.zeros(prior.rows[joint].shape)
        rows[:, of_leg] = prior.rows[joint][:, of_leg]
        whole.add(rows, np.zeros((len(rows), outputs)))
    left_out = np.diag(scale / BEYOND_DEVIATIONS)[~prior.used.any(axis=1)]
    whole.add(left_out, np.zeros((len(left_out), outputs)))
    plain = Domain.from_factor(whole, scale)
    if inflation == 1.0:
        return plain
    return dataclasses.replace(plain, inflation=np.where(library.moves, inflation, 1.0))


def _pool_alike_joints(factor: Factor, library: Library, prior: Prior) -> Prior:
    """Return the prior of bounded terms, about what the joints have in common."""
    joints = factor.outputs
    used = prior.used.copy()
    for group in library.groups:
        used[group.first : group.first + joints] &= group.bounded
    own = [columns_of(library, joint).own for joint in range(joints)]
    own = [columns[used[columns, joint]] for joint, columns in enumerate(own)]
    r, qty = factor.system
    # Of the own terms the prior is the same for all joints, and counts once.
    known = prior.rows[0][:, own[0]]
    gram, aim = known.T @ known, known.T @ (prior.rows[0] @ prior.mean[:, 0])
    for joint, columns in enumerate(own):
        rest = used[:, joint].copy()
        rest[columns] = False
        alike, apart = r[:, columns], r[:, rest]
        held = prior.rows[joint][:, rest]
        # What gravity, the constant and the other joints explain is taken out.
        through = np.linalg.solve(apart.T @ apart + held.T @ held, apart.T @ alike)
        left = alike - apart @ through
        gram += left.T @ alike
        aim += left.T @ qty[:, joint]
    mean = np.zeros(prior.mean.shape)
    for joint, columns in enumerate(own):
        mean[columns, joint] = np.linalg.solve(gram, aim)
    return Prior(mean, prior.rows * used.T[:, None, :], used)
