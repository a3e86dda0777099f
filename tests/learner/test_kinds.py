"""The kind of a change, from what it leaves of the ticks after it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from adaptive_contact.core.learn.change_classifier import (
    KINDS,
    LEAST_SHARE,
    ChangeClassifier,
)
from adaptive_contact.model import Baseline, LegBaseline, LegModel, stack
from adaptive_contact.model.labelled_swing import NO_ROWS, Rows

from .conftest import FakeLeg
from .ticks import Tick, rows_of

SWINGS = 6


@pytest.fixture(scope="module")
def known(baseline: Baseline) -> LegBaseline:
    return baseline.legs["rf"]


def swings(known: LegBaseline, seed: int, gain: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(n, p) regressors and (n, J) rad residuals of some swings of a leg with another gain."""
    measured, desired, _, _ = FakeLeg(seed=seed).run(SWINGS + 2, change=lambda _: gain)
    library = known.model.library
    cut = stack(measured, desired, library.window)
    swinging = (cut.tick >= 28) & (cut.tick % 28 < 24)
    theta = library.evaluate(cut.measured, cut.desired, cut.preview)[swinging]
    return theta, cut.increment[swinging] - theta @ known.model.coefficients


def changed(known: LegBaseline, kind: str, theta: np.ndarray) -> np.ndarray:
    """(n, J) what a change of one kind adds to the motion, 3 times the noise in its joints."""
    library, own = known.model.library, known.model.coefficients
    of = {term: theta[:, i] for i, term in enumerate(library.names)}
    out = np.zeros((len(theta), 3))
    for j, name in enumerate(library.joints):
        if kind == "friction":
            out[:, j] = -np.tanh(theta @ own[:, j] / 0.02)
        elif kind == "load" and library.axes[j] == "pitch":
            out[:, j] = -of[f"cos φ_{name}"]
        elif kind == "drive":
            for i, term in enumerate(library.names):
                if term.startswith("sat(") and f"_{name}" in term:
                    out[:, j] -= own[i, j] * theta[:, i]
        elif kind == "softer":
            out[:, j] = of[f"sat(e_{name}/2s)"] - of[f"sat(e_{name}/s)"]
    size = np.sqrt(np.square(out).mean(axis=0))
    return out * np.where(size > 0, 3.0 * known.noise.rms / np.maximum(size, 1e-12), 0.0)


def ticks_of(model: LegModel, theta: np.ndarray, residual: np.ndarray) -> Rows:
    target = theta @ model.coefficients + residual
    return rows_of([Tick(t, y) for t, y in zip(theta, target, strict=True)])


def evidence(known: LegBaseline, theta: np.ndarray, residual: np.ndarray) -> ChangeClassifier:
    found = ChangeClassifier(known.model, np.asarray(known.noise.rms))
    found.add(ticks_of(known.model, theta, residual))
    return found


@pytest.mark.parametrize("seed", range(31, 36))
@pytest.mark.parametrize("kind", [*KINDS, "softer", "weaker"])
def test_a_change_is_named(known: LegBaseline, kind: str, seed: int) -> None:
    """A leg that pulls less is not made up of the library's terms: it itself is another."""
    theta, residual = swings(known, seed, gain=0.6 if kind == "weaker" else 1.0)
    found = evidence(known, theta, residual + changed(known, kind, theta))
    assert found.kind == (kind if kind in KINDS else "drive")


def test_noise_has_no_kind(known: LegBaseline) -> None:
    rng = np.random.default_rng(0)
    for seed in range(31, 41):
        theta, residual = swings(known, seed)
        assert evidence(known, theta, residual).kind is None
        white = rng.normal(size=residual.shape) * known.noise.rms
        assert evidence(known, theta, white).kind is None
    assert evidence(known, theta, np.zeros_like(residual)).kind is None
    assert ChangeClassifier(known.model, known.noise.rms).kind is None


def test_a_kind_that_explains_too_little_is_not_told(known: LegBaseline) -> None:
    """Noise drowns a change once it holds more than the rest of the squared residual."""
    theta, _ = swings(known, 31)
    rng = np.random.default_rng(1)
    white = rng.normal(size=(len(theta), 3)) * known.noise.rms
    made = changed(known, "friction", theta)
    unit = np.sqrt(
        np.square(made / known.noise.rms).sum() / np.square(white / known.noise.rms).sum()
    )
    for share, kind in ((0.5 * LEAST_SHARE, None), (2.0 * LEAST_SHARE, "friction")):
        factor = np.sqrt(share / (1.0 - share)) / unit
        assert evidence(known, theta, white + factor * made).kind == kind


def _left(known: LegBaseline, theta: np.ndarray, residual: np.ndarray, kind: str) -> float:
    """Share of the squared residual that a kind leaves, joint by joint from all rows at once."""
    library, own = known.model.library, known.model.coefficients
    of = {term: theta[:, i] for i, term in enumerate(library.names)}
    left = total = 0.0
    for j, name in enumerate(library.joints):
        y = residual[:, j] / known.noise.rms[j]
        total += float(y @ y)
        shapes: Sequence[np.ndarray] = {
            "friction": lambda j=j, name=name: [np.tanh(theta @ own[:, j] / 0.02)],
            "drive": lambda j=j, name=name: [
                sum(
                    own[i, j] * theta[:, i]
                    for i, t in enumerate(library.names)
                    if t.startswith("sat(") and f"_{name}" in t
                ),
                of[f"sat(e_{name}/2s)"] - of[f"sat(e_{name}/s)"],
            ],
            "load": lambda j=j, name=name: [
                *(of[f"cos φ_{n}"] for n in library.joints[j:] if library.axes[j] == "pitch"),
                theta @ own[:, j] - of[f"v_{name}"],
            ],
        }[kind]()
        x = np.array(shapes).T
        rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
        left += float(rest @ rest)
    return left / total


@pytest.mark.parametrize("kind", KINDS)
def test_rows_one_by_one_are_as_good_as_all_at_once(known: LegBaseline, kind: str) -> None:
    """Sums of products against dense least squares over all rows."""
    theta, noise = swings(known, 33)
    residual = noise + changed(known, "drive", theta)
    found = ChangeClassifier(known.model, np.asarray(known.noise.rms))
    rows = ticks_of(known.model, theta, residual)
    for k in range(len(rows)):
        found.add(rows[k : k + 1])
    found.add(NO_ROWS)
    assert found.unexplained(kind) == pytest.approx(_left(known, theta, residual, kind), rel=1e-6)
