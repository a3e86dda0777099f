r"""Learns the family of legs from drawn ones, by expectation maximisation.

A joint's coefficients :math:`\xi` and its rows, compressed to :math:`(R, Q^\top y)`, follow

.. math:: \xi \sim N(\mu(z), P), \quad Q^\top y = R \xi + e, \quad e \sim N(0, \sigma^2 I).

Expectation: the posterior of each joint.  Maximisation: the mean as a regression on the covariates,
the covariance of the own terms, a deviation each for gravity, the constant and the other joints'
terms, and each joint's noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.errors import SimulationDivergedError
from adaptive_contact.files import write_file
from adaptive_contact.fit.recordings import untouched
from adaptive_contact.fit.train import swing_ticks
from adaptive_contact.model.leg_prior import OTHERS, FamilyFile, columns_of, covariates
from adaptive_contact.model.library import leg_library
from adaptive_contact.model.window import stack
from adaptive_contact.robot.gait_phase import LIFT_OFF_TICKS
from adaptive_contact_studies.family.legs import LEG, draw_leg, record
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

_SWINGS: Final = 60


@dataclass(eq=False)
class JointRows:
    """Holds one joint's rows, in units of the slope."""

    # r, q: (p, p) and (p,) of the own, common and other columns
    r: Array
    q: Array
    rest: float  # sum of squares that no coefficient explains
    ticks: int  # rows
    # own, common: how many columns
    own: int
    common: int
    kind: Ints  # (r,) of other joints' columns, see `OwnColumns`
    z: Array  # (5,) covariates
    quantum: float  # over the slope
    size: Array  # (q,) root mean square of the own columns
    # variance of sums of 2 and 3 residuals of plain least squares, over that of one
    sums: tuple[float, float]
    variance: float  # of the noise, as it is known so far


# Legs the family is learned from; trials take seeds from 10,000 on.
def learn_family(work: Work, seeds: Sequence[int] = range(400)) -> FamilyFile:
    """Record the legs and learn the family."""
    found = work.each("recording legs", joints_of, seeds)
    joints = [joint for of_leg in found for joint in of_leg]
    family = maximise(joints)
    legs = sum(map(bool, found))
    return msgspec.structs.replace(
        family,
        origin=f"make prior: {legs} drawn legs, {len(joints)} joints, "
        f"seeds {min(seeds)} to {max(seeds)}, {_SWINGS} swings each",
    )


def maximise(joints: Sequence[JointRows]) -> FamilyFile:
    """Find the family of joints by expectation maximisation, :data:`_ROUNDS` rounds of it.

    Args:
        joints: compressed rows; the variance of each is set to what is found.

    Returns:
        Mean, covariance and deviations in units of the slope, without an origin.
    """
    own = joints[0].own
    mean, covariance = np.zeros((own, len(joints[0].z))), 0.3 * np.eye(own)
    common, others = np.array([0.1, 0.1]), np.full(2 * len(OTHERS), 0.05)  # deviations
    z = np.array([joint.z for joint in joints])
    for _ in range(40):
        at = np.zeros((len(joints), own))
        spread = np.zeros((own, own))
        of_common, of_others = np.zeros((2, 2)), np.zeros((len(others), 2))
        for i, joint in enumerate(joints):
            first, p = np.zeros(len(joint.q)), np.zeros((len(joint.q),) * 2)
            first[:own] = mean @ joint.z
            p[:own, :own] = covariance
            kinds = np.minimum(np.arange(joint.common), 1)
            apart = np.concatenate([common[kinds], others[joint.kind]])
            p[own:, own:] = np.diag(np.square(apart))
            inner = joint.r @ p @ joint.r.T + joint.variance * np.eye(len(first))
            gain = np.linalg.solve(inner, joint.r @ p).T
            best = first + gain @ (joint.q - joint.r @ first)
            left = p - gain @ joint.r @ p
            off = joint.q - joint.r @ best
            unknown = float(np.einsum("ij,jk,ik->", joint.r, left, joint.r))
            variance = (joint.rest + float(off @ off) + unknown) / joint.ticks
            joint.variance = max(variance, joint.quantum**2 / 12.0)
            at[i] = best[:own]
            spread += left[:own, :own]
            square = np.square(best[own:]) + np.diagonal(left)[own:]
            np.add.at(of_common, kinds, np.stack([square[: joint.common], kinds * 0 + 1.0], axis=1))
            rest = square[joint.common :]
            np.add.at(of_others, joint.kind, np.stack([rest, np.ones_like(rest)], axis=1))
        mean = np.linalg.solve(z.T @ z + 1e-3 * np.eye(z.shape[1]), z.T @ at).T
        away = at - z @ mean.T
        # The last term lets the covariance be inverted.
        covariance = (away.T @ away + (spread + spread.T) / 2) / len(joints) + 1e-8 * np.eye(own)
        common = np.sqrt(of_common[:, 0] / of_common[:, 1])
        others = np.sqrt(of_others[:, 0] / np.maximum(of_others[:, 1], 1.0))
    quanta, slopes = _noise(joints)
    typical = np.sqrt(np.mean([np.square(joint.size) for joint in joints], axis=0))
    pairs, triples = np.median([joint.sums for joint in joints], axis=0)
    leg = draw_leg(0)
    forms = tuple(g.form for g in leg_library(leg.robot, leg.robot.leg(LEG)).groups)
    near, far = others[: len(OTHERS)], others[len(OTHERS) :]
    return FamilyFile(
        "", forms, mean.tolist(), covariance.tolist(), float(common[0]), float(common[1]),
        (tuple(near.tolist()), tuple(far.tolist())), tuple(typical.tolist()), quanta, slopes,
        (1.0, float(pairs), float(triples)),
    )  # fmt: skip


