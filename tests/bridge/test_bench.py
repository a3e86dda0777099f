"""The benchmark's own arithmetic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.bridge.transport import quantiles
from adaptive_contact.wire import Quantiles


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import bench_bridge

    return bench_bridge


def test_quantiles_of_windows_make_those_of_the_run(bench: Any) -> None:
    rng = np.random.default_rng(1)
    windows = [3.0 + rng.exponential(0.3, 500) for _ in range(60)]

    def found() -> tuple[float, float, float]:
        told = [quantiles(list(window)) for window in windows]
        true = float(np.quantile(np.concatenate(windows), 0.99))
        return bench.pooled(told, 0.99), true, max(row.p99 for row in told)

    bound, true, worst = found()
    assert true <= bound <= worst
    assert bound == pytest.approx(true, rel=0.15)
    for k in range(0, 60, 3):  # a third of the windows have 4 % late: 1.3 % of the run
        windows[k][:20] += 20.0
    bound, true, worst = found()
    # The median window's p99, 4.4 ms, would know nothing of it.
    assert 20.0 < true <= bound <= worst


def test_a_bad_moment_is_not_the_run(bench: Any) -> None:
    good, bad = Quantiles(p50=3.0, p90=4.0, p99=5.0, max=6.0), Quantiles(p99=30.0, max=40.0)
    assert bench.pooled([good] * 200 + [bad], 0.99) == 6.0


def test_a_missed_cycle_is_no_success(bench: Any) -> None:
    assert "MISSED" in str(bench.Verdict("x", 1, 0, "cycles"))
    assert "MISSED" not in str(bench.Verdict("x", 0, 0, "cycles"))
