"""Recovery after a drift, and which drifts count."""

from __future__ import annotations

import numpy as np

from adaptive_contact.score import (
    Events,
    LegOutcome,
    LegStream,
    is_harmful,
    match,
    truth_changes,
)
from adaptive_contact.wire import ContactTruth

MS = 1_000_000
SWING_MS = 700  # 30 ticks of swing, 5 of stance


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
