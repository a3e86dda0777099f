"""What a recording tells of contact holds for the run of the source that told it, and no other."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from adaptive_contact.fit.recordings import LegGatherer
from adaptive_contact.robot import Robot
from adaptive_contact.wire import ContactTruth, ServoSample

from .conftest import PERIOD

Item = ServoSample | ContactTruth


def ticks(first: int, stop: int, *, run: int | None = None) -> list[ServoSample]:
    still = [0.0] * 3
    return [
        ServoSample(t_ns=k * PERIOD, seq=k, measured=still, desired=still, phase="swing", run=run)
        for k in range(first, stop)
    ]


def change(at: float, *, contact: bool) -> ContactTruth:
    return ContactTruth(t_ns=round(at * PERIOD), contact=contact, force=1.0)


def onset(at: float) -> ContactTruth:
    return change(at, contact=True)


def release(at: float) -> ContactTruth:
    return change(at, contact=False)


def gather(robot: Robot, *parts: Item | Iterable[Item]) -> LegGatherer:
    """What has taken messages in their order."""
    gatherer = LegGatherer(robot.leg("rf"), robot.period_s)
    for part in parts:
        for item in [part] if isinstance(part, Item) else part:
            take = gatherer.add_sample if isinstance(item, ServoSample) else gatherer.add_truth
            take(item)
    return gatherer


def pressed(free: np.ndarray) -> list[list[int]]:
    """First and last of all ticks in a row that are not free."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~free, [0]])))
    return (edges.reshape(-1, 2) - [0, 1]).tolist()


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        pytest.param(
            [ticks(0, 150, run=1), onset(148.5), ticks(150, 200, run=1),
             ticks(0, 150, run=2), onset(140.5), ticks(150, 160, run=2), release(152.5),
             ticks(160, 200, run=2)],
            [[[148, 199]], [[140, 155]]],
            id="left out to the end of its run and no further",
        ),
        pytest.param(
            [ticks(0, 50, run=1), onset(45.5), ticks(52, 200, run=1),
             ticks(0, 100, run=2), onset(90.5)],
            [[[45, 49]], [[0, 147]], [[90, 99]]],
            id="outlasts the gaps of its run",
        ),
        pytest.param(
            [ticks(0, 200, run=1), ticks(0, 3, run=2), onset(190.5), release(194.5),
             ticks(3, 150, run=2), onset(140.5), ticks(150, 200, run=2)],
            [[[190, 197]], [[140, 199]]],
            id="truth that comes after a restart is of the run before",
        ),
        *(
            pytest.param(
                [ticks(0, 100, run=began), onset(80.5), release(82.5), ticks(100, 200, run=began),
                 onset(0.5), ticks(0, 22, run=run), release(20.5), ticks(22, 200, run=run)],
                [[[80, 85]], [[0, 23 - lost]]],
                id=f"truth that comes before a restart is of the run after, {run}",
            )
            # Without run, the restart shows only in the tenth sample: nine are refused.
            for began, run, lost in ((1, 2, 0), (None, None, 9))
        ),
        pytest.param(
            [ticks(0, 200, run=1), ticks(230, 240, run=2), onset(180.5), onset(235.5),
             ticks(240, 400, run=2), release(390.5)],
            [[[180, 199]], [[5, 163]]],
            id="times tell runs apart that count on one clock",
        ),
        pytest.param(
            # What a recorder that joined late was told first, and what was written at the end.
            [onset(-1000.0), ticks(1000, 1400), release(1010.5), onset(1200.5), release(1210.5)],
            [[[0, 13], [200, 213]]],
            id="one run owns all truth whenever it comes",
        ),
        pytest.param(
            # Of a run that reports no touch the ends of swings are left out, as they may be one.
            # Of a gap of 200 the first two samples after it only show that it is one.
            [ticks(0, 200, run=1), ticks(0, 100, run=2), onset(150.5), release(160.5),
             onset(295.5), ticks(300, 400, run=2), release(310.5), ticks(400, 500, run=2),
             ticks(0, 200, run=3), onset(190.5)],
            [[[0, 4], [194, 199]], [], [[0, 11]], [[190, 199]]],
            id="taken while no samples come",
        ),
    ],
)  # fmt: skip
def test_a_contact_is_of_the_run_that_told_it(
    robot: Robot, parts: list[Item | list[Item]], expected: list[list[list[int]]]
) -> None:
    found = gather(robot, *parts).stretches()
    assert [pressed(stretch.free) for stretch in found] == expected


def test_a_run_without_a_word_of_truth_is_not_known_to_be_free(robot: Robot) -> None:
    for heard, certain in ((), [False, True]), ((onset(50.5),), [True, True]):
        both = gather(robot, ticks(0, 60, run=1), heard, ticks(0, 200, run=2), onset(199.5))
        assert [stretch.certain for stretch in both.stretches()] == certain
        assert [stretch.certain for stretch in both.stretches(free=True)] == [True, True]


def test_a_tick_that_comes_late_ends_a_stretch_and_a_stamp_that_is_wrong_none(robot: Robot) -> None:
    """After a late tick all are late; after a wrong stamp the next ones return to the schedule."""
    rng = np.random.default_rng(0)
    late = [PERIOD if k >= 40 else 0 for k in range(100)]
    wrong = [PERIOD - 1 if k % 10 == 5 else round(rng.uniform(0, 0.2 * PERIOD)) for k in range(100)]
    for by_ns, lengths in (([0] * 100, [100]), (late, [40, 60]), (wrong, [100])):
        stream = [
            msgspec.structs.replace(s, t_ns=s.t_ns + by)
            for s, by in zip(ticks(0, 100), by_ns, strict=True)
        ]
        assert [len(stretch.free) for stretch in gather(robot, stream).stretches()] == lengths
