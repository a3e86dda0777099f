"""Recovery after a drift, and which drifts count."""

from __future__ import annotations

import numpy as np

from adaptive_contact.score import (
    Events,
    LegOutcome,
    LegStream,
    SwingTable,
    is_harmful,
    match,
    swings_to_recovery,
    truth_changes,
)
from adaptive_contact.wire import ContactTruth

MS = 1_000_000
SWING_MS = 700  # 30 ticks of swing, 5 of stance


def table(errors: list[int], touched: list[bool] | None = None) -> SwingTable:
    n = len(errors)
    flags = [k % 2 == 0 for k in range(n)] if touched is None else touched
    zeros = np.zeros(n, dtype=np.int64)
    return SwingTable(
        start_ns=np.arange(n, dtype=np.int64) * SWING_MS * MS,
        end_ns=np.arange(n, dtype=np.int64) * SWING_MS * MS + 580 * MS,
        ticks=zeros + 30,
        judged=zeros + 30,
        touches=np.array(flags, dtype=np.int64),
        hits=zeros,
        misses=np.array(errors, dtype=np.int64),
        false_alarms=zeros,
        neutral=zeros,
        judged_after=zeros,
        alarms_after=zeros,
    )


def test_nothing_lost_is_0() -> None:
    assert swings_to_recovery(table([0] * 30), 0) == 0


def test_one_error_is_allowed_two_are_not() -> None:
    assert swings_to_recovery(table([0, 1] + [0] * 30), 0) == 0
    assert swings_to_recovery(table([0, 1, 1] + [0] * 30), 0) == 2  # from the second error on
    assert swings_to_recovery(table([0, 2, *([0] * 30)]), 0) == 2


def test_counts_from_the_first_swing_after_the_drift() -> None:
    errors = [1] * 10 + [0] * 10 + [1] * 4 + [0] * 30
    assert swings_to_recovery(table(errors), 20 * SWING_MS * MS) == 3
    assert swings_to_recovery(table(errors), 20 * SWING_MS * MS - 1) == 3
    assert swings_to_recovery(table(errors), 20 * SWING_MS * MS + 1) == 2


def test_never() -> None:
    assert swings_to_recovery(table([1] * 60), 0) is None
    assert swings_to_recovery(table([0] * 19), 0) is None
    assert swings_to_recovery(table([0] * 30), 20 * SWING_MS * MS) is None


def test_a_stretch_without_contacts_says_nothing() -> None:
    touched = [False] * 30 + [True, False] * 20
    assert swings_to_recovery(table([0] * 70, touched), 0) == 0  # 0..38 hold 5 with contact
    # Blind from the first touch on: thirty swings without one had shown nothing.
    blind = [0] * 30 + [1, 0] * 4 + [0] * 32
    assert swings_to_recovery(table(blind, touched), 0) == 35  # 35..54 hold the last of them
    assert swings_to_recovery(table([0] * 30, [False] * 26 + [True] * 4), 0) is None
    assert swings_to_recovery(table([0] * 40, [True] * 40), 0) is None


def outcome(found: list[bool], alarms: int) -> LegOutcome:
    """Swings with a touch each, found or not, and false alarms in the first ones."""
    n = len(found)
    truth = [ContactTruth(t_ns=0, contact=False, force=0.0)]
    for k in range(n):
        at = (SWING_MS * k + 300) * MS
        truth.append(ContactTruth(t_ns=at, contact=True, force=2.0, speed_m_s=0.4, surface="hard"))
        truth.append(ContactTruth(t_ns=at + 100 * MS, contact=False, force=0.0))
    stream = LegStream(
        "rf",
        np.arange(35 * n, dtype=np.int64) * 20 * MS,
        np.tile(np.arange(35) < 30, n),
        truth_changes(truth),
        np.zeros(35 * n, dtype=bool),
    )
    times = [(SWING_MS * k + 320) * MS for k in range(n) if found[k]]
    times += [(SWING_MS * k + 100) * MS for k in range(alarms)]
    event_ns = np.array(times, dtype=np.int64)
    return match(stream, Events(event_ns, np.ones(len(times), dtype=bool), event_ns))


def test_a_drift_counts_when_recall_is_lost_or_alarms_rise_tenfold() -> None:
    twin = outcome([True] * 100, 2)
    assert not is_harmful([outcome([True] * 96 + [False] * 4, 2)], [twin])
    assert is_harmful([outcome([True] * 95 + [False] * 5, 2)], [twin])
    assert not is_harmful([outcome([True] * 100, 19)], [twin])
    assert is_harmful([outcome([True] * 100, 20)], [twin])
    silent = outcome([True] * 100, 0)
    assert not is_harmful([outcome([True] * 100, 9)], [silent])
    assert is_harmful([outcome([True] * 100, 10)], [silent])
