"""The stream guard sorts samples into the next one, a restart, and the rejected."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.core.detect.stream import (
    CONFIRM_SAMPLES,
    LONGEST_GAP,
    NOTED_SAMPLES,
    RESET_SAMPLES,
    SHORT_GAP,
    SHORT_RUN_SAMPLES,
    TAKE_BACK_SAMPLES,
    Accepted,
    StreamGuard,
)
from adaptive_contact.wire import Reject, ServoSample
from stepping import STEP, sample


def feed(guard: StreamGuard, *stream: ServoSample) -> list[Accepted | Reject]:
    return [guard.admit(s) for s in stream]


@pytest.mark.parametrize(("wraps_at", "rounds"), [(2**8, 1), (2**16, 1), (2**32, 1), (100, 2)])
def test_a_counter_of_few_bits_is_named(wraps_at: int, rounds: int) -> None:
    guard = StreamGuard(2)
    first, told = wraps_at - 60, rounds * wraps_at + RESET_SAMPLES - 1
    feed(guard, *(sample(k, seq=k % wraps_at) for k in range(first, told)))
    assert guard.note is None
    feed(guard, sample(told, seq=told % wraps_at))
    assert (guard.note or "").startswith(f"seq wraps at {wraps_at}: ")
    # A source that starts again without a new `run` counts from anywhere.
    feed(guard, *(sample(10**6 + k, t0=10**12) for k in range(NOTED_SAMPLES + 9)))
    feed(guard, *(sample(k, t0=10**15) for k in range(RESET_SAMPLES)))
    assert guard.note is None


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"measured": [0.1]}, Reject.WRONG_JOINTS),
        ({"desired": [0.1] * 3}, Reject.WRONG_JOINTS),
        ({"preview": [[0.1]]}, Reject.WRONG_JOINTS),
        ({"valid": [True]}, Reject.WRONG_JOINTS),
        ({"measured": [math.nan, 0]}, Reject.NOT_FINITE),
        ({"desired": [0, -math.inf]}, Reject.NOT_FINITE),
        ({"preview": [[0, math.nan]]}, Reject.NOT_FINITE),
        ({"measured": [1e9, 0]}, Reject.OUT_OF_RANGE),
        ({"t_ns": -1}, Reject.OUT_OF_RANGE),
        ({"t_ns": 2**63}, Reject.OUT_OF_RANGE),
        ({"seq": -1}, Reject.OUT_OF_RANGE),
        ({"seq": 2**62}, Reject.OUT_OF_RANGE),
        ({"seq": 2 + LONGEST_GAP + 2}, Reject.OUT_OF_RANGE),
        ({"run": 2**63}, Reject.OUT_OF_RANGE),
        ({"run": -(2**70)}, Reject.OUT_OF_RANGE),
        ({"t_ns": 2 * STEP}, Reject.TIME_BACKWARDS),
        ({"t_ns": 0}, Reject.TIME_BACKWARDS),
        ({"seq": 2}, Reject.DUPLICATE_SEQ),
        ({"seq": 1}, Reject.DUPLICATE_SEQ),
    ],
)
def test_a_bad_sample_is_refused_and_changes_nothing(
    change: dict[str, object], reason: Reject
) -> None:
    guard = StreamGuard(2)
    feed(guard, *(sample(k) for k in range(3)))
    assert guard.admit(sample(3, **change)) is reason
    assert guard.admit(sample(3)) == Accepted(0, False)
    assert guard.missed == 0


@pytest.mark.parametrize("times", [1, 26, 100])
def test_a_superseded_publisher_that_floods_takes_nothing_back(times: int) -> None:
    """More samples than are needed for it between two of the newer one."""
    guard = StreamGuard(2)
    feed(guard, sample(0, run=7), sample(0, run=3))
    step = STEP // times
    for k in range(1, 60):
        flood = (sample(k * times + i, run=7, t_ns=k * STEP + i * step) for i in range(times))
        assert set(feed(guard, *flood)) == {Reject.OTHER_PUBLISHER}
        assert guard.admit(sample(k, run=3)) == Accepted(0, False)
    alone = feed(
        guard,
        *(sample(60 * times + i, run=7, t_ns=60 * STEP + i * step) for i in range(30 * times)),
    )
    assert alone.count(Accepted(0, True)) == 1
    assert alone[-1] == Accepted(0, False)


def test_a_source_that_is_restarted_now_and_then_is_not() -> None:
    guard = StreamGuard(2)
    for k in range(10 * SHORT_RUN_SAMPLES):
        guard.admit(sample(k, run=k // SHORT_RUN_SAMPLES))
        assert guard.note is None


@pytest.mark.parametrize(
    ("before", "after", "refused"),
    [
        (
            [sample(0), sample(1, t_ns=2**62)],
            [sample(k) for k in range(2, 40)],
            Reject.TIME_BACKWARDS,
        ),
        (
            [sample(k, run=None) for k in range(5)],
            [sample(k, run=None, seq=2**40 + k) for k in range(5, 30)],
            Reject.OUT_OF_RANGE,
        ),
    ],
    ids=["one wild time stamp", "counts on from far ahead"],
)
def test_what_does_not_go_on_from_the_last_sample_is_a_restart_soon_and_no_loss(
    before: list[ServoSample], after: list[ServoSample], refused: Reject
) -> None:
    guard = StreamGuard(2)
    feed(guard, *before)
    results = feed(guard, *after)
    assert results[: RESET_SAMPLES - 1] == [refused] * (RESET_SAMPLES - 1)
    assert results[RESET_SAMPLES - 1] == Accepted(0, True)
    assert results[-1] == Accepted(0, False)
    assert guard.missed == 0


@pytest.mark.parametrize("jump", [SHORT_GAP + 2, 1000, 9_000_000])
@pytest.mark.parametrize("run", [None, 1])
@pytest.mark.parametrize("ends_at", [1, 60 * 50])  # without the source, or beside it
def test_a_jump_that_no_sample_follows_costs_and_counts_nothing(
    jump: int, run: int | None, ends_at: int
) -> None:
    """One a second, each further ahead, between those of a source at 50 Hz."""
    guard = StreamGuard(2)
    for k in range(60 * 50):
        assert k >= ends_at or guard.admit(sample(k, run=run)) == Accepted(0, k == 0)
        if k % 50 == 25:
            far = k + (k // 50 + 1) * jump
            wild = guard.admit(sample(k, run=run, t_ns=k * STEP + 1, seq=far))
            ahead = far - min(k, ends_at - 1)
            assert wild is (Reject.OUT_OF_RANGE if ahead > LONGEST_GAP else Reject.SEQ_JUMP)
    assert (guard.missed, guard.restarts) == (0, 0)


def test_jumps_that_samples_follow_are_taken_back_when_the_source_goes_on() -> None:
    """Three samples in a row are a stream; that it was somebody else's shows afterwards."""
    guard = StreamGuard(2)
    used = 0
    for k in range(50 * 50):
        used += isinstance(guard.admit(sample(k)), Accepted)
        if k % 50 == 25:
            far = [
                sample(k, t_ns=k * STEP + 1 + i, seq=k + 9_000_000 + i)
                for i in range(CONFIRM_SAMPLES)
            ]
            assert isinstance(feed(guard, *far)[-1], Accepted)
    # Of each, one sample was used, and those of the source until it was believed again were not.
    assert guard.missed == 50 * (RESET_SAMPLES - 1)
    assert used + guard.missed == 50 * 50
    assert guard.restarts == 0