def save_family(family: FamilyFile, path: Path) -> None:
    """Write the family as data, six digits each."""
    tree = msgspec.to_builtins(family)
    text = msgspec.json.format(msgspec.json.encode(_rounded(tree)), indent=0).decode()
    write_file(path, text + "\n", advice="give another file to write the family to")


@rests_on(*SIMULATOR, *LEARNER, "adaptive_contact_studies.family.legs")
def joints_of(_: Work, seed: int) -> list[JointRows]:
    """Record one leg and compress its free swing ticks, joint by joint."""
    leg = draw_leg(seed)
    try:
        run = record(leg, "gait" if seed % 2 else "pose", _SWINGS, seed)
    except SimulationDivergedError:  # a leg that no servo holds
        return []
    arrays, robot = run.legs[LEG], leg.robot
    library = leg_library(robot, robot.leg(LEG))
    rows = stack(arrays.measured, arrays.desired, library.window)
    free = untouched(run.t_ns, arrays.changes, round(robot.period_s * 1e9))
    judged = free & (swing_ticks(arrays.swing) > LIFT_OFF_TICKS)
    use = judged[rows.tick] & judged[rows.tick + 1]
    if int(use.sum()) < 400:
        return []
    theta = library.evaluate(rows.measured[use], rows.desired[use], rows.preview[use])
    increment, tick = rows.increment[use] / library.slope_rad, rows.tick[use]
    found = []
    for joint in range(len(library.joints)):
        at = columns_of(library, joint)
        columns = np.concatenate(
            [
                theta[:, at.own] / at.own_unit, theta[:, at.common],
                theta[:, at.others] / at.other_unit,
            ],
            axis=1,
        )  # fmt: skip
        target = increment[:, joint]
        p = columns.shape[1]
        stacked = np.column_stack([columns, target])
        whole = np.asarray(np.linalg.qr(stacked, mode="r"))
        residual = target - columns @ np.linalg.lstsq(columns, target, rcond=1e-6)[0]
        rest = float(whole[p, p] ** 2)
        quantum = robot.quantum_rad / library.slope_rad
        found.append(
            JointRows(
                whole[:p, :p], whole[:p, p], rest, len(target), len(at.own), len(at.common),
                at.kind, covariates(robot.period_s, library.slope_rad), quantum,
                np.sqrt(np.square(columns[:, : len(at.own)]).mean(axis=0)),
                _sums(residual, tick), max(rest / len(target), quantum**2 / 6.0),
            )
        )  # fmt: skip
    return found


def _sums(residual: Array, tick: Ints) -> tuple[float, float]:
    """Variance of sums of two and three residuals in a row, over that of one."""
    one = float(np.square(residual).mean())
    two = np.flatnonzero(np.diff(tick) == 1) + 1
    three = two[np.isin(two - 1, two)]
    pairs = residual[two] + residual[two - 1]
    triples = residual[three] + residual[three - 1] + residual[three - 2]
    return float(np.square(pairs).mean()) / one, float(np.square(triples).mean()) / one


def _noise(joints: Sequence[JointRows]) -> tuple[float, float]:
    """Shares of the position step and of the slope that make up a residual's deviation.

    Fitted to the logarithm, so that a noisy leg counts no more than a quiet one.
    """
    from scipy.optimize import least_squares

    quantum = np.array([joint.quantum for joint in joints])
    sigma = np.sqrt([joint.variance for joint in joints])

    def off(shares: Array) -> Array:
        return np.asarray(np.log(np.hypot(shares[0] * quantum, shares[1]) / sigma))

    quanta, slopes = least_squares(off, (0.7, 1e-3), bounds=(0.0, np.inf)).x
    return float(quanta), float(slopes)


def _rounded(tree: object) -> object:
    if isinstance(tree, dict):
        return {name: _rounded(value) for name, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_rounded(value) for value in tree]
    return float(f"{tree:.6g}") if isinstance(tree, float) else tree
