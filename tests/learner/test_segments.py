"""The buffer of confirmed rows, and the regions that they are of."""

from __future__ import annotations

import numpy as np

from adaptive_contact.core.detect.contact import MAX_ROWS
from adaptive_contact.core.detect.swing_labels import (
    Regions,
)
from adaptive_contact.core.learn.replay_buffer import MOST_ROWS, ReplayBuffer
from adaptive_contact.model.labelled_swing import SEGMENTS, Rows

from .conftest import PERIOD
from .ticks import Tick, rows_of


def row(
    tick: int, *, lift: bool, level: float = 1.0, was_free: bool = False, cleared: bool = True
) -> Tick:
    at = np.full(2, float(tick))
    return Tick(at, np.zeros(1), level, level, 0, tick * PERIOD, lift, was_free, cleared)


def rows(n: int, *, lift: bool = True) -> Rows:
    return rows_of([row(tick, lift=lift) for tick in range(n)])


def test_rows_keep_their_segments_where_others_go() -> None:
    """Room that evicted rows leave is used again, and new rows are not mixed up with old ones."""
    rng = np.random.default_rng(3)
    buffer = ReplayBuffer(limit=12)
    given: dict[int, np.ndarray] = {}
    for k in range(400):
        targets = rng.normal(size=(rng.integers(1, 30), 1))
        given[k] = targets
        ticks = [row(k, lift=True)._replace(target=target) for target in targets]
        buffer.add(rows_of(ticks), region=int(rng.choice(3, p=(0.8, 0.15, 0.05))), era=k // 150)
        kept = buffer.segments
        for segment in kept:
            np.testing.assert_array_equal(segment.target, given[segment.t_ns // PERIOD])
        off, _ = buffer.residuals(np.zeros((2, 1)), k // 150)
        assert len(kept) <= 12
        now = [segment.target for segment in kept if segment.era == k // 150]
        np.testing.assert_array_equal(off, np.concatenate(now))


def test_a_monotonous_gait_does_not_push_out_the_rest() -> None:
    buffer = ReplayBuffer(limit=20)
    for region in range(4):
        buffer.add(rows(4), region=region, era=0)
    for _ in range(200):
        buffer.add(rows(4), region=0, era=0)
    kept = {segment.cell[1] for segment in buffer.segments}
    assert kept == {0, 1, 2, 3}


def test_a_wild_command_does_not_make_all_places_one_for_good() -> None:
    regions = Regions()
    rng = np.random.default_rng(0)

    def places(swings: int) -> set[int]:
        at = rng.uniform((-0.5, -0.3, 0.8), (0.5, 0.3, 1.4), (swings, 3))
        return {regions.region_of(command) for command in at.tolist()}

    assert places(60) == set(range(6))
    regions.region_of([40.0, 0.0, -40.0])
    assert len(places(60)) < 6, "beside that everything is near"
    places(SEGMENTS)
    assert places(60) == set(range(6))


def test_a_buffer_of_very_slow_swings_is_bounded_in_rows() -> None:
    buffer = ReplayBuffer()
    for k in range(60):
        slow = [row(MAX_ROWS * k + i, lift=k % 2 == 0) for i in range(MAX_ROWS)]
        buffer.add(rows_of(slow), k % 3, 0)
        held = buffer.counts.lift_ticks + buffer.counts.descent_ticks
        assert held == MAX_ROWS * min(k + 1, MOST_ROWS // MAX_ROWS)
    again = ReplayBuffer()
    again.restore([*buffer.segments] * 3)
    assert again.counts.lift_ticks + again.counts.descent_ticks <= MOST_ROWS
    assert {segment.cell for segment in buffer.segments} == {
        (a, b) for a in (0, 1) for b in range(3)
    }
