"""What is known of any leg: its units, and legs of any number of joints."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import Library, Window
from adaptive_contact.model.leg_prior import columns_of, family, leg_prior

AXES = ("yaw", "roll", "pitch", "pitch", "pitch", "roll", "yaw")


def library(joints: int, **given: float) -> Library:
    return Library("servo", tuple(f"j{i}" for i in range(joints)), AXES[:joints], **given)


@pytest.mark.parametrize("joints", range(1, 8))
def test_a_joint_s_prior_does_not_depend_on_how_many_there_are(joints: int) -> None:
    of_many, of_one = library(joints), library(1)
    many, one = leg_prior(of_many, 0.0015), leg_prior(of_one, 0.0015)
    alone = columns_of(of_one, 0)
    for joint in range(joints):
        own = columns_of(of_many, joint)
        np.testing.assert_array_equal(
            many.model.coefficients[own.own, joint], one.model.coefficients[alone.own, 0]
        )
        ours = many.spread[joint][:, own.own]
        theirs = one.spread[0][:, alone.own]
        np.testing.assert_allclose(ours.T @ ours, theirs.T @ theirs, rtol=1e-12)


def test_a_prior_has_units_of_the_slope() -> None:
    """Twice the slope, positions and steps: twice the movement (but for the mean's covariates)."""
    rng = np.random.default_rng(1)
    of = library(3)
    at = columns_of(of, 1)
    known = leg_prior(of, 0.0015)
    window = rng.normal(0.0, 0.02, (4, 3))
    theta = of.evaluate(window, window + 0.01, np.zeros((0, 3)))
    twice = dataclasses.replace(of, slope_rad=2.0 * of.slope_rad)
    doubled = leg_prior(twice, 0.0030)
    again = twice.evaluate(2.0 * window, 2.0 * (window + 0.01), np.zeros((0, 3)))
    friction = [i for i, name in enumerate(of.names) if name.startswith("tanh")]
    keep = np.setdiff1d(at.own, friction)  # its knee is a speed
    for one, two in zip(known.spread[1], doubled.spread[1], strict=True):
        np.testing.assert_allclose(
            again[keep] @ two[keep], 2.0 * (theta[keep] @ one[keep]), atol=1e-12
        )


def test_its_spread_is_the_family_s_covariance() -> None:
    of = library(2)
    at = columns_of(of, 0)
    spread = leg_prior(of, 0.0015).spread
    ours = spread[0].T @ spread[0]
    unit = of.slope_rad / at.own_unit
    np.testing.assert_allclose(
        ours[np.ix_(at.own, at.own)],
        np.array(family().covariance) * np.outer(unit, unit),
        rtol=1e-9, atol=1e-15,
    )  # fmt: skip
    assert ours[at.common[0], at.common[0]] == pytest.approx(
        (family().constant * of.slope_rad) ** 2
    )
    wide = leg_prior(of, 0.0015, widening=3.0).spread
    np.testing.assert_allclose(wide, 3.0 * spread)


def test_the_mean_pulls_towards_the_command_at_any_rate() -> None:
    """Of a leg at rest, off its command by half a slope: it moves there, and not beyond."""
    for period_s in (1 / 30, 0.02, 0.01, 1 / 200):
        for slope in (0.07, 0.17, 0.4):
            of = library(2, period_s=period_s, slope_rad=slope)
            model = leg_prior(of, 0.0015).model
            still, command = np.zeros((4, 2)), np.full((4, 2), 0.5 * slope)
            moved = model.increment(still, command, np.zeros((0, 2)))
            assert (moved > 0.0).all()
            assert (moved < 0.5 * slope).all()


def test_other_libraries_have_no_family() -> None:
    with pytest.raises(ConfigurationError, match="usual library"):
        leg_prior(dataclasses.replace(library(2), window=Window(2, 2, 0)), 0.0015)
    with pytest.raises(ConfigurationError, match="usual library"):
        leg_prior(dataclasses.replace(library(2), name="linear"), 0.0015)
