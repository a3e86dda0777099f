"""The directions in which a changed leg's coefficients move, and the terms that may."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.adapt import Baseline
from adaptive_contact.adapt.directions import core_support, drift_directions
from adaptive_contact.identify import LegModel, stack
from adaptive_contact.identify.recursive import RecursiveLeastSquares

from .conftest import FakeLeg

NOISE = np.array([0.004, 0.005, 0.006])


@pytest.fixture(scope="module")
def model(baseline: Baseline) -> LegModel:
    return baseline.legs["rf"].model


@pytest.fixture(scope="module")
def scale(baseline: Baseline) -> np.ndarray:
    return baseline.legs["rf"].scale


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
        assert {"cos φ_femur", "sin φ_femur", "cos φ_tibia", "sin φ_tibia"} <= told
        # Of another joint, only what the model has already.
        for other in set(model.library.joints) - {name}:
            foreign = names.index(f"tanh(v_{other}/v₀)")
            assert core[foreign, joint] == model.support[foreign, joint]
    assert not core.all(), "the rest stays where it is"


def test_directions_have_a_shape_and_stay_in_the_support(
    model: LegModel, scale: np.ndarray
) -> None:
    moves = drift_directions(model, scale, NOISE)
    core = core_support(model)
    p, joints = model.coefficients.shape
    assert moves.ndim == 3
    assert (moves.shape[0], moves.shape[2]) == (joints, p)
    assert np.isfinite(moves).all()
    for joint in range(joints):
        assert not moves[joint][:, ~core[:, joint]].any()
        # Every term that may move does so along one direction at least.
        assert moves[joint][:, core[:, joint]].any(axis=0).all()


def test_a_softer_law_is_among_them(model: LegModel, scale: np.ndarray) -> None:
    """The law's terms down, the gentle one up: the same pull at full error, less at a small one."""
    moves = drift_directions(model, scale, NOISE)
    for joint, name in enumerate(model.library.joints):
        law, own = law_of(model, joint), model.coefficients[:, joint]
        gentle = model.library.names.index(f"sat(e_{name}/2s)")
        others = [i for i in law if i != gentle]
        assert np.abs(own[others]).max() > 0.0
        expected = np.zeros(model.library.size)
        expected[others] = -0.5 * own[others]
        expected[gentle] = 0.5 * own[others].sum()
        found = [row for row in moves[joint] if np.allclose(row, expected, atol=1e-15)]
        assert len(found) == 1, name
        assert found[0][law].sum() == pytest.approx(0.0, abs=1e-12)
        assert found[0][gentle] > 0.0


def test_a_drive_that_weakens_moves_all_of_its_law(model: LegModel, scale: np.ndarray) -> None:
    moves = drift_directions(model, scale, NOISE)
    for joint in range(len(model.library.joints)):
        weaker = np.zeros(model.library.size)
        law = law_of(model, joint)
        weaker[law] = model.coefficients[law, joint]
        along = [row for row in moves[joint] if np.count_nonzero(row) and _parallel(row, weaker)]
        assert along, "supply and winding scale the law"
        assert all(0.1 < np.linalg.norm(r) / np.linalg.norm(weaker) < 1.0 for r in along)


def test_a_small_scale_gives_a_term_a_large_coefficient(model: LegModel, scale: np.ndarray) -> None:
    """Single terms move a prediction by a share of the noise, whatever their size."""
    moves = drift_directions(model, scale, NOISE)
    for joint in range(len(NOISE)):
        single = [row for row in moves[joint] if np.count_nonzero(row) == 1]
        units = np.concatenate([row * scale / NOISE[joint] for row in single])
        # Families may be of one term, too.
        told = {size: int(np.isclose(units, size).sum()) for size in (3.0, 1.0, 0.2, 0.1)}
        assert told[3.0] == 2, "friction, dry and viscous"
        assert told[1.0] >= 6, "the joint's own law"
        assert told[0.2] >= 1
        assert told[0.1] >= 4, "where the leg is"


@pytest.mark.parametrize("name", ["paper", "linear"])
def test_a_library_without_such_terms_has_no_others(baseline: Baseline, name: str) -> None:
    library = dataclasses.replace(baseline.legs["rf"].model.library, name=name)
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(library.size, 3)) * (rng.random((library.size, 3)) < 0.3)
    model = LegModel(library, coefficients)
    moves = drift_directions(model, np.ones(library.size), NOISE)
    core = core_support(model)
    assert core[model.support].all()
    assert moves.shape[0] == 3
    assert moves.shape[2] == library.size
    for joint in range(3):
        assert not moves[joint][:, ~core[:, joint]].any()


def _parallel(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(abs(a @ b) > (1.0 - 1e-9) * np.linalg.norm(a) * np.linalg.norm(b))


def test_friction_heard_in_lifts_is_foretold_in_descents(
    baseline: Baseline, model: LegModel, scale: np.ndarray
) -> None:
    """Along four lifts places and constants could explain it as well, and be wrong further on."""
    measured, desired, _, _ = FakeLeg(seed=41).run(30)
    library = model.library
    cut = stack(measured, desired, library.window)
    theta = library.evaluate(cut.measured, cut.desired, cut.preview)
    noise = np.asarray(baseline.legs["rf"].noise.rms)
    joint, units = 2, 10.0
    friction = library.names.index("tanh(v_tibia/v₀)")
    added = np.zeros_like(cut.increment)
    added[:, joint] = -units * noise[joint] * theta[:, friction]
    phase = cut.tick % 28
    lifts = np.flatnonzero((cut.tick >= 28) & (phase < 10))[:40]
    descents = (cut.tick >= 28 * 8) & (phase >= 13) & (phase < 18)

    rls = RecursiveLeastSquares(model.coefficients, core_support(model), scale, noise)
    rls.loosen(drift_directions(model, scale, noise))
    for row in lifts:
        rls.update(theta[row], cut.increment[row] + added[row])
    off = theta[descents] @ (rls.coefficients - model.coefficients)[:, joint]
    missed = (added[descents, joint] - off) / noise[joint]
    assert np.sqrt(np.square(added[descents, joint] / noise[joint]).mean()) > 4.0
    assert np.sqrt(np.square(missed).mean()) < 0.8
