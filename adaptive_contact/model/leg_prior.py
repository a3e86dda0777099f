r"""Makes the prior of a leg's model: what is known of any leg.

Legs are alike in units of their own.  With increments, positions and command steps over the
servo's slope s, the coefficients of a joint's own terms form a family: a Gaussian whose mean
depends on the control tick and the slope,

.. math:: \xi_{own} \sim N(M z,\; C), \quad
          z = (1,\; \ln\tfrac{T}{T_0},\; \ln^2\tfrac{T}{T_0},\; \ln\tfrac{s}{s_0},\;
               \ln\tfrac{T}{T_0}\ln\tfrac{s}{s_0}).

Gravity, the constant and the other joints' terms have mean zero and a deviation each.  The prior is
per joint, so it holds for a leg of any number of them.  It ships as data, made by
``make prior`` from simulated legs of random robots (decision 46); no robot that ships is one of
them.
"""

from __future__ import annotations

import functools
import math
from importlib import resources
from typing import Final, NamedTuple

import msgspec
import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model.glr import free_quantile
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library
from adaptive_contact.model.model_file import LegBaseline
from adaptive_contact.model.noise import CONTEXTS, WINDOWS, NoiseModel
from adaptive_contact.model.tail import Tail

# Terms of other joints that a joint may depend on: how they move and push, by inertia.
OTHERS: Final = (
    "v_{}", "v_{}[k-1]", "v_{}[k-2]", "sat(e_{}/s)", "sat(e_{}[k-1]/s)", "sat(e⁻_{}/s)",
)  # fmt: skip
# Shape of a tail fitted to few ticks is worthless; the pooled one of the shipped baselines is 0 to
# 0.1, and the heavier end costs a third more threshold.
PRIOR_SHAPE: Final = 0.1
# Where the covariates are 0.
_PERIOD_S, _SLOPE_RAD = 0.02, 0.17


class FamilyFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Holds the family as it ships; in units of the slope."""

    origin: str  # one line on how it was made
    forms: tuple[str, ...]  # (q,) of a joint's own terms
    mean: list[list[float]]  # (q, 5) M
    covariance: list[list[float]]  # (q, q) C
    # constant, gravity: deviations
    constant: float
    gravity: float
    # deviations of `OTHERS`, of a neighbour in the chain and of joints beyond
    others: tuple[tuple[float, ...], tuple[float, ...]]
    scale: tuple[float, ...]  # (q,) typical size of the own terms
    # noise_quanta, noise_slopes: deviation of a residual is the root of the sum of squares of these
    # shares of the position step and of the slope
    noise_quanta: float
    noise_slopes: float
    sums: tuple[float, float, float]  # variance of sums of 1, 2 and 3 residuals over that of one


class OwnColumns(NamedTuple):
    """Holds the columns of a library that one joint's prior covers, each with its unit."""

    own: Ints  # (q,) the joint's own, and ``own_unit``
    own_unit: Array
    common: Ints  # (g,) the constant and gravity's
    # (r,) other joints', ``other_unit``, and ``kind``, the place in the file's deviations laid end
    # to end
    others: Ints
    other_unit: Array
    kind: Ints


@functools.cache
def family() -> FamilyFile:
    """Load the family that ships."""
    file = resources.files("adaptive_contact_models").joinpath("family.json")
    return msgspec.json.decode(file.read_bytes(), type=FamilyFile)


def in_family(library: Library) -> bool:
    """Return whether a library's terms are those that the family is known in."""
    return tuple(group.form for group in library.groups) == family().forms


def covariates(period_s: float, slope_rad: float) -> Array:
    """Compute (5,) z, on which the mean depends."""
    tick, slope = math.log(period_s / _PERIOD_S), math.log(slope_rad / _SLOPE_RAD)
    return np.array([1.0, tick, tick**2, slope, tick * slope])