@pytest.mark.parametrize("gap", [SHORT_GAP + 1, 180_000, 4 * 3600 * 100, LONGEST_GAP - 25])
@pytest.mark.parametrize("step", [1, 7])
def test_a_long_gap_is_counted_once_three_samples_show_it(gap: int, step: int) -> None:
    """A link that was away for hours: all is counted, also what is lost after the gap."""
    guard = StreamGuard(2)
    feed(guard, *(sample(k) for k in range(10)))
    results = feed(guard, *(sample(9 + gap + step * k) for k in range(1, 30)))
    missed = gap + step * CONFIRM_SAMPLES - 1
    assert results[: CONFIRM_SAMPLES - 1] == [Reject.SEQ_JUMP] * (CONFIRM_SAMPLES - 1)
    assert results[CONFIRM_SAMPLES - 1] == Accepted(missed, False)
    assert results[CONFIRM_SAMPLES:] == [Accepted(step - 1, False)] * (29 - CONFIRM_SAMPLES)
    assert guard.missed == missed + (step - 1) * (29 - CONFIRM_SAMPLES)
    assert guard.restarts == 0


@pytest.mark.parametrize("burst", [1, CONFIRM_SAMPLES])
@pytest.mark.parametrize("every", [5, 20, 50])
def test_new_runs_that_do_not_last_blind_a_leg_for_a_moment_only(burst: int, every: int) -> None:
    """Somebody who may write the key makes up a run every 0.1 s, 0.4 s or 1 s, for two minutes."""
    guard = StreamGuard(2)
    refused = []
    for k in range(120 * 50):
        if isinstance(guard.admit(sample(k, run=1)), Reject):
            refused.append(k)
        if k % every == 3 and k > 200:
            feed(guard, *(sample(i, run=1000 + k) for i in range(burst)))
            if len(refused) > 3 * TAKE_BACK_SAMPLES:
                assert "new runs came and did not last" in str(guard.note)
    # One run is believed until it shows that it does not last; one more in each settled minute.
    assert len(refused) <= 5 * TAKE_BACK_SAMPLES
    assert refused[0] == 203 + (every - 203 % every + 3) % every + 1
    # Afterwards the leg is as before, and a real restart is believed.
    rest = feed(guard, *(sample(k, run=1) for k in range(6000, 6100)))
    assert rest[50:] == [Accepted(0, False)] * 50
    restart = feed(guard, *(sample(k, run=2) for k in range(100)))
    assert restart[48 + 1 :] == [Accepted(0, False)] * (100 - 49)


