"""The family of legs: legs as drawn, what is learned from them, and trials on others."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact.model.leg_prior import OTHERS, FamilyFile
from adaptive_contact_studies.family import __main__ as command
from adaptive_contact_studies.family import prior
from adaptive_contact_studies.family import trials as tried
from adaptive_contact_studies.family.legs import LEG, draw_leg, record
from adaptive_contact_studies.family.trials import Figures, LegTrial, table, trials
from adaptive_contact_studies.work import Work

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
    plates = record(leg, motion, 12, 5, plates=1.0).legs[LEG]  # type: ignore[arg-type]
    assert plates.onsets
    assert (plates.force_n[[o.tick for o in plates.onsets]] > 0.0).all()
    # The plate is parked as the foot lifts off, so each swing starts free.
    assert len(plates.releases_ns) == len(plates.onsets) + 1
    np.testing.assert_array_equal(free.desired, plates.desired)


def test_readings_and_commands_are_whole_steps() -> None:
    leg = draw_leg(4)
    arrays = record(leg, "pose", 3, 5).legs[LEG]
    for angles in (arrays.measured, arrays.desired):
        steps = angles / leg.servo.quantum_rad
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_a_command_comes_late_by_its_latency() -> None:
    prompt, late = (
        record(dataclasses.replace(draw_leg(3), latency_ticks=ticks), "pose", 4, 5).legs[LEG]
        for ticks in (0, 2)
    )
    # Their posture at rest still creeps in the first ticks.
    np.testing.assert_allclose(late.angle[12:], prompt.angle[10:-2], atol=2e-3)
    assert np.abs(late.angle - prompt.angle).max() > 0.05


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


def test_a_family_of_few_legs_is_written_and_read(tmp_path: Path) -> None:
    family = prior.learn_family(Work(None), range(4))
    file = tmp_path / "family.json"
    prior.save_family(family, file)
    read = msgspec.json.decode(file.read_bytes(), type=FamilyFile)
    np.testing.assert_allclose(read.mean, family.mean, rtol=1e-5)
    np.testing.assert_allclose(read.covariance, family.covariance, rtol=1e-5)
    assert len(read.others[0]) == len(read.others[1]) == len(OTHERS)
    assert read.origin.startswith("make prior: 2 drawn legs, ")  # two have too few free ticks


@pytest.mark.slow
def test_a_leg_is_tried_without_a_baseline_and_with_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tried, "_FREE_SWINGS", 150)
    (leg,) = trials(Work(None), (KIND,), runs=1)
    assert leg.kind == KIND
    assert leg.known is not None
    assert leg.known.touches == leg.without.touches


def test_a_row_counts_what_its_legs_did() -> None:
    legs = [trial(first=2, found=18), trial(first=4, found=20), trial(first=None, found=0)]
    cells = table(legs).splitlines()[2].split(" | ")
    assert cells[:4] == [f"| {KIND}", "3", "4 / none (1 none)", "4 / none"]
    assert cells[4].startswith("63.3 % (")  # 38 of 60
    assert cells[5].startswith("100.0 % (")
    # Three false alarms in 27,000 ticks of legs of which six make a robot.
    assert cells[6].startswith("60 (")
    assert cells[7].startswith("0 (0 to ")
    assert cells[8].startswith("80.0 % (")


@pytest.mark.parametrize("given", [[], ["learn"], ["try"], ["try", "a", "b"]])
def test_the_command_says_what_it_expects(
    given: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main(given) == 2
    assert "expected `learn FILE` or `try FOLDER`" in capsys.readouterr().err


def trial(first: int | None, found: int = 20) -> LegTrial:
    return LegTrial(
        KIND, first, first or 3, 9_000, Figures(20, found, 1, (10, 8)),
        Figures(20, 20, 0, (10, 9)), "valid",
    )  # fmt: skip
