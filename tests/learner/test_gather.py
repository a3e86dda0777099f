"""What a recording tells of contact holds for the run of the source that told it, and no other."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from itertools import islice

import msgspec
import numpy as np
import pytest

from adaptive_contact.fit.recordings import AFTER_TICKS, LegGatherer
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactTruth, ServoSample

from .conftest import PERIOD, FakeLeg, samples

Item = ServoSample | ContactTruth


def ticks(first: int, stop: int, *, run: int | None = None) -> Iterator[ServoSample]:
    for k in range(first, stop):
        yield ServoSample(
            t_ns=k * PERIOD, seq=k, measured=[0.0] * 3, desired=[0.0] * 3, phase="swing", run=run
        )


def change(at: float, *, contact: bool) -> ContactTruth:
    return ContactTruth(t_ns=round(at * PERIOD), contact=contact, force=1.0)


def onset(at: float) -> ContactTruth:
    return change(at, contact=True)


def release(at: float) -> ContactTruth:
    return change(at, contact=False)


@pytest.fixture
def gather(robot: Robot) -> Callable[..., list[np.ndarray]]:
    """Which ticks of every stretch are free, of messages in their order."""

    def free(*parts: Item | Iterable[Item]) -> list[np.ndarray]:
        gatherer = LegGatherer(robot.leg("rf"), robot.period_s)
        for part in parts:
            for item in [part] if isinstance(part, Item) else part:
                if isinstance(item, ServoSample):
                    gatherer.take_sample(item)
                else:
                    gatherer.take_truth(item)
        return [stretch.free for stretch in gatherer.stretches()]

    return free


def pressed(free: np.ndarray) -> list[int]:
    """First and last tick that is not free."""
    (at,) = np.nonzero(~free)
    assert len(at) == at[-1] - at[0] + 1
    return [int(at[0]), int(at[-1])]


@pytest.mark.parametrize("touched_at_the_end", [None, 12])
def test_a_run_that_ends_in_contact_hides_no_touch_of_the_next(
    robot: Robot, touched_at_the_end: int | None
) -> None:
    gatherer = LegGatherer(robot.leg("rf"), robot.period_s)
    runs: list[np.ndarray] = []

    def touch(run: int, swing: int) -> int | None:
        if run == 1:
            return touched_at_the_end if swing == 19 else None
        return 3 if swing == 5 else None

    for run in (1, 2):
        fake = FakeLeg(seed=run).run(20, touch=lambda swing, run=run: touch(run, swing))  # type: ignore[misc]
        stream = samples(*fake[:3])
        touching = fake[3] & (np.arange(len(stream)) % 28 < 24)
        if run == 1:  # without the stance that would end the contact
            stream, touching = stream[:-6], touching[:-6]
        before = False
        for sample, now in zip(stream, touching.tolist(), strict=True):
            if now != before:
                gatherer.take_truth(
                    ContactTruth(t_ns=sample.t_ns - PERIOD // 2, contact=now, force=1.0)
                )
                before = now
            gatherer.take_sample(msgspec.structs.replace(sample, run=run))
        runs.append(touching)
    found = gatherer.stretches()
    assert [len(stretch.free) for stretch in found] == [len(touching) for touching in runs]
    for stretch, touching in zip(found, runs, strict=True):
        assert not np.any(stretch.free & touching)
    # Where a run told of a touch, it told of all.
    assert [stretch.certain for stretch in found] == [touched_at_the_end is not None, True]
    assert np.count_nonzero(~found[1].free) <= runs[1].sum() + AFTER_TICKS + 2


def test_a_contact_is_left_out_to_the_end_of_its_run_and_no_further(
    gather: Callable[..., list[np.ndarray]],
) -> None:
    first, second = gather(
        ticks(0, 150, run=1), onset(148.5), ticks(150, 200, run=1),
        ticks(0, 150, run=2), onset(140.5), ticks(150, 160, run=2), release(152.5),
        ticks(160, 200, run=2),
    )  # fmt: skip
    assert pressed(first) == [148, 199]
    assert pressed(second) == [140, 155]


def test_a_contact_outlasts_the_gaps_of_its_run(gather: Callable[..., list[np.ndarray]]) -> None:
    found = gather(
        ticks(0, 50, run=1), onset(45.5), ticks(52, 200, run=1),
        ticks(0, 100, run=2), onset(90.5),
    )  # fmt: skip
    assert [pressed(free) for free in found] == [[45, 49], [0, 147], [90, 99]]


def test_truth_that_comes_after_a_restart_belongs_to_the_run_before(
    gather: Callable[..., list[np.ndarray]],
) -> None:
    first, second = gather(
        ticks(0, 200, run=1), ticks(0, 3, run=2), onset(190.5), release(194.5),
        ticks(3, 150, run=2), onset(140.5), ticks(150, 200, run=2),
    )  # fmt: skip
    assert pressed(first) == [190, 197]
    assert pressed(second) == [140, 199]


@pytest.mark.parametrize("run", [2, None])
def test_truth_that_comes_before_a_restart_belongs_to_the_run_after(
    gather: Callable[..., list[np.ndarray]], run: int | None
) -> None:
    """Without ``run``, the restart shows only in the tenth sample: nine are refused."""
    began = None if run is None else 1
    lost = 9 if run is None else 0
    heard = iter(ticks(0, 200, run=run))
    first, second = gather(
        ticks(0, 100, run=began), onset(80.5), release(82.5), ticks(100, 200, run=began),
        onset(0.5), islice(heard, 22), release(20.5), heard,
    )  # fmt: skip
    assert pressed(first) == [80, 85]
    assert pressed(second) == [0, 23 - lost]


def test_times_tell_runs_apart_that_count_on_one_clock(
    gather: Callable[..., list[np.ndarray]],
) -> None:
    first, second = gather(
        ticks(0, 200, run=1), ticks(230, 240, run=2), onset(180.5), onset(235.5),
        ticks(240, 400, run=2), release(390.5),
    )  # fmt: skip
    assert pressed(first) == [180, 199]
    assert pressed(second) == [5, 163]


def test_what_may_be_of_either_run_frees_nothing(
    gather: Callable[..., list[np.ndarray]],
) -> None:
    # Both began at 0: the release may be that of either, and neither has another one.
    first, second = gather(
        ticks(0, 5, run=1), onset(4.5), ticks(5, 20, run=1),
        ticks(0, 6, run=2), onset(5.5), ticks(6, 10, run=2), release(8.5),
        ticks(10, 100, run=2), onset(90.5),
    )  # fmt: skip
    assert not first[4:].any()
    assert not second[5:].any()


def test_a_run_without_a_word_of_truth_is_not_known_to_be_free(robot: Robot) -> None:
    for heard, certain in (((), [False, True]), ((onset(50.5),), [True, True])):
        gatherer = LegGatherer(robot.leg("rf"), robot.period_s)
        for sample in ticks(0, 60, run=1):
            gatherer.take_sample(sample)
        for truth in heard:
            gatherer.take_truth(truth)
        for sample in ticks(0, 200, run=2):
            gatherer.take_sample(sample)
        gatherer.take_truth(onset(199.5))
        assert [stretch.certain for stretch in gatherer.stretches()] == certain
        assert [stretch.certain for stretch in gatherer.stretches(free=True)] == [True, True]


def test_one_run_owns_all_truth_whenever_it_comes(
    gather: Callable[..., list[np.ndarray]],
) -> None:
    # What a recorder that joined late was told first, and what was written after all samples.
    (free,) = gather(
        onset(-1000.0), ticks(1000, 1400), release(1010.5), onset(1200.5), release(1210.5)
    )
    assert np.nonzero(~free)[0].tolist() == [*range(14), *range(200, 214)]


def test_truth_is_taken_while_no_samples_come(gather: Callable[..., list[np.ndarray]]) -> None:
    found = gather(
        ticks(0, 200, run=1), ticks(0, 100, run=2), onset(150.5), release(160.5), onset(295.5),
        ticks(300, 400, run=2), release(310.5), ticks(400, 500, run=2),
        ticks(0, 200, run=3), onset(190.5),
    )  # fmt: skip
    # (Of a gap of 200 the first two samples after it only show that it is one.)
    assert [pressed(free) for free in found[2:]] == [[0, 11], [190, 199]]
    assert found[1].all()


def test_a_tick_that_comes_late_ends_a_stretch(gather: Callable[..., list[np.ndarray]]) -> None:
    # Its readings are two periods apart, however they are numbered.
    def late() -> Iterator[ServoSample]:
        for sample in ticks(0, 100):
            after = PERIOD if sample.seq >= 40 else 0
            yield msgspec.structs.replace(sample, t_ns=sample.t_ns + after)

    assert [len(free) for free in gather(ticks(0, 100))] == [100]
    assert [len(free) for free in gather(late())] == [40, 60]


def test_a_stamp_that_is_wrong_ends_none(gather: Callable[..., list[np.ndarray]]) -> None:
    """The next ones return to the schedule: one in ten is a period late, the others jitter."""
    rng = np.random.default_rng(0)
    by = [PERIOD if k % 10 == 5 else round(rng.uniform(0, 0.2 * PERIOD)) for k in range(100)]
    wrong = [msgspec.structs.replace(s, t_ns=s.t_ns + by[k]) for k, s in enumerate(ticks(0, 100))]
    for before, after in itertools.pairwise(range(100)):  # strictly increasing
        if wrong[after].t_ns <= wrong[before].t_ns:
            later = wrong[before].t_ns + 1
            wrong[after] = msgspec.structs.replace(wrong[after], t_ns=later)
    assert [len(free) for free in gather(wrong)] == [100]