def columns_of(library: Library, joint: int) -> OwnColumns:
    """Find the columns of one joint.

    Raises:
        ConfigurationError: the library is not the servos'.
    """
    if not library.groups:
        raise ConfigurationError(f"no family of legs is known in terms of '{library.name}'")
    slope, names = library.slope_rad, library.names

    def unit(form: str) -> float:
        # Terms that are angles: over the slope they have no unit.
        return slope if form.startswith(("θ", "v_", "Δu")) else 1.0

    first = {group.form: group.first for group in library.groups}
    common = [0, *(i for i, name in enumerate(names) if name.startswith(("cos φ", "sin φ")))]
    others, units, kinds = [], [], []
    for other in range(len(library.joints)):
        if other == joint:
            continue
        far = len(OTHERS) * (abs(other - joint) > 1)
        for place, form in enumerate(OTHERS):
            others.append(first[form] + other)
            units.append(unit(form))
            kinds.append(place + far)
    return OwnColumns(
        np.array([group.first + joint for group in library.groups]),
        np.array([unit(group.form) for group in library.groups]),
        np.array(common), np.array(others, dtype=np.int64), np.array(units),
        np.array(kinds, dtype=np.int64),
    )  # fmt: skip


@functools.lru_cache(64)  # refits of all legs try the same slopes
def leg_prior(library: Library, quantum_rad: float, widening: float = 1.0) -> LegBaseline:
    """Make the prior of a leg, as a baseline with the spread of its coefficients.

    Args:
        library: of the servos, with the usual window.
        quantum_rad: position step.
        widening: factor on all deviations, for a leg that the family does not fit.

    Returns:
        A baseline of no rows, with :attr:`~LegBaseline.spread`.

    Raises:
        ConfigurationError: the library is another than the family's.
    """
    of = family()
    if not in_family(library):
        raise ConfigurationError("the family of legs is known for the usual library only")
    joints, slope, p = len(library.joints), library.slope_rad, library.size
    mean = np.array(of.mean) @ covariates(library.period_s, slope)
    root = np.linalg.cholesky(np.array(of.covariance))
    apart = np.concatenate(of.others)
    coefficients, scale = np.zeros((p, joints)), np.ones(p)
    spread = []
    for joint in range(joints):
        at = columns_of(library, joint)
        coefficients[at.own, joint] = mean * slope / at.own_unit
        scale[at.own] = np.array(of.scale) * at.own_unit
        own = np.zeros((len(root), p))
        own[:, at.own] = (root * slope / at.own_unit[:, None]).T
        rest = np.concatenate([at.common, at.others])
        deviation = np.full(len(rest), of.gravity)
        deviation[0] = of.constant
        deviation[len(at.common) :] = apart[at.kind] / at.other_unit
        single = np.zeros((len(rest), p))
        single[np.arange(len(rest)), rest] = deviation * slope
        spread.append(widening * np.concatenate([own, single]))
    # Residuals of legs alike in step and slope differ by a third; as no level below this noise is
    # followed, a quiet leg is judged as one that is a little noisy.
    sigma = 1.28 * math.hypot(of.noise_quanta * quantum_rad, of.noise_slopes * slope)
    noise = prior_noise(np.full(joints, sigma))
    return LegBaseline(LegModel(library, coefficients), noise, scale, 0, spread=np.array(spread))


def prior_noise(sigma: Array) -> NoiseModel:
    """Make the noise of a leg whose residuals have deviations of (J,) rad, whatever it does."""
    covariance = np.zeros((CONTEXTS, len(WINDOWS), len(sigma), len(sigma)))
    covariance[:] = np.multiply.outer(np.array(family().sums), np.diag(sigma**2))
    return NoiseModel(covariance, np.ones(CONTEXTS))


def prior_tails() -> tuple[Tail, ...]:
    """Compute tails of the statistic for a leg without free ticks of its own.

    That of Gaussian residuals, whose tail beyond 1 % is taken a little heavier, as real ones are.
    """
    rate = 0.01
    level = float(free_quantile(rate))
    # Mean excess over its level.
    beyond = free_quantile(rate * (np.arange(200) + 0.5) / 200)
    scale = float(np.mean(beyond) - level)
    return tuple(Tail(level, rate, scale, PRIOR_SHAPE, 0) for _ in WINDOWS)
