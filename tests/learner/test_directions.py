"""The directions in which a changed leg's coefficients move, and the terms that may."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.learn.lifecycle import ready_for_changes
from adaptive_contact.learn.rls import RecursiveLeastSquares
from adaptive_contact.model import Baseline, LegBaseline, LegModel, Rows, stack
from adaptive_contact.model.change_prior import change_directions, core_support
from adaptive_contact.model.library import friction_terms, soft_term

from .conftest import FakeLeg

NOISE = np.array([0.004, 0.005, 0.006])


@pytest.fixture(scope="module")
def known(baseline: Baseline) -> LegBaseline:
    return ready_for_changes(baseline.legs["rf"])


@pytest.fixture(scope="module")
def model(known: LegBaseline) -> LegModel:
    return known.model


@pytest.fixture(scope="module")
def scale(known: LegBaseline) -> np.ndarray:
    return known.scale


def law_of(model: LegModel, joint: int) -> list[int]:
    """Terms of the control law of a joint."""
    name = model.library.joints[joint]
    return [
        i for i, t in enumerate(model.library.names) if t.startswith("sat(") and f"_{name}" in t
    ]


def test_the_support_is_the_models_and_what_a_change_may_need(model: LegModel) -> None:
    core = core_support(model)
    assert core.dtype == bool
    assert core.shape == model.coefficients.shape
    assert core[model.support].all()
    names = model.library.names
    for joint, name in enumerate(model.library.joints):
        told = {names[i] for i in np.flatnonzero(core[:, joint])}
        assert {"1", f"v_{name}", f"Δu_{name}", f"tanh(v_{name}/v₀)"} <= told
        assert {f"e_{name}/s", f"sat(e_{name}/s)", f"sat(e_{name}/2s)"} <= told
        assert {*friction_terms(name), soft_term(name)} <= told
        assert {"cos φ_femur", "sin φ_femur", "cos φ_tibia", "sin φ_tibia"} <= told
        # Of another joint, only what the model has already.
        for other in set(model.library.joints) - {name}:
            foreign = names.index(f"tanh(v_{other}/v₀)")
            assert core[foreign, joint] == model.support[foreign, joint]
    assert not core.all(), "the rest stays where it is"


def test_directions_have_a_shape_and_stay_in_the_support(
    model: LegModel, scale: np.ndarray
) -> None:
    moves = change_directions(model, scale, NOISE)
    core = core_support(model)
    p, joints = model.coefficients.shape
    assert moves.ndim == 3
    assert (moves.shape[0], moves.shape[2]) == (joints, p)
    assert np.isfinite(moves).all()
    for joint in range(joints):
        assert not moves[joint][:, ~core[:, joint]].any()
        # Every term that may move does so along one direction at least.
        assert moves[joint][:, core[:, joint]].any(axis=0).all()


def test_a_servo_half_as_stiff_is_two_deviations_away(model: LegModel, scale: np.ndarray) -> None:
    moves = change_directions(model, scale, NOISE)
    for joint, name in enumerate(model.library.joints):
        soft = model.library.names.index(soft_term(name))
        along = [row for row in moves[joint] if row[soft]]
        assert len(along) == 1, name
        assert np.count_nonzero(along[0]) == 1
        assert along[0][soft] == pytest.approx(0.5), "1 is what its first model foretells"


def test_a_drive_that_weakens_moves_all_of_its_law(model: LegModel, scale: np.ndarray) -> None:
    moves = change_directions(model, scale, NOISE)
    for joint in range(len(model.library.joints)):
        weaker = np.zeros(model.library.size)
        law = law_of(model, joint)
        weaker[law] = model.coefficients[law, joint]
        along = [row for row in moves[joint] if np.count_nonzero(row) and _parallel(row, weaker)]
        assert along, "supply and winding scale the law"
        assert all(0.05 < np.linalg.norm(r) / np.linalg.norm(weaker) < 1.0 for r in along)


def test_a_small_scale_gives_a_term_a_large_coefficient(model: LegModel, scale: np.ndarray) -> None:
    """Single terms move a prediction by a share of the noise, whatever their size."""
    moves = change_directions(model, scale, NOISE)
    for joint in range(len(NOISE)):
        single = [row for row in moves[joint] if np.count_nonzero(row) == 1]
        units = np.concatenate([row * scale / NOISE[joint] for row in single])
        # Families may be of one term, too.
        told = {size: int(np.isclose(units, size).sum()) for size in (2.0, 0.5, 0.3, 0.1)}
        assert told[2.0] == 3, "friction against the movement foretold"
        assert told[0.5] >= 2, "and against the last one, dry and viscous"
        assert told[0.3] >= 6, "the joint's own law"
        assert told[0.1] >= 5, "the rest, and where the leg is"


@pytest.mark.parametrize("name", ["paper", "linear"])
def test_a_library_without_such_terms_has_no_others(baseline: Baseline, name: str) -> None:
    library = dataclasses.replace(baseline.legs["rf"].model.library, name=name)
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(library.size, 3)) * (rng.random((library.size, 3)) < 0.3)
    model = LegModel(library, coefficients)
    moves = change_directions(model, np.ones(library.size), NOISE)
    core = core_support(model)
    assert core[model.support].all()
    assert moves.shape[0] == 3
    assert moves.shape[2] == library.size
    for joint in range(3):
        assert not moves[joint][:, ~core[:, joint]].any()


def _parallel(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(abs(a @ b) > (1.0 - 1e-9) * np.linalg.norm(a) * np.linalg.norm(b))


def heard_in_lifts(known: LegBaseline, moved: Rows, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """What forty ticks of lifts make of a changed leg, in noise units of descents never learned.

    Returns:
        How far the leg is off its model there, and how far once the lifts have been learned.
    """
    noise = np.asarray(known.noise.rms)
    model = known.model
    theta = model.library.evaluate(moved.measured, moved.desired, moved.preview)
    phase = moved.tick % 28
    lifts = np.flatnonzero((moved.tick >= 28) & (phase < 10))[:40]
    descents = (moved.tick >= 28 * 8) & (phase >= 13) & (phase < 18)
    rls = RecursiveLeastSquares(model.coefficients, core_support(model), known.scale, noise)
    rls.inflate(change_directions(model, known.scale, noise))
    for row in lifts:
        rls.learn(np.append(theta[row], moved.increment[row])[None], 0)
    off = moved.increment - theta @ model.coefficients
    left = moved.increment - theta @ rls.coefficients
    return off[descents, joint] / noise[joint], left[descents, joint] / noise[joint]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))


@pytest.mark.parametrize("knee", [0.4, 0.8, 2.0])
def test_friction_heard_in_lifts_is_foretold_in_descents(known: LegBaseline, knee: float) -> None:
    """Along four lifts places and constants could explain it as well, and be wrong further on."""
    measured, desired, _, _ = FakeLeg(seed=41).run(30)
    cut = stack(measured, desired, known.model.library.window)
    joint, noise = 2, known.noise.rms
    rollout = known.model.increment(cut.measured, cut.desired, cut.preview)
    held_back = 10.0 * noise[joint] * np.tanh(rollout[:, joint] / (knee * 0.02))
    rubbed = cut.increment.copy()
    rubbed[:, joint] -= held_back
    off, left = heard_in_lifts(known, cut._replace(increment=rubbed), joint)
    assert rms(off) > 4.0
    # Between the knees there is none of its own; what the leg errs anyway is one.
    assert rms(left) < 1.6


def test_a_softer_servo_heard_in_lifts_is_foretold_in_descents(known: LegBaseline) -> None:
    measured, desired, _, _ = FakeLeg(seed=42).run(30)
    library = known.model.library
    cut = stack(measured, desired, library.window)
    softer = dataclasses.replace(library, slope_rad=1.7 * library.slope_rad)
    law = np.array([name.startswith("sat(") for name in library.names])
    theta, soft = (
        one.evaluate(cut.measured, cut.desired, cut.preview) for one in (library, softer)
    )
    change = np.where(law, soft - theta, 0.0) @ known.model.coefficients
    for joint in range(3):
        off, left = heard_in_lifts(known, cut._replace(increment=cut.increment + change), joint)
        assert rms(off) > 2.0
        assert rms(left) < 0.6 * rms(off)
