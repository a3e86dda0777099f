"""Terms for what may happen to a leg, against the same written out term by term."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.model import ChangeLibrary, Library, Window, with_changes

LEG = Library("servo", ("coxa", "femur", "tibia"), ("yaw", "pitch", "pitch"), slope_rad=0.16)
KNEES = (0.3, 1.0, 3.0)


def changing(library: Library, seed: int) -> ChangeLibrary:
    rng = np.random.default_rng(seed)
    joints = len(library.joints)
    first = 0.02 * rng.normal(size=(library.size, joints))
    return with_changes(library, first * (rng.random(first.shape) < 0.5))


def window_of(library: Library, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    w, joints = library.window, len(library.joints)
    sizes = (w.past_measured + 1, w.past_desired + 1, w.preview)
    measured, desired, preview = (rng.uniform(-1.0, 1.0, (n, joints)) for n in sizes)
    return measured, measured[0] + 0.4 * (desired - measured[0]), preview


def clip(value: float) -> float:
    return max(-1.0, min(1.0, value))


def slow_terms(
    library: ChangeLibrary, measured: np.ndarray, desired: np.ndarray
) -> dict[str, float]:
    """The terms of changes by their names, one number at a time."""
    plain = dataclasses.replace(LEG, joints=library.joints, axes=library.axes)
    theta = dict(zip(plain.names, plain.evaluate(measured, desired, np.zeros((0, 3))), strict=True))
    s, out = library.slope_rad, {}
    e = (desired - measured) / s
    left = (desired[1:] - measured[:-1]) / s
    v = measured[0] - measured[1]
    for j, joint in enumerate(library.joints):
        first = dict(zip(plain.names, library.first[:, j], strict=True))
        rollout = sum(first[name] * theta[name] for name in plain.names)
        for knee in KNEES:
            out[f"tanh(δ_{joint}/{knee:g})"] = math.tanh(rollout / (knee * library.period_s))
        softer = 0.0
        for i, other in enumerate(library.joints):
            pulls = {f"sat(e_{other}/0.5s)": e[0, i] / 0.5, f"sat(e_{other}/2s)": e[0, i] / 2.0}
            pulls[f"sat((e_{other}-v_{other}/2)/s)"] = e[0, i] - v[i] / 2.0 / s
            for lag in range(4):
                at = "" if lag == 0 else f"[k-{lag}]"
                pulls[f"sat(e_{other}{at}/s)"] = e[lag, i]
                if lag < 3:
                    pulls[f"sat(e⁻_{other}{at}/s)"] = left[lag, i]
            softer += sum(first[n] * (clip(x / 2.0) - clip(x)) for n, x in pulls.items())
        out[f"δ_{joint}(2s)-δ_{joint}"] = softer
    return out


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_every_term_is_what_its_name_says(seed: int) -> None:
    library = changing(LEG, seed)
    measured, desired, preview = window_of(library, seed + 1)
    theta = dict(zip(library.names, library.evaluate(measured, desired, preview), strict=True))
    for name, value in slow_terms(library, measured, desired).items():
        assert theta[name] == pytest.approx(value, abs=1e-12), name


def test_the_plain_terms_come_first_and_are_the_same() -> None:
    library = changing(LEG, 1)
    assert library.names[: LEG.size] == LEG.names
    assert library.size == LEG.size + 4 * 3
    windows = [window_of(library, seed) for seed in range(5)]
    stacked = [np.stack(part) for part in zip(*windows, strict=True)]
    theta = library.evaluate(*stacked)
    np.testing.assert_array_equal(theta[:, : LEG.size], LEG.evaluate(*stacked))
    one_by_one = np.array([library.evaluate(*window) for window in windows])
    np.testing.assert_allclose(theta, one_by_one, rtol=0, atol=1e-12)


def test_half_as_stiff_is_the_first_model_at_twice_the_slope() -> None:
    library = changing(LEG, 3)
    law = np.array([name.startswith("sat(") for name in LEG.names])
    softer = dataclasses.replace(LEG, slope_rad=2.0 * LEG.slope_rad)
    for seed in range(10):
        window = window_of(library, seed)
        change = np.where(law, softer.evaluate(*window) - LEG.evaluate(*window), 0.0)
        np.testing.assert_allclose(
            library.evaluate(*window)[-3:], change @ library.first, rtol=0, atol=1e-14
        )


@pytest.mark.parametrize("name", ["paper", "linear"])
def test_a_library_without_the_law_has_friction_only(name: str) -> None:
    plain = dataclasses.replace(LEG, name=name, window=Window(2, 2, 1))
    library = changing(plain, 5)
    assert library.size == plain.size + 3 * 3
    assert not [term for term in library.names if "2s" in term]
    window = window_of(library, 6)
    theta = library.evaluate(*window)
    np.testing.assert_array_equal(theta[: plain.size], plain.evaluate(*window))
    rollout = plain.evaluate(*window) @ library.first
    expected = np.concatenate([np.tanh(rollout / (knee * 0.02)) for knee in KNEES])
    np.testing.assert_allclose(theta[plain.size :], expected, rtol=0, atol=1e-12)


def test_legs_with_other_first_models_can_share_arrays_and_plain_ones_cannot() -> None:
    one, other = changing(LEG, 1), changing(LEG, 2)
    assert one == other
    assert hash(one) == hash(other)
    assert one != LEG
    assert one != changing(dataclasses.replace(LEG, slope_rad=0.2), 1)