def test_of_two_publishers_without_runs_the_one_that_stays_is_heard() -> None:
    """Same clock, other numbers: while both speak the higher numbers hold, then the one left."""
    guard = StreamGuard(2)
    for k in range(1, 200):
        assert isinstance(guard.admit(sample(k, run=None, seq=5000 + k)), Accepted)
        assert guard.admit(sample(k, run=None, t0=5, seq=k)) is Reject.DUPLICATE_SEQ
    left = feed(guard, *(sample(k, run=None, t0=5) for k in range(200, 230)))
    assert left.index(Accepted(0, True)) < RESET_SAMPLES
    assert left[-1] == Accepted(0, False)


@given(
    st.lists(
        st.builds(
            sample,
            st.integers(0, 60),
            run=st.sampled_from([None, 1, 2]),
            t0=st.integers(-STEP, 3 * STEP),
            measured=st.lists(st.floats(), min_size=1, max_size=3),
        ),
        max_size=60,
    )
)
def test_accepted_samples_are_in_order_whatever_comes(stream: list[ServoSample]) -> None:
    guard = StreamGuard(2)
    last: ServoSample | None = None
    for s in stream:
        result = guard.admit(s)
        if isinstance(result, Reject):
            continue
        assert len(s.measured) == 2
        assert all(map(math.isfinite, s.measured))
        if not result.restart:
            assert s.t_ns > last.t_ns
            assert s.seq == last.seq + 1 + result.missed
            assert s.run == last.run
        last = s


@pytest.mark.parametrize("runs", [(None, None), (7, 7), (7, 9), (None, 7), (7, None)])
@pytest.mark.parametrize("manner", ["ticks", "bursts", "fast", "slow"])
@pytest.mark.parametrize("ahead", [3, 10**15])
def test_two_publishers_are_named_within_a_second_and_until_one_ends(
    runs: tuple[int | None, int | None], manner: str, ahead: int
) -> None:
    """Ahead is by how much the second one's clock is, ns: the same to a few, or another."""
    every = {"fast": STEP // 20, "slow": 10 * STEP}.get(manner, STEP)
    burst = 15 if manner == "bursts" else 1  # samples that come at once
    sent = []
    for run, step, first_ns in ((runs[0], STEP, 0), (runs[1], every, ahead)):
        first = 7000 if first_ns > 3 else 500
        for k in range(200 * STEP // step):
            made = sample(first + k, run=run, t_ns=first_ns + k * step)
            sent.append((k // burst * burst * step, made))
    guard, at = StreamGuard(2), 0
    for at, made in sorted(sent, key=lambda pair: pair[0]):  # noqa: B007
        guard.admit(made)
        if guard.contested:
            break
    assert guard.contested
    assert at <= 50 * STEP
    assert all(("without run" if run is None else f"run {run}") in str(guard.note) for run in runs)
    alone = [sample(10_000 + k, run=guard.run, t_ns=10**17 + k * STEP) for k in range(100)]
    feed(guard, *alone)
    assert not guard.contested
    assert guard.note is None or "two programs" not in guard.note


@pytest.mark.parametrize("delay", [1, 3, 40])
@pytest.mark.parametrize("copies", [True, False])
def test_copies_and_samples_out_of_order_are_no_second_publisher(delay: int, copies: bool) -> None:
    guard = StreamGuard(2)
    feed(guard, *(sample(k) for k in range(50, 100)))
    for k in range(100, 400):
        if copies or k % 5:
            guard.admit(sample(k))
        if copies or k % 5 == delay % 5:
            guard.admit(sample(k - delay))
        assert not guard.contested
