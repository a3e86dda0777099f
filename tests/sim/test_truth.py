from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.plant import Touch
from adaptive_contact_sim.truth import Change, TruthTracker

N = len(LEGS)
SUBSTEPS = 20


def track(
    force: np.ndarray, touches: list[Touch] | None = None, start: float = 0.0
) -> list[Change]:
    """Changes of leg 0 for a force per physics step; the other legs stay in the air."""
    tracker = TruthTracker(0.001, SUBSTEPS)
    changes = tracker.start(np.full(N, start), 0)
    seen = tuple(deque(touches or []) for _ in LEGS)
    for k in range(len(force) // SUBSTEPS):
        rows = np.zeros((SUBSTEPS, N))
        rows[:, 0] = force[k * SUBSTEPS : (k + 1) * SUBSTEPS]
        changes += tracker.update(rows, seen, (k + 1) * SUBSTEPS)
    return [c for c in changes if c.leg == 0]


def reference(force: np.ndarray) -> list[tuple[int, bool]]:
    """The same rule, on the whole trace at once; force[i] is physics step i + 1."""
    changes = [(0, False)]
    contact, quiet = False, 0
    for i in range(len(force) - 20):
        if contact:
            quiet = quiet + 1 if force[i] < 0.1 else 0
            if quiet == 60:
                contact = False
                changes.append((i + 1 - 59, False))
        elif force[i] > 0.5 and np.mean(force[i : i + 20]) > 0.5:
            contact, quiet = True, 0
            changes.append((i + 1, True))
    return changes


def trace(*pieces: tuple[int, float]) -> np.ndarray:
    return np.concatenate([np.full(steps, value) for steps, value in pieces])


def test_a_touch_has_its_own_time_and_mean_force() -> None:
    force = trace((107, 0.0), (3, 30.0), (190, 2.0), (200, 0.0))
    changes = track(force)
    assert [(c.step, c.contact) for c in changes] == [(0, False), (108, True), (301, False)]
    assert changes[1].force_n == pytest.approx((3 * 30.0 + 17 * 2.0) / 20)
    assert changes[2].force_n == 0.0


def test_loaded_at_the_start() -> None:
    changes = track(trace((40, 5.0), (120, 0.0)), start=5.0)
    assert [(c.step, c.contact, c.force_n) for c in changes] == [(0, True, 5.0), (41, False, 0.0)]


def test_touch_is_the_one_that_led_to_the_contact() -> None:
    touches = [Touch(step, 3, 0.1 * step, False, 0) for step in (20, 95, 101, 140)]
    change = track(trace((100, 0.0), (60, 5.0), (100, 0.0)), touches)[1]
    assert change.touch.step == 95


@example([(100, 0.0), (50, 5.0), (59, 0.0), (50, 5.0), (60, 0.0), (50, 5.0), (100, 0.0)])
@example([(100, 0.0), (1, 8.0), (90, 0.0), *[(5, 20.0), (35, 0.0)] * 5, (100, 5.0)])
@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(1, 90), st.sampled_from([0.0, 0.05, 0.3, 0.6, 2.0, 25.0])),
        min_size=1,
        max_size=25,
    )
)
def test_equals_the_slow_rule_on_any_trace(pieces: list[tuple[int, float]]) -> None:
    force = np.concatenate([trace(*pieces), np.zeros(100)])
    force = force[: len(force) // SUBSTEPS * SUBSTEPS]
    assert [(c.step, c.contact) for c in track(force)] == reference(force)
