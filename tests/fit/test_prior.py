"""Fits that hold on to what is known of any leg, against dense solutions on the raw rows."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from adaptive_contact.fit import FitSettings, fit_sparse
from adaptive_contact.fit.prior import fit_prior
from adaptive_contact.fit.sparse_regression import Prior
from adaptive_contact.fit.train import Stretch, Training, learn
from adaptive_contact.model import Domain, Factor, Library, Window, stack
from adaptive_contact.model.leg_prior import leg_prior
from adaptive_contact.model.model_file import dump_baseline, parse_baseline
from adaptive_contact.model.training_domain import PRIOR_DEVIATIONS
from adaptive_contact.robot import parse_robot

Array = NDArray[np.float64]

QUANTUM = 0.0015
ARM = f"""
[robot]
name = "arm"
period_s = 0.02
quantum_rad = {QUANTUM}
[[leg]]
id = "arm"
joints = ["pan", "lift", "elbow"]
"""
LIBRARY = Library("servo", ("pan", "lift", "elbow"), ("yaw", "pitch", "pitch"))


def factor_of(theta: Array, target: Array) -> Factor:
    factor = Factor(theta.shape[1], target.shape[1])
    factor.add(theta, target)
    return factor


# -- the prior of a fit ------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 9), st.integers(1, 3), st.integers(10, 40))
def test_a_prior_counts_like_its_rows(seed: int, p: int, joints: int, n: int) -> None:
    """Minimises |y − Θβ|² + |W (β − mean)|², the terms that are left out being nothing."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n, p)) * 10.0 ** rng.uniform(-2, 2, p)
    target = rng.normal(size=(n, joints))
    scale = np.sqrt(np.square(theta).mean(axis=0))
    mean = rng.normal(size=(p, joints))
    rows = rng.normal(size=(joints, int(rng.integers(1, 12)), p)) * scale
    used = rng.random((p, joints)) < 0.8
    used[0] = True
    prior = Prior(mean, rows, used)
    fit = fit_sparse(factor_of(theta, target), FitSettings(ridge=0.0, prior=prior))
    for joint in range(joints):
        kept = used[:, joint]
        stacked = np.concatenate([theta, rows[joint]])[:, kept] / scale[kept]
        aim = np.concatenate([target[:, joint], rows[joint] @ mean[:, joint]])
        # In units of the columns: those of the raw rows differ by four orders.
        expected = np.linalg.lstsq(stacked, aim, rcond=None)[0]
        found = fit.coefficients[:, joint]
        assert (found[~kept] == 0.0).all()
        np.testing.assert_allclose(found[kept] * scale[kept], expected, atol=1e-7)


# -- what is known of any leg ------------------------------------------------------------------


def test_groups_name_the_terms_and_tell_which_have_no_bound() -> None:
    """A command ten times as far away moves a bounded term by no more than the law's slope."""
    library = Library("servo", ("a", "b"), ("yaw", "pitch"), window=Window(preview=2))
    seen = np.zeros(library.size, dtype=bool)
    rng = np.random.default_rng(1)
    w = library.window
    measured = rng.normal(scale=0.01, size=(40, w.past_measured + 1, 2))
    far = rng.normal(size=(40, w.past_desired + 1, 2)) * 1e4
    ahead = rng.normal(size=(40, 2, 2)) * 1e4
    near = library.evaluate(measured, far, ahead)
    further = library.evaluate(measured, 10.0 * far, 10.0 * ahead)
    for group in library.groups:
        columns = slice(group.first, group.first + 2)
        assert library.names[columns] == tuple(group.form.replace("{}", j) for j in ("a", "b"))
        assert not seen[columns].any(), "a term of two groups"
        seen[columns] = True
        grown = np.abs(further[:, columns]).max() > 2.0 * np.abs(near[:, columns]).max()
        assert grown == (not group.bounded), group.form
    others = {name for name, known in zip(library.names, seen, strict=True) if not known}
    assert others == {n for n in library.names if n == "1" or n[:3] in ("cos", "sin")}
    assert Library("linear", ("a",), ("pitch",)).groups == ()


