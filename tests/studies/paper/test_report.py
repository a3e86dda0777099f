"""What the report says of figures, whatever they are."""

from __future__ import annotations

from typing import Any

import pytest

from adaptive_contact_studies.cache import plain
from adaptive_contact_studies.paper.detection import rate_of
from adaptive_contact_studies.paper.identification import (
    SINGULAR,
    shown_condition,
    sparsest_of,
)
from adaptive_contact_studies.paper.tables import part
from adaptive_contact_studies.paper.verdicts import headline
from adaptive_contact_studies.show.numbers import per_joint


def found(
    recall: float = 0.995,
    touches: int = 2000,
    median: float | None = 15.0,
    p95: float = 30.0,
    alarms: int = 3,
    hours: float = 10.5,
    worst: tuple[float, ...] = (0.23, 0.25, 0.23),
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
        "false_alarms": {"all": rate_of(alarms, round(hours * 540_000))},
    }
    tree = {
        "figures": {"default": default},
        "residual_deg": {"stand": {"servo": [0.22, 0.24, 0.23]}},
        "worst_leg_run": {"stand": {"servo": {"leg_run": "2-lm", "rms_deg": worst}}},
    }
    return {"detection": plain(tree)}


def verdicts(results: dict[str, Any]) -> list[bool | None]:
    return [line.kept for line in headline(results)]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, [True, True, True, True, True]),
        ({"recall": 0.98}, [False, True, True, True, True]),
        # Kept so far, but not on as many as were asked for: no verdict.
        ({"touches": 999}, [None, None, True, True, True]),
        ({"hours": 9.9}, [True, True, None, True, True]),
        # Broken is broken, on however few.
        ({"touches": 999, "recall": 0.98, "median": 21.0}, [False, False, True, True, True]),
        ({"hours": 0.1, "alarms": 1}, [True, True, False, True, True]),
        ({"p95": 40.1}, [True, False, True, True, True]),
        ({"alarms": 53}, [True, True, False, True, True]),
        ({"median": None}, [True, None, True, True, True]),
        # All leg-runs pooled hide one that is worse.
        ({"worst": (0.23, 0.26, 0.23)}, [True, True, True, True, False]),
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
    assert plain(rate_of(-1, 540_000)) == {
        "count": -1, "hours": 1.0, "per_hour": None, "interval": [None, None]
    }  # fmt: skip
    assert rate_of(0, 0)["per_hour"] is None


def test_the_residual_is_labelled_as_what_it_is() -> None:
    pooled, worst = headline(found())[3:]
    assert "models as fitted" in pooled.what
    assert "all leg-runs pooled" in pooled.what
    assert "the worst leg-run (2-lm)" in worst.what
    assert worst.measured == "1.36 1.48 1.36 ×"


def test_no_alarm_in_few_hours_only_bounds_the_rate() -> None:
    alarms = {"free": rate_of(10, 540_000 * 10), "stand": rate_of(0, 324_000)}
    told = part("free", {"figures": {"default": {"false_alarms": plain(alarms)}}})
    assert "10 and 0 false alarms" in told
    # 95 % of nothing seen: 3.69 over 0.6 h.
    assert "None in 0.60 h standing only bounds the rate: up to 6.1 per robot-hour" in told
    assert "hung up only bounds" not in told


def test_what_has_no_model_and_what_is_singular_are_no_dashes() -> None:
    assert per_joint([1.234, SINGULAR, None], 1) == "1.2 infinite (singular) -"
    assert shown_condition(float("inf")) == SINGULAR
    assert shown_condition(12.0) == 12.0


def test_every_joint_has_a_say_in_the_sparsest_model() -> None:
    """A mean would pick 0.3: the first joint gains there what the second loses."""
    points = [
        {"status": "ok", "lambda": 0.1, "held_out_rms": [0.200, 0.200]},
        {"status": "ok", "lambda": 0.3, "held_out_rms": [0.198, 0.203]},
        {"status": "ok", "lambda": 1.0, "held_out_rms": [0.300, 0.300]},
    ]
    assert sparsest_of(points[:1] + points[2:]) == 0.1
    assert sparsest_of([]) is None
    # Their best lie apart: the smallest.
    assert sparsest_of(points) == 0.1
    near = [
        *points[:1],
        {"status": "ok", "lambda": 0.3, "held_out_rms": [0.2005, 0.2009]},
        points[2],
    ]
    assert sparsest_of(near) == 0.3
