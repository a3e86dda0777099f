"""Control ticks of several legs, counted by seq whatever the stamps say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact.checks.motion import LegMotion, control_ticks

PERIOD_S = 0.02
PERIOD_NS = 20_000_000


def leg(ticks: np.ndarray, first_seq: int, off_ns: np.ndarray | None = None) -> LegMotion:
    """A leg whose samples come in these ticks; its count begins with ``first_seq``."""
    late = np.zeros(len(ticks), dtype=np.int64) if off_ns is None else off_ns
    joints = np.zeros((len(ticks), 1))
    t_ns = 1_700_000_000_000_000_000 + ticks * PERIOD_NS + late
    return LegMotion(t_ns, ticks + first_seq, joints, joints)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**31), st.floats(0.0, 0.4), st.integers(-(10**9), 10**9), st.floats(0.0, 0.3)
)
def test_stamps_that_jitter_shift_no_tick(
    seed: int, sigma: float, first_seq: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    ticks = np.arange(600)
    motions = {}
    for name, first in (("a", 0), ("b", first_seq)):
        kept = ticks[rng.random(600) >= share]
        off = rng.normal(0.0, sigma * PERIOD_NS, len(kept)).astype(np.int64)
        motions[name] = leg(kept, first, off)
    found = control_ticks(motions, PERIOD_S)
    truth = {name: motions[name].seq - first for name, first in (("a", 0), ("b", first_seq))}
    apart = {name: np.unique(found[name] - truth[name]) for name in motions}
    assert len(apart["a"]) == 1
    assert apart["a"] == apart["b"]


def test_a_restart_and_legs_that_come_later_stay_in_step() -> None:
    ticks = np.arange(400)
    whole = leg(ticks, 7)
    # A publisher of its own that restarts after tick 250 and counts from 0 again.
    again = np.concatenate([np.arange(100, 250) + 50, np.arange(50)])
    parts = np.concatenate([np.arange(100, 250), np.arange(300, 350)])
    motion = leg(parts, 0)
    restarted = motion._replace(seq=again)
    found = control_ticks({"whole": whole, "parts": restarted}, PERIOD_S)
    assert (found["parts"] - found["whole"][0] == parts).all()


def test_a_source_that_pauses_without_a_gap_in_seq_keeps_its_count() -> None:
    late = np.where(np.arange(300) < 150, 0, 20 * PERIOD_NS)
    motions = {name: leg(np.arange(300), first, late) for name, first in (("a", 3), ("b", 90))}
    found = control_ticks(motions, PERIOD_S)
    assert (np.diff(found["a"]) == 1).all()
    assert (found["a"] == found["b"]).all()


@pytest.mark.parametrize("count", [0, 1])
def test_legs_with_hardly_a_sample_are_no_fault(count: int) -> None:
    motions = {"a": leg(np.arange(100), 0), "b": leg(np.arange(count), 0)}
    assert len(control_ticks(motions, PERIOD_S).get("b", ())) == count