def moved(seed: int, n: int = 200) -> tuple[Array, Array]:
    """Rows of a leg that moves at random, and what they should predict."""
    rng = np.random.default_rng(seed)
    motion = np.cumsum(rng.normal(scale=0.05, size=(n, 3)), axis=0)
    cut = stack(motion, motion + rng.normal(scale=0.1, size=(n, 3)), LIBRARY.window)
    theta = LIBRARY.evaluate(cut.measured, cut.desired, cut.preview)
    return theta, rng.normal(scale=0.01, size=(len(theta), 3))


def of_family() -> tuple[Array, Array, float]:
    """Mean (p, J), covariances (J, p, p) and deviation of the noise of any leg."""
    known = leg_prior(LIBRARY, QUANTUM)
    covariance = np.einsum("jqa,jqb->jab", known.spread, known.spread)
    return known.model.coefficients, covariance, float(known.noise.covariance[0, 0, 0, 0]) ** 0.5


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6))
def test_at_strength_one_a_fit_is_the_family_s_posterior(seed: int) -> None:
    """Against the mean of a Gaussian given the rows, by its covariance."""
    theta, target = moved(seed)
    factor = factor_of(theta, target)
    prior = fit_prior(factor, LIBRARY, QUANTUM, 1.0)
    fit = fit_sparse(factor, FitSettings(ridge=0.0, prior=prior))
    mean, covariance, sigma = of_family()
    for joint in range(3):
        of_rows = theta @ covariance[joint] @ theta.T + sigma**2 * np.eye(len(theta))
        gain = np.linalg.solve(of_rows, theta @ covariance[joint]).T
        expected = mean[:, joint] + gain @ (target[:, joint] - theta @ mean[:, joint])
        np.testing.assert_allclose(
            theta @ fit.coefficients[:, joint], theta @ expected, atol=1e-6
        )  # fmt: skip


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([25.0, 400.0]))
def test_what_joints_share_is_one_fit_to_all_of_them(seed: int, strength: float) -> None:
    """Against one dense system: shared coefficients, and gravity and the others' for each joint."""
    theta, target = moved(seed)
    prior = fit_prior(factor_of(theta, target), LIBRARY, QUANTUM, strength)
    mean, covariance, sigma = of_family()
    bounded = [g for g in LIBRARY.groups if g.bounded]
    unbounded = [g.first + j for g in LIBRARY.groups if not g.bounded for j in range(3)]
    assert unbounded
    assert not prior.used[unbounded].any()

    noise = sigma * strength**0.5
    every = [[g.first + j for g in LIBRARY.groups] for j in range(3)]
    mine = np.array([g.bounded for g in LIBRARY.groups])
    own = [[g.first + j for g in bounded] for j in range(3)]
    rest = [
        np.flatnonzero(prior.used[:, j] & ~np.isin(np.arange(LIBRARY.size), own[j]))
        for j in range(3)
    ]
    whole = np.zeros((3 * len(theta), len(bounded) + sum(map(len, rest))))
    firm = np.zeros((whole.shape[1],) * 2)
    # Conditioned on terms without bound that are nothing: the precision's block of the others.
    precision = np.linalg.inv(covariance[0][np.ix_(every[0], every[0])])
    firm[: len(bounded), : len(bounded)] = precision[np.ix_(mine, mine)]
    aim = np.zeros(len(firm))
    aim[: len(bounded)] = (precision @ mean[every[0], 0])[mine]
    at = len(bounded)
    for j in range(3):
        block = slice(j * len(theta), (j + 1) * len(theta))
        columns = slice(at, at + len(rest[j]))
        whole[block, : len(bounded)] = theta[:, own[j]]
        whole[block, columns] = theta[:, rest[j]]
        firm[columns, columns] = np.linalg.inv(covariance[j][np.ix_(rest[j], rest[j])])
        at += len(rest[j])
    left = whole.T @ whole + noise**2 * firm
    right = whole.T @ target.T.ravel() + noise**2 * aim
    shared = np.linalg.solve(left, right)[: len(bounded)]
    for j in range(3):
        scale = np.sqrt(np.square(theta[:, own[j]]).mean(axis=0))
        np.testing.assert_allclose(prior.mean[own[j], j] * scale, shared * scale, atol=1e-6)
        others = np.setdiff1d(np.arange(LIBRARY.size), own[j])
        assert (prior.mean[others, j] == 0.0).all()
        of_rows = prior.rows[j].T @ prior.rows[j]
        np.testing.assert_allclose(
            of_rows[np.ix_(own[j], own[j])], noise**2 * precision[np.ix_(mine, mine)], rtol=1e-6
        )


