"""The family of legs: legs as drawn, what is learned from them, and trials on others."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact_studies.family import prior
from adaptive_contact_studies.family import trials as tried
from adaptive_contact_studies.family.legs import LEG, draw_leg, record
from adaptive_contact_studies.family.trials import trials
from adaptive_contact_studies.work import Work
from tests.sim.touches import tick_of

KIND = "second generator in pose"


@pytest.mark.parametrize("second", [False, True])
def test_a_seed_draws_one_leg(second: bool) -> None:
    one, again, other = (draw_leg(seed, second=second) for seed in (11, 11, 12))
    np.testing.assert_array_equal(one.origins_m, again.origins_m)
    assert one.robot == again.robot
    assert one.robot != other.robot
    assert (one.cascade is not None) == second


@pytest.mark.parametrize("motion", ["pose", "gait"])
def test_a_leg_touches_nothing_but_plates(motion: str) -> None:
    leg = draw_leg(3)
    free = record(leg, motion, 12, 5).legs[LEG]  # type: ignore[arg-type]
    assert not free.contact.any()
    assert not free.onsets
    run = record(leg, motion, 12, 5, plates=1.0)  # type: ignore[arg-type]
    plates = run.legs[LEG]
    assert plates.onsets
    assert (plates.force_n[[tick_of(run, o) for o in plates.onsets]] > 0.0).all()
    # The plate is parked as the foot lifts off, so each swing starts free.
    assert len(plates.changes) == 2 * len(plates.onsets) + 1
    np.testing.assert_array_equal(free.desired, plates.desired)


def test_a_family_s_gaussian_is_found_again() -> None:
    """Coefficients drawn from a Gaussian whose mean depends on a covariate: both come back."""
    rng = np.random.default_rng(3)
    mean = np.array([[0.4, 0.2, 0, 0, 0], [-0.3, 0.0, 0, 0, 0]])
    root = np.array([[0.10, 0.0], [0.05, 0.08]])
    sigma, joints = 0.02, []
    for _ in range(600):
        z = np.array([1.0, rng.normal(), 0.0, 0.0, 0.0])
        own = mean @ z + root @ rng.normal(size=2)
        theta = rng.normal(size=(80, 4))  # two of its own, the constant and gravity
        y = theta @ np.append(own, rng.normal(0.0, (0.3, 0.1))) + rng.normal(0.0, sigma, 80)
        whole = np.linalg.qr(np.column_stack([theta, y]), mode="r")
        joints.append(
            prior.JointRows(
                whole[:4, :4], whole[:4, 4], float(whole[4, 4] ** 2), 80, 2, 2,
                np.zeros(0, dtype=np.int64), z, 0.01, np.ones(2), (2.0, 3.0), 1e-3,
            )
        )  # fmt: skip
    family = prior.maximise(joints)
    np.testing.assert_allclose(family.mean, mean, atol=0.02)
    np.testing.assert_allclose(family.covariance, root @ root.T, atol=2e-3)
    assert family.constant == pytest.approx(0.3, rel=0.1)
    assert family.gravity == pytest.approx(0.1, rel=0.1)
    assert np.sqrt(np.mean([j.variance for j in joints])) == pytest.approx(sigma, rel=0.03)


@pytest.mark.slow
def test_a_leg_is_tried_without_a_baseline_and_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "_FREE_SWINGS", 150)
    (leg,) = trials(Work(None), (KIND,), runs=1)
    assert leg.kind == KIND
    assert leg.known.touches == leg.without.touches
