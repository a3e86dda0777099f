"""The kind of a change, from what it leaves of a few lifts."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.adapt import Baseline
from adaptive_contact.adapt.baseline import LegBaseline
from adaptive_contact.adapt.kinds import LEAST_SHARE, kind_of_change
from adaptive_contact.identify import stack

from .conftest import FakeLeg

# As many lifts as the drift monitor hands over.
LIFTS = 4


@pytest.fixture(scope="module")
def known(baseline: Baseline) -> LegBaseline:
    return baseline.legs["rf"]


def lifts(known: LegBaseline, seed: int, change: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(n, p) regressors and (n, J) rad residuals of some lifts of a leg with another gain."""
    measured, desired, _, _ = FakeLeg(seed=seed).run(LIFTS + 2, change=lambda _: change)
    library = known.model.library
    cut = stack(measured, desired, library.window)
    rising = (cut.tick >= 28) & (cut.tick % 28 < 10)
    theta = library.evaluate(cut.measured, cut.desired, cut.preview)[rising]
    return theta, cut.increment[rising] - theta @ known.model.coefficients


def changed(known: LegBaseline, kind: str, theta: np.ndarray) -> np.ndarray:
    """(n, J) what a change of one kind adds to the motion, 3 times the noise in its joints."""
    library, out = known.model.library, np.zeros((len(theta), 3))
    for j, name in enumerate(library.joints):
        move = np.zeros(library.size)
        single = {"friction": f"tanh(v_{name}/v₀)", "load": f"cos φ_{name}"}.get(kind)
        for i, term in enumerate(library.names):
            if term == single:
                move[i] = -1.0
            elif kind == "drive" and term.startswith("sat(") and f"_{name}" in term:
                move[i] = -known.model.coefficients[i, j]
        out[:, j] = theta @ move
    size = np.sqrt(np.square(out).mean(axis=0))
    return out * np.where(size > 0, 3.0 * known.noise.rms / np.maximum(size, 1e-12), 0.0)


def named(known: LegBaseline, theta: np.ndarray, residual: np.ndarray) -> str | None:
    return kind_of_change(theta, residual, known.model, np.asarray(known.noise.rms))


@pytest.mark.parametrize("seed", range(31, 36))
@pytest.mark.parametrize("kind", ["friction", "drive", "load"])
def test_a_change_is_named(known: LegBaseline, kind: str, seed: int) -> None:
    theta, noise = lifts(known, seed)
    assert named(known, theta, noise + changed(known, kind, theta)) == kind


def test_a_leg_that_pulls_less_has_another_drive(known: LegBaseline) -> None:
    """Not made up of the library's terms: the leg itself is another."""
    for seed in range(31, 36):
        assert named(known, *lifts(known, seed, change=0.6)) == "drive"


def test_noise_has_no_kind(known: LegBaseline) -> None:
    rng = np.random.default_rng(0)
    for seed in range(31, 41):
        theta, residual = lifts(known, seed)
        assert named(known, theta, residual) is None
        white = rng.normal(size=residual.shape) * known.noise.rms
        assert named(known, theta, white) is None
    assert named(known, theta, np.zeros_like(residual)) is None


def test_a_kind_that_explains_too_little_is_not_told(known: LegBaseline) -> None:
    """Noise drowns a change once it holds more than the rest of the squared residual."""
    theta, _ = lifts(known, 31)
    rng = np.random.default_rng(1)
    white = rng.normal(size=(len(theta), 3)) * known.noise.rms
    made = changed(known, "friction", theta)
    unit = np.sqrt(
        np.square(made / known.noise.rms).sum() / np.square(white / known.noise.rms).sum()
    )
    for share, kind in ((0.5 * LEAST_SHARE, None), (2.0 * LEAST_SHARE, "friction")):
        factor = np.sqrt(share / (1.0 - share)) / unit
        assert named(known, theta, white + factor * made) == kind