# -- what a fit does not know ------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(2, 7), st.floats(1.0, 1e4))
def test_doubt_counts_what_a_term_adds_to_those_before_it(
    seed: int, rows: int, terms: int, doubt: float
) -> None:
    """h of the certain terms alone, and ``doubt`` times what all terms add to it."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(rows, terms)) * 10.0 ** rng.uniform(-2, 2, terms)
    new = rng.normal(size=(5, terms)) * np.abs(theta).mean(axis=0)
    doubtful = rng.random(terms) < 0.5
    scale = np.sqrt(np.square(theta).mean(axis=0))

    def dense(columns: NDArray[np.bool_]) -> Array:
        phi, asked = (x[:, columns] / scale[columns] for x in (theta, new))
        information = phi.T @ phi + np.eye(int(columns.sum())) / PRIOR_DEVIATIONS**2
        return np.einsum("ij,ji->i", asked, np.linalg.solve(information, asked.T))

    certain, whole = dense(~doubtful), dense(np.ones(terms, dtype=bool))
    plain = Domain.from_factor(factor_of(theta, np.zeros((rows, 1))), scale)
    domain = Domain(plain.triangle, scale, inflation=np.where(doubtful, doubt, 1.0))
    np.testing.assert_allclose(plain.leverage(new), whole, rtol=1e-6)
    expected = certain + doubt * (whole - certain)
    np.testing.assert_allclose(
        domain.leverage(new), expected, rtol=1e-5, atol=1e-8 * doubt * whole.max()
    )
    assert (domain.leverage(new) >= plain.leverage(new) * (1.0 - 1e-9)).all()


# -- stretches held out ------------------------------------------------------------------------


def arm_motion(rng: np.random.Generator, n: int, kind: int, reach: float = 0.6) -> Stretch:
    """Three saturating servos, late and with friction; each kind moves one joint the most."""
    t = np.arange(n) * 0.02
    size = np.where(np.arange(3) == kind % 3, reach, 0.05)
    desired = size * np.sin(2.0 * np.pi * rng.uniform(0.1, 0.4, 3) * t[:, None])
    return follow(rng, desired)


def follow(rng: np.random.Generator, desired: Array) -> Stretch:
    position = np.zeros_like(desired)
    speed = np.zeros(3)
    for k in range(len(desired) - 1):
        drive = np.clip((desired[k] - position[k]) / 0.164, -1.0, 1.0)
        speed = 0.6 * speed + 0.4 * 0.09 * drive
        position[k + 1] = position[k] + speed
    noise = rng.normal(scale=QUANTUM / 3.0, size=position.shape)
    measured = np.round((position + noise) / QUANTUM) * QUANTUM
    always = np.ones(len(desired), dtype=bool)
    return Stretch(measured, desired, always, always, always)


def trained(stretches: list[Stretch]) -> Training:
    return learn(parse_robot(ARM, source="arm"), {"arm": stretches}, origin="test")


def by_least_squares(stretches: list[Stretch]) -> Training:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("adaptive_contact.fit.train.strength_of", lambda *_: (None, True))
        return trained(stretches)


def unseen_rms(training: Training, stretch: Stretch) -> Array:
    model = training.baseline.legs["arm"].model
    cut = stack(stretch.measured, stretch.desired, model.library.window)
    theta = model.library.evaluate(cut.measured, cut.desired, cut.preview)
    return np.sqrt(np.square(cut.increment - theta @ model.coefficients).mean(axis=0))


def slow_motions(rng: np.random.Generator) -> list[Stretch]:
    return [arm_motion(rng, 600, kind, 0.15) for kind in range(9)]


def with_a_leap() -> list[Stretch]:
    """Nine slow motions, and one in which the commands leap once, at a speed never seen else."""
    rng = np.random.default_rng(21)
    leap = 0.1 * np.sin(np.arange(600) / 30.0)[:, None] * np.ones(3)
    leap[300:] += 1.5
    return [*slow_motions(rng), follow(rng, leap)]


@pytest.fixture(scope="module")
def few() -> Training:
    """What a fast motion does, a single leap tells."""
    return trained(with_a_leap())


@pytest.fixture(scope="module")
def plain() -> Training:
    """The same recording, by least squares alone."""
    return by_least_squares(with_a_leap())


def test_few_motions_hold_on_and_a_new_motion_is_predicted(few: Training, plain: Training) -> None:
    rng = np.random.default_rng(12)
    assert not few.figures["arm"].determined
    assert plain.figures["arm"].strength is None
    sides = np.sign(np.sin(np.arange(600)[:, None] / 40.0 + np.arange(3)))
    fast = follow(rng, 0.5 + 0.7 * sides)
    assert unseen_rms(few, fast).mean() < 0.5 * unseen_rms(plain, fast).mean()


def test_a_baseline_keeps_its_doubt(few: Training) -> None:
    again = parse_baseline(dump_baseline(few.baseline).encode(), source="again")
    before, after = (of.legs["arm"].domain for of in (few.baseline, again))
    np.testing.assert_allclose(after.inflation, before.inflation)
    rng = np.random.default_rng(2)
    theta = rng.normal(size=(20, len(before.scale))) * before.scale
    np.testing.assert_allclose(after.leverage(theta), before.leverage(theta), rtol=0.02)


def waves(rng: np.random.Generator) -> Array:
    """Commands that determine all terms, within a quarter of a radian."""
    ticks = np.arange(6000)[:, None]
    slow = 0.25 * np.sin(2.0 * np.pi * 0.02 * ticks * rng.uniform(0.5, 0.9, 3))
    return np.asarray(slow + rng.normal(scale=0.01, size=slow.shape))


@pytest.fixture(scope="module")
def determined() -> Training:
    rng = np.random.default_rng(13)
    return trained([follow(rng, waves(rng))])


def test_motions_that_determine_all_terms_hold_on_as_the_family_does(determined: Training) -> None:
    assert determined.figures["arm"].determined
    assert determined.figures["arm"].strength == 1.0
    assert '"doubt"' not in dump_baseline(determined.baseline)


def test_a_fit_to_two_minutes_of_one_gait_predicts_the_next_one() -> None:
    """Held-out swings of the same gait determine all terms; those of another show otherwise."""
    rng = np.random.default_rng(17)
    gait = 0.3 * np.sin(2.0 * np.pi * np.arange(6000)[:, None] / 40.0 + np.arange(3))
    gait += rng.normal(scale=0.01, size=gait.shape)
    turn = np.sign(np.sin(np.arange(600)[:, None] / 40.0 + np.arange(3)))
    fitted = [follow(rng, gait)]
    own, plain = trained(fitted), by_least_squares(fitted)
    assert own.figures["arm"].determined
    other = follow(rng, 0.5 + 0.7 * turn)
    assert unseen_rms(own, other).mean() < 0.2 * unseen_rms(plain, other).mean()
    same = follow(rng, gait[:600])
    assert unseen_rms(own, same).mean() < 1.1 * unseen_rms(plain, same).mean()


def test_a_shove_of_two_ticks_is_left_out(determined: Training) -> None:
    """The recording was given as free, and a joint is held away."""
    rng = np.random.default_rng(13)
    motion = follow(rng, waves(rng))
    motion.measured[4000:4002, 1] += 0.5
    shoved = trained([motion])
    assert 0 < shoved.figures["arm"].outliers < 20
    assert threshold_of(shoved) < 1.5 * threshold_of(determined)


# -- a few ticks at speeds that no other motion has --------------------------------------------


def threshold_of(training: Training) -> float:
    return max(tail.quantile(1e-6) for tail in training.baseline.tails)


def test_a_few_ticks_like_no_other_raise_no_threshold(few: Training, plain: Training) -> None:
    """Errors of the leap are no noise of the slow motions."""
    rng = np.random.default_rng(21)
    without = trained([*slow_motions(rng), arm_motion(rng, 600, 0, 0.15)])
    assert threshold_of(few) < 2.0 * threshold_of(without)
    assert threshold_of(few) < threshold_of(plain)
