"""Lock-outs, valid after how many swings, quantiles, goals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from adaptive_contact.score import SwingTable
from adaptive_contact_studies.scenarios.judge import (
    SETTLED,
    longest_lock_out,
    quantile,
    swings_until_valid,
)
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.replay import STATUSES, SwingLog
from adaptive_contact_studies.scenarios.results import goals, pooled


def swings(story: str) -> SwingTable:
    """One letter per swing: h(it), m(iss), f(alse alarm), . (nothing)."""
    n = len(story)
    touched = np.array([c in "hm" for c in story], dtype=np.int64)
    return SwingTable(
        start_ns=np.arange(n) * 1_000_000_000,
        end_ns=np.arange(n) * 1_000_000_000 + 500_000_000,
        ticks=np.full(n, 20),
        judged=np.full(n, 20),
        touches=touched,
        hits=np.array([c == "h" for c in story], dtype=np.int64),
        misses=np.array([c == "m" for c in story], dtype=np.int64),
        false_alarms=np.array([c == "f" for c in story], dtype=np.int64),
        neutral=np.zeros(n, dtype=np.int64),
        judged_after=np.zeros(n, dtype=np.int64),
        alarms_after=np.zeros(n, dtype=np.int64),
    )


@pytest.mark.parametrize(
    ("story", "longest"),
    [
        ("", 0),
        ("h.h.h.", 0),
        ("h.m.h", 1),
        ("hffffh", 4),
        ("m..m...m.h", 3),  # blind: free swings prove nothing
        ("m.f.m..f", 4),
        ("fhf", 1),
    ],
)
def test_lock_outs(story: str, longest: int) -> None:
    assert longest_lock_out(swings(story)) == longest


def log(*statuses: str) -> SwingLog:
    n = len(statuses)
    status = np.array([STATUSES.index(s) for s in statuses], dtype=np.int64)  # type: ignore[arg-type]
    rest = {name: np.zeros(n) for name in SwingLog._fields}
    return SwingLog(**(rest | {"status": status, "t_ns": 10 * (np.arange(n) + 1)}))


@pytest.mark.parametrize(
    ("story", "expected"),
    [
        ("", (None, None)),
        ("v" * SETTLED, (0, 0)),
        ("v" * (SETTLED - 1), (None, None)),
        ("ll" + "v" * SETTLED, (3, 30)),
        ("l" * 100, (None, None)),
        ("v" * 19 + "aa" + "v" * SETTLED, (22, 220)),  # it was not at an end
        ("v" * SETTLED + "a" + "v" * 5, (0, 0)),  # a doubt that came later is another
        (("v" * 19 + "m") * 10, (None, None)),
    ],
)
def test_swings_until_valid(story: str, expected: tuple[int | None, int | None]) -> None:
    names = {"v": "valid", "l": "learning", "a": "adapting", "m": "ambiguous"}
    assert swings_until_valid(log(*(names[letter] for letter in story))) == expected


def test_a_quantile_of_those_that_never_came() -> None:
    assert quantile([3, 1, 2], 0.5) == 2.0
    assert quantile([1, None, None], 0.5) is None
    assert quantile([1, 1, None], 0.5) == 1.0
    assert quantile([0] * 19 + [None], 0.95) == 0.0
    assert quantile([0] * 18 + [None, None], 0.95) is None
    assert quantile([], 0.5) is None


def tree(**changes: Any) -> dict[str, Any]:
    recovery = {"swings_median": 3.0, "swings_p95": 8.0, "alarms_median": 1.0}
    full = {
        "recovery": {"step": recovery},
        "recall_lost_points": 0.2,
        "harmful": False,
        "touching_share": 0.0002,
        "longest_lock_out": 2,
        "caught_swings": 0,
        "caught_told": 0,
    }
    counts = changes.pop("counts", True)
    return {"counts_as_one_to_recover_from": counts, "variants": {"full": full | changes}}


def test_goals_of_a_step_that_counts() -> None:
    made = goals(scenarios()["step-friction4"], tree())
    assert [g.limit for g in made] == [10.0, 20.0, 2.0, 1.0, 0.0]
    assert all(g.tree["met"] for g in made)
    never = {"swings_median": None, "swings_p95": None, "alarms_median": 90.0}
    worse = tree(recovery={"step": never}, recall_lost_points=1.5, harmful=True)
    assert not any(g.tree["met"] for g in goals(scenarios()["step-friction4"], worse))


def test_a_caught_foot_is_to_be_told() -> None:
    made = goals(scenarios()["caught-30s"], tree(caught_swings=100, caught_told=80))
    assert (made[-1].limit, made[-1].measured, made[-1].tree["met"]) == (
        0.1,
        pytest.approx(0.2),
        False,
    )
    made = goals(scenarios()["caught-30s"], tree(caught_swings=100, caught_told=95))
    assert made[-1].tree["met"]


def test_goals_of_a_step_that_does_not() -> None:
    made = goals(scenarios()["step-mass50"], tree(counts=False, harmful=True))
    assert [g.tree["met"] for g in made] == [True, False]


def test_a_poisonous_scenario_is_held_to_what_is_learned() -> None:
    made = goals(scenarios()["contacts-level"], tree(touching_share=0.002))
    assert [(g.what, g.tree["met"]) for g in made] == [
        ("recall lost, points", True),
        ("contact ticks learned, share", False),
    ]


def quiet(alarms: int, ticks: int) -> dict[str, Any]:
    return {"variants": {"full": {"judged": {"false_alarms": alarms, "judged_ticks": ticks}}}}


def test_the_hours_without_change_are_held_to_the_goal_together() -> None:
    hour = 540_000
    walking = {"ramp-mud": quiet(900, hour), "steady-walk": quiet(30, 9 * hour)}
    assert pooled(walking) == {}, "one of the two is not there"
    pose = {"steady-pose": quiet(20, hour)}  # too many by itself
    steady = pooled(walking | pose)["steady"]
    assert steady["scenarios"] == ["steady-pose", "steady-walk"]
    assert (steady["false_alarms"], steady["robot_hours"]) == (50, 10.0)
    low, high = steady["per_robot_hour_interval"]
    assert low < steady["per_robot_hour"] == 5.0 < high
    assert [goal["met"] for goal in steady["goals"]] == [True]
    more = pooled(walking | {"steady-pose": quiet(21, hour)})["steady"]
    assert [(goal["limit"], goal["met"]) for goal in more["goals"]] == [(5.0, False)]
    assert not pooled({n: quiet(0, 0) for n in steady["scenarios"]})["steady"]["goals"][0]["met"]
