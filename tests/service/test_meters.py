from __future__ import annotations

from adaptive_contact.service.logs import LogThrottle
from adaptive_contact.status import Latency


def test_quantiles_of_known_values() -> None:
    latency = Latency()
    for ms in range(1, 102):
        latency.add(ms * 1_000_000)
    found = latency.quantiles()
    assert (found.p50, found.p99, found.max, found.count) == (51.0, 100.0, 101.0, 101)


def test_a_throttle_lets_one_line_per_period_through_and_counts_the_rest() -> None:
    throttle = LogThrottle(period_s=10.0)
    assert throttle.passes("a", 0) == 1
    assert throttle.passes("a", 1_000_000_000, times=5) is None
    assert throttle.passes("b", 1_000_000_000) == 1
    assert throttle.passes("a", 9_999_999_999) is None
    assert throttle.passes("a", 10_000_000_000, times=2) == 8
    # It forgets rather than grows.
    for kind in range(10_000):
        assert throttle.passes(kind, kind) == 1
    assert throttle.passes(9_999, 10_000) is None
    assert throttle.passes(9_999 - 256, 10_000) == 1, "forgotten: it passes within its period"
