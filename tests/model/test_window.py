"""Windows hold what the equations say, lag by lag."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import ChangeLibrary, Library, Window, stack, with_changes


@given(
    st.integers(0, 30), st.integers(1, 3), st.integers(0, 4), st.integers(0, 4), st.integers(0, 3)
)
def test_every_row_holds_its_lags(
    n: int, joints: int, past: int, commands: int, ahead: int
) -> None:
    rng = np.random.default_rng(n)
    measured, desired = rng.normal(size=(2, n, joints))
    rows = stack(measured, desired, Window(past, commands, ahead))
    expected = [k for k in range(n) if k >= max(past, commands) and k + max(1, ahead) < n]
    assert rows.tick.tolist() == expected
    for row, k in enumerate(expected):
        for lag in range(past + 1):
            np.testing.assert_array_equal(rows.measured[row, lag], measured[k - lag])
        for lag in range(commands + 1):
            np.testing.assert_array_equal(rows.desired[row, lag], desired[k - lag])
        for lead in range(ahead):
            np.testing.assert_array_equal(rows.preview[row, lead], desired[k + 1 + lead])
        np.testing.assert_array_equal(rows.increment[row], measured[k + 1] - measured[k])


@pytest.mark.parametrize("name", ["servo", "paper", "linear"])
@pytest.mark.parametrize("joints", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "window", [Window(3, 3, 0), Window(2, 2, 1), Window(0, 0, 0), Window(1, 3, 2)]
)
def test_every_column_has_a_name_of_its_own(name: str, joints: int, window: Window) -> None:
    library = Library(
        name, tuple("abcd"[:joints]), ("yaw", "pitch", "pitch", "pitch")[:joints], window
    )  # type: ignore[arg-type]
    rows = stack(*np.random.default_rng(0).normal(size=(2, 20, joints)), window)
    theta = library.evaluate(rows.measured, rows.desired, rows.preview)
    assert theta.shape == (len(rows.tick), library.size)
    assert len(set(library.names)) == library.size
    # Batched over any leading shape; BLAS may add in another order then.
    np.testing.assert_allclose(
        library.evaluate(rows.measured[:4, None], rows.desired[:4, None], rows.preview[:4, None])[
            :, 0
        ],
        theta[:4],
        rtol=1e-12,
        atol=1e-14,
    )


def test_the_papers_library_is_equation_8() -> None:
    library = Library("paper", ("a", "b", "c"), ("yaw", "pitch", "pitch"), Window(2, 2, 1))
    variables = 3 * (3 + 3 + 1)
    assert library.size == 1 + 3 * variables + variables * (variables + 1) // 2
    rng = np.random.default_rng(0)
    x, u, ahead = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(1, 3))
    values = dict(zip(library.names, library.evaluate(x, u, ahead), strict=True))
    assert values["θ_b[k-2]"] == x[2, 1]
    assert values["sin(u_c[k+1])"] == np.sin(ahead[0, 2])
    assert values["cos(u_a)"] == np.cos(u[0, 0])
    assert values["θ_a u_b[k-1]"] == x[0, 0] * u[1, 1]


@pytest.mark.parametrize("window", [Window(3, 3, 0), Window(1, 4, 2), Window(4, 1, 1)])
def test_every_term_of_the_servo_library_is_what_its_name_says(window: Window) -> None:
    """Against the formulas in plain floats, term by term."""
    joints, axes = ("coxa", "femur", "tibia"), ("yaw", "pitch", "pitch")
    library = Library("servo", joints, axes, window, slope_rad=0.2, period_s=0.02)
    rng = np.random.default_rng(3)
    x = rng.normal(scale=0.3, size=(window.past_measured + 1, 3)).tolist()
    u = rng.normal(scale=0.3, size=(window.past_desired + 1, 3)).tolist()
    ahead = rng.normal(scale=0.3, size=(window.preview, 3)).tolist()
    values = dict(
        zip(
            library.names,
            library.evaluate(*(np.array(part).reshape(-1, 3) for part in (x, u, ahead))).tolist(),
            strict=True,
        )
    )

    def sat(value: float) -> float:
        return min(1.0, max(-1.0, value))

    def at(lag: int) -> str:
        return f"[k-{lag}]" if lag else ""

    expected = {"1": 1.0}
    depth = min(window.past_measured, window.past_desired) + 1
    for j, name in enumerate(joints):
        expected[f"θ_{name}"] = x[0][j]
        expected[f"e_{name}/s"] = (u[0][j] - x[0][j]) / 0.2
        for factor in (0.5, 2):
            expected[f"sat(e_{name}/{factor:g}s)"] = sat((u[0][j] - x[0][j]) / (0.2 * factor))
        middle = x[0][j] + (x[0][j] - x[1][j]) / 2
        expected[f"sat((e_{name}-v_{name}/2)/s)"] = sat((u[0][j] - middle) / 0.2)
        expected[f"tanh(v_{name}/v₀)"] = math.tanh((x[0][j] - x[1][j]) / (0.5 * 0.02))
        for lag in range(window.past_measured):
            expected[f"v_{name}{at(lag)}"] = x[lag][j] - x[lag + 1][j]
        for lag in range(window.past_desired):
            expected[f"Δu_{name}{at(lag)}"] = u[lag][j] - u[lag + 1][j]
        for lag in range(depth):
            expected[f"sat(e_{name}{at(lag)}/s)"] = sat((u[lag][j] - x[lag][j]) / 0.2)
        for lag in range(depth - 1):
            expected[f"sat(e⁻_{name}{at(lag)}/s)"] = sat((u[lag + 1][j] - x[lag][j]) / 0.2)
        for lead in range(window.preview):
            expected[f"u_{name}[k+{lead + 1}]-u_{name}"] = ahead[lead][j] - u[0][j]
    for name, angle in (("femur", x[0][1]), ("tibia", x[0][1] + x[0][2])):
        expected[f"cos φ_{name}"], expected[f"sin φ_{name}"] = math.cos(angle), math.sin(angle)
    assert values == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigurationError, match="past_measured is 99"):
        Window(past_measured=99)
    with pytest.raises(ConfigurationError, match="library is 'magic'"):
        Library("magic", ("a",), ("pitch",))  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="1 axes for 2 joints"):
        Library("servo", ("a", "b"), ("pitch",))


# -- Terms for what may happen to a leg, against the same written out term by term

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
