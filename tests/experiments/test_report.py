"""What the report says of figures, whatever they are."""

from __future__ import annotations

from typing import Any

import pytest

from adaptive_contact_sim.experiments.detection import _rate
from adaptive_contact_sim.experiments.store import plain
from adaptive_contact_sim.experiments.tables import headline


def found(
    recall: float = 0.995,
    touches: int = 2000,
    median: float | None = 15.0,
    p95: float = 30.0,
    alarms: int = 3,
    hours: float = 10.5,
) -> dict[str, Any]:
    row = {
        "recall": recall,
        "touches": touches,
        "interval": [0.99, 1.0],
        "median_ms": median,
        "p95_ms": p95,
    }
    default = {
        "summary": {"rows": {"headline": row}},
        "false_alarms": {"all": _rate(alarms, round(hours * 540_000))},
    }
    tree = {
        "figures": {"default": default},
        "residual_deg": {"stand": {"servo": [0.22, 0.24, 0.23]}},
    }
    return {"detection": plain(tree)}


def verdicts(results: dict[str, Any]) -> list[bool | None]:
    return [line.kept for line in headline(results)]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, [True, True, True, True]),
        ({"recall": 0.98}, [False, True, True, True]),
        # Kept so far, but not on as many as were asked for: no verdict.
        ({"touches": 999}, [None, None, True, True]),
        ({"hours": 9.9}, [True, True, None, True]),
        # Broken is broken, on however few.
        ({"touches": 999, "recall": 0.98, "median": 21.0}, [False, False, True, True]),
        ({"hours": 0.1, "alarms": 1}, [True, True, False, True]),
        ({"p95": 40.1}, [True, False, True, True]),
        ({"alarms": 53}, [True, True, False, True]),
        ({"median": None}, [True, None, True, True]),
    ],
)
def test_verdicts(changed: dict[str, Any], expected: list[bool | None]) -> None:
    assert verdicts(found(**changed)) == expected


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, True),
        ({"speed_up": 19.0}, False),
        ({"difference": 2e-8}, False),
        ({"same_support": False}, False),
        ({"rows": 14_250}, None),
        ({"rows": 14_250, "speed_up": 16.0}, None),
        ({"rows": 14_250, "same_support": False}, False),
    ],
)
def test_the_speed_has_a_verdict_on_5000_segments(
    changed: dict[str, Any], expected: bool | None
) -> None:
    row = {
        "library": "servo",
        "terms": 59,
        "kept": [15, 21, 25],
        "rows": 47_500,
        "speed_up": 40.0,
        "same_support": True,
        "difference": 1e-12,
    } | changed
    assert verdicts({"compression": [row]}) == [expected]


def test_what_was_not_counted_has_no_rate() -> None:
    assert plain(_rate(-1, 540_000)) == {
        "count": -1, "hours": 1.0, "per_hour": None, "interval": [None, None]
    }  # fmt: skip
    assert _rate(0, 0)["per_hour"] is None
