"""Memory over a life: a leak is told from a buffer that fills, and each life has its curve."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("mujoco")

from . import verdict
from .memory import Resident, curves_of, grown, slope_of


def test_memory_is_judged_per_life_after_the_warm_up() -> None:
    rows = [Resident(0, float(s), 100.0 + (20.0 if s > 60 else s / 3)) for s in range(0, 600, 2)]
    rows += [Resident(1, float(s), 100.0 + s / 60) for s in range(0, 600, 2)]
    rows.append(Resident(1, 601.0, float("nan")))
    flat, growing = grown(rows, 60.0, lambda one: one.mb)
    assert flat.growth_mb == 0.0
    assert 6.0 < growing.growth_mb < 9.0


def test_a_child_process_warms_up_from_its_own_start_and_counts() -> None:
    rows = [
        Resident(0, float(s), 100.0, 0.0 if s < 300 else 50.0 + (s - 300) / 10)
        for s in range(0, 600, 2)
    ]
    (growth, last, _), *more = grown(rows, 60.0, lambda one: one.workers_mb)
    assert not more
    assert 15.0 < growth < 25.0
    assert last == pytest.approx(79.8)
    assert grown((), 60.0, lambda one: one.workers_mb) == []


def life(mb: Any, until_s: int = 900) -> list[Resident]:
    """A life whose memory is a function of its age."""
    return [Resident(0, float(at), float(mb(at))) for at in range(0, until_s, 2)]


def test_a_plateau_has_no_slope_and_a_leak_has() -> None:
    rng = np.random.default_rng(4)

    def slope(mb: Any, until_s: int = 900) -> float | None:
        return grown(life(mb, until_s), 180.0, lambda one: one.mb)[0].slope_mb_min

    limit = verdict.SLOPE_MB_MIN
    filling = slope(lambda at: 130.0 - 4.0 * math.exp(-at / 120) + 0.05 * rng.normal())
    assert filling is not None
    assert abs(filling) < 0.3 * limit
    # A buffer that doubles, as measured (+1.3 MB at once), is no leak wherever it falls.
    for step_s in (460, 600, 675, 750, 890):
        step = slope(lambda at, step_s=step_s: 130.0 + 1.3 * (at >= step_s))
        assert step is not None
        assert step < limit
    leak = slope(lambda at: 130.0 + 0.25 * at / 60 + 0.05 * rng.normal())
    assert leak == pytest.approx(0.25, abs=0.02)
    # All of it is within the 5 MB that growth alone may have.
    assert grown(life(lambda at: 130.0 + 0.25 * at / 60), 180.0, lambda o: o.mb)[0].growth_mb < 5
    stairs = slope(lambda at: 130.0 + 0.5 * (at // 120))
    assert stairs is not None
    assert stairs > limit
    assert slope(lambda at: 130.0 + at, until_s=590) is None, "too short to tell"
    assert slope_of([]) is None


def test_a_day_has_a_slope_too() -> None:
    rows = [(float(at), 100.0 + at / 6000) for at in range(0, 43_200, 2)]
    assert slope_of(rows) == pytest.approx(0.01)


def test_the_curve_of_each_life_has_a_point_every_ten_seconds() -> None:
    rows = life(lambda at: 100.0 + at, 40)
    rows += [Resident(1, float(at), 50.0, 30.0) for at in range(0, 20, 2)]
    rows.append(Resident(1, 21.0, float("nan")))
    first, second = curves_of(rows)
    assert [point.after_s for point in first] == [4, 14, 24, 34]
    assert [point.mb for point in first] == [104, 114, 124, 134]
    assert [point.workers_mb for point in second[:2]] == [30, 30]
    assert math.isnan(second[2].mb)
    assert msgspec.json.encode(second[2]).startswith(b"[21.0,null")
    assert curves_of([]) == []
