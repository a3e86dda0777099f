"""What a swing confirms, and what it keeps back."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.detect.contact import FREE_LIFT_TICKS, MAX_ROWS
from adaptive_contact.detect.swing_labels import (
    GUARD_TICKS,
    HOLE_TICKS,
    LAST_TICKS,
    MISSED_NIS,
    NEAR_TICKS,
    PUSHED_SIGMA,
    Regions,
)
from adaptive_contact.learn.replay_buffer import MOST_ROWS, ReplayBuffer
from adaptive_contact.model.labelled_swing import SEGMENTS, Rows
from adaptive_contact.robot import Robot

from .conftest import PERIOD
from .drivers import Labels
from .ticks import Push, Tick, rows_of


def row(
    tick: int, *, lift: bool, level: float = 1.0, was_free: bool = False, cleared: bool = True
) -> Tick:
    at = np.full(2, float(tick))
    return Tick(at, np.zeros(1), level, level, 0, tick * PERIOD, lift, was_free, cleared)


def ticks(rows: Rows | None) -> list[int]:
    return [] if rows is None else (rows.t_ns // PERIOD).tolist()


def swing(book: Labels, *, up: int, down: int, **fields: object) -> list[int]:
    """Enter a swing; the ticks of the lift it released."""
    book.begin()
    released: list[int] = []
    for tick in range(1, up + down + 1):
        lift = tick <= up
        book.add(row(tick, lift=lift, **fields), tick, descending=not lift)  # type: ignore[arg-type]
        rows = book.take_lift()
        if rows is not None:
            released = ticks(rows)
    return released


def test_the_first_ticks_of_a_lift_are_kept_back(robot: Robot) -> None:
    assert swing(Labels(robot), up=12, down=2) == list(range(FREE_LIFT_TICKS, 13))


def test_a_calm_leg_confirms_its_whole_lift(robot: Robot) -> None:
    assert swing(Labels(robot), up=12, down=2, was_free=True) == list(range(1, 13))


def test_a_foot_that_lets_go_late_is_seen(robot: Robot) -> None:
    book = Labels(robot)
    book.begin()
    for tick in range(1, 15):
        level = 200.0 if tick < 11 else 1.0
        book.add(row(tick, lift=True, level=level), tick, descending=False)
    book.add(row(15, lift=False), 15, descending=True)
    assert ticks(book.take_lift()) == [11, 12, 13, 14]


def test_a_changed_leg_is_not_taken_for_a_late_one(robot: Robot) -> None:
    released = swing(Labels(robot), up=14, down=1, level=30.0)
    assert released == list(range(FREE_LIFT_TICKS, 15))


def test_a_free_descent_is_confirmed_but_for_its_end(robot: Robot) -> None:
    book = Labels(robot)
    swing(book, up=10, down=12)
    assert ticks(book.resolve()) == list(range(11, 23 - LAST_TICKS))
    assert not book.resolve()


def test_an_alarm_confirms_what_came_well_before_its_onset(robot: Robot) -> None:
    book = Labels(robot)
    swing(book, up=10, down=12)
    assert ticks(book.alarm(19 * PERIOD, PERIOD)) == list(range(11, 19 - GUARD_TICKS + 1))
    assert not book.resolve()


ASIDE = np.array([7.0])


def descent(robot: Robot, levels: dict[int, float], pushes: dict[int, float | None]) -> Labels:
    """A swing whose descent, ticks 11 to 22, misses by levels and shows pushes, 0 by default."""
    book = Labels(robot)
    swing(book, up=10, down=0)
    for tick in range(11, 23):
        sigma = pushes.get(tick, 0.0)
        push = None if sigma is None else Push(sigma, ASIDE)
        missed = row(tick, lift=False, level=levels.get(tick, 9.0))._replace(push=push)
        book.add(missed, tick, descending=True)
    return book


def test_of_a_changed_leg_what_no_ground_can_have_done_is_learned_too(
    robot: Robot,
) -> None:
    """Nearer to the onset than the guard, but for the last tick, and only aside from a push."""
    book = descent(robot, levels={17: 0.9 * MISSED_NIS}, pushes={})
    found = book.alarm(19 * PERIOD, PERIOD)
    assert ticks(found) == [*range(11, 19 - GUARD_TICKS + 1), 18]
    assert ticks(found)[-1] == 19 - NEAR_TICKS
    guarded = found.t_ns > (19 - GUARD_TICKS) * PERIOD
    np.testing.assert_array_equal(found.target == ASIDE, guarded[:, None])


@pytest.mark.parametrize("pushed", [1.01 * PUSHED_SIGMA, None])
def test_from_the_first_tick_that_may_be_pushed_nothing_is(
    robot: Robot, pushed: float | None
) -> None:
    book = descent(robot, levels={}, pushes={17: pushed})
    assert ticks(book.alarm(19 * PERIOD, PERIOD)) == list(range(11, 17))


@pytest.mark.parametrize("hole", [2, 12])
@pytest.mark.parametrize("after", [0, HOLE_TICKS, HOLE_TICKS + 1])
def test_after_a_hole_the_guard_counts_from_what_came_before_it(
    robot: Robot, hole: int, after: int
) -> None:
    """A touch that began before it is told after it, with an onset behind it."""
    book = Labels(robot)
    swing(book, up=10, down=6)
    book.hole()  # after tick 16
    first = 17 + hole
    for tick in range(first, first + 11):
        missed = row(tick, lift=False, level=9.0)._replace(push=Push(0.0, ASIDE))
        book.add(missed, tick, descending=True)
    found = ticks(book.alarm((first + after) * PERIOD, PERIOD))
    if after <= HOLE_TICKS:
        assert found == list(range(11, 16 - GUARD_TICKS + 1))
    else:
        assert found == [*range(11, 17), *range(first, first + after - NEAR_TICKS + 1)]


def test_what_rises_in_a_descent_is_no_lift(robot: Robot) -> None:
    book = Labels(robot)
    swing(book, up=10, down=0)
    for tick in range(11, 25):
        book.add(row(tick, lift=tick in (12, 13)), tick, descending=True)
    assert not book.resolve().records["lift"].any()


def test_an_alarm_in_the_lift_does_not_keep_the_lift_back(robot: Robot) -> None:
    book = Labels(robot)
    book.begin()
    for tick in range(1, 13):
        book.add(row(tick, lift=True), tick, descending=False)
        if tick == 6:
            assert not book.alarm(6 * PERIOD, PERIOD)
    book.add(row(13, lift=False), 13, descending=True)
    assert ticks(book.take_lift()) == list(range(FREE_LIFT_TICKS, 13))
    assert not book.resolve()


def test_a_foot_that_is_held_confirms_nothing(robot: Robot) -> None:
    book = Labels(robot)
    book.begin()
    for tick in range(1, 12):  # commanded up, not moving up
        book.add(row(tick, lift=False), tick, descending=False)
    assert book.take_lift() is None
    assert not book.resolve()


def test_a_broken_stream_confirms_nothing(robot: Robot) -> None:
    book = Labels(robot)
    swing(book, up=10, down=12)
    book.discard()
    assert not book.resolve()


def rows(n: int, *, lift: bool = True) -> Rows:
    return rows_of([row(tick, lift=lift) for tick in range(n)])


def test_the_buffer_is_bounded_and_counts() -> None:
    buffer = ReplayBuffer(limit=10)
    for n in range(50):
        buffer.add(rows(4, lift=n % 2 == 0), region=0, era=0)
    assert len(buffer.segments) == 10
    assert buffer.counts.lift_ticks + buffer.counts.descent_ticks == 40
    assert buffer.counts.swings == 5


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
        assert buffer.of_era(k // 150) == len(now)


def test_times_of_an_older_source_do_not_compare() -> None:
    """A clock that was set back, and then a rate that is off: only what came since is dropped."""
    buffer = ReplayBuffer(limit=10)
    for n in range(14):
        late = rows_of([row(1_000_000 + n, lift=True)] * 4)
        buffer.add(late, region=0, era=0)
    buffer.new_source()
    for n in range(3):
        buffer.add(rows_of([row(100 * n, lift=True)] * 4), region=0, era=0)
    buffer.drop_since(90 * PERIOD)
    assert len(buffer.segments) == 8
    buffer.drop_since(0)
    assert len(buffer.segments) == 7
    buffer.drop_since(0)
    assert len(buffer.segments) == 7
    assert buffer.counts.lift_ticks == 28


def test_a_monotonous_gait_does_not_push_out_the_rest() -> None:
    buffer = ReplayBuffer(limit=20)
    for region in range(4):
        buffer.add(rows(4), region=region, era=0)
    for _ in range(200):
        buffer.add(rows(4), region=0, era=0)
    kept = {segment.cell[1] for segment in buffer.segments}
    assert kept == {0, 1, 2, 3}


def test_a_large_library_is_given_the_rows_it_needs() -> None:
    buffer = ReplayBuffer(limit=10, rows=100)
    for _ in range(200):
        buffer.add(rows(4), region=0, era=0)
    assert 100 <= sum(len(segment.target) for segment in buffer.segments) <= 104


def test_what_belongs_to_the_leg_before_its_change_goes_first() -> None:
    buffer = ReplayBuffer(limit=10)
    for _ in range(10):
        buffer.add(rows(4), region=0, era=0)
    for _ in range(6):
        buffer.add(rows(4), region=1, era=1)
    assert [s.era for s in buffer.segments].count(1) == 6
    fit, held_out = buffer.factors(2, 1, era=1)
    assert fit.rows + held_out.rows == 24


@pytest.mark.parametrize("n", [0, 1])
def test_an_empty_segment_is_none(n: int) -> None:
    buffer = ReplayBuffer()
    buffer.add(rows(n), region=0, era=0)
    assert len(buffer.segments) == n


def test_a_foot_that_is_kicked_up_does_not_speak_of_the_leg(robot: Robot) -> None:
    """An obstacle hit on the way down throws the foot up again."""
    book = Labels(robot)
    book.begin()
    for tick in range(1, 16):
        level = 300.0 if tick > 13 else 3.0
        book.add(row(tick, lift=True, was_free=True, level=level), tick, descending=tick > 10)
    assert not book.alarm(13 * PERIOD, PERIOD)
    book.add(row(16, lift=False), 16, descending=True)
    assert ticks(book.take_lift()) == list(range(1, 14))
    # An alarm in the lift itself is of the model's making, and closes nothing.
    book.begin()
    for tick in range(1, 11):
        book.add(row(tick, lift=True, was_free=True), tick, descending=False)
    book.alarm(6 * PERIOD, PERIOD)
    book.add(row(11, lift=False), 11, descending=True)
    assert ticks(book.take_lift()) == list(range(1, 11))


def test_a_wild_command_does_not_make_all_places_one_for_good() -> None:
    regions = Regions()
    rng = np.random.default_rng(0)

    def places(swings: int) -> set[int]:
        at = rng.uniform((-0.5, -0.3, 0.8), (0.5, 0.3, 1.4), (swings, 3))
        return {regions.of(command) for command in at.tolist()}

    assert places(60) == set(range(6))
    regions.of([40.0, 0.0, -40.0])
    assert len(places(60)) < 6, "beside that everything is near"
    places(SEGMENTS)
    assert places(60) == set(range(6))


def test_regions_are_parts_of_the_range_of_the_newest_commands() -> None:
    """Against the extremes of all of them, looked for each time."""
    rng = np.random.default_rng(1)
    regions, seen = Regions(), list[np.ndarray]()
    for k in range(1000):
        seen.append(rng.choice([-1.0, 0.0, 0.2, 1.0, 3.0], 2) * (5.0 if k % 97 == 0 else 1.0))
        newest = np.array(seen[-SEGMENTS:])
        least, most = newest.min(axis=0), newest.max(axis=0)
        place = (seen[-1] - least) / np.where(most > least, most - least, np.inf)
        first, last = np.minimum((place * (3, 2)).astype(int), (2, 1))
        assert regions.of(seen[-1].tolist()) == 2 * first + last


def test_rows_wait_in_the_buffer_until_they_are_learned() -> None:
    rng = np.random.default_rng(4)
    buffer, waiting = ReplayBuffer(limit=12, queues=True), list[float]()
    for k in range(300):
        ticks = [row(100 * k + i, lift=True) for i in range(rng.integers(1, 30))]
        buffer.add(rows_of(ticks), region=int(rng.choice(3)), era=0)
        waiting += [float(tick.theta[0]) for tick in ticks]
        while waiting and rng.random() < 0.97:
            at, t_ns = buffer.next_unlearned()
            first = waiting.pop(0)
            assert buffer.values[at, 0] == first, "in order, wherever they have been moved to"
            assert t_ns // PERIOD // 100 == first // 100
        assert buffer.unlearned == len(waiting)
        if k % 40 == 39:  # what is dropped is not learned any more
            since = int(waiting[0] if waiting else 100 * k) // 100 * 100
            buffer.drop_since(since * PERIOD)
            waiting = [at for at in waiting if at < since]
    buffer.drop_unlearned()
    assert buffer.unlearned == 0
    assert len(buffer.segments) > 0


def test_a_lift_that_does_not_end_keeps_its_newest_ticks(robot: Robot) -> None:
    """A leg held up for an hour, or a source that says "swing" for good."""
    book = Labels(robot)
    book.begin()
    for tick in range(1, 10 * MAX_ROWS):
        book.add(row(tick, lift=True, was_free=True), tick, descending=False)
        assert book.place.record["lift_n"] <= MAX_ROWS
    assert book.place.record["commanded_n"] == MAX_ROWS
    book.add(row(10 * MAX_ROWS, lift=False), 10 * MAX_ROWS, descending=True)
    assert ticks(book.take_lift()) == list(range(9 * MAX_ROWS, 10 * MAX_ROWS))


def test_a_buffer_of_very_slow_swings_is_bounded_in_rows() -> None:
    buffer = ReplayBuffer()
    for k in range(60):
        slow = [row(MAX_ROWS * k + i, lift=k % 2 == 0) for i in range(MAX_ROWS)]
        buffer.add(rows_of(slow), k % 3, 0)
        held = buffer.counts.lift_ticks + buffer.counts.descent_ticks
        assert held == MAX_ROWS * min(k + 1, MOST_ROWS // MAX_ROWS)
    again = ReplayBuffer()
    again.restore([s._replace(era=0) for s in buffer.segments * 3])
    assert again.counts.lift_ticks + again.counts.descent_ticks <= MOST_ROWS
    assert {segment.cell for segment in buffer.segments} == {
        (a, b) for a in (0, 1) for b in range(3)
    }
