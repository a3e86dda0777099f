from __future__ import annotations

import functools
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift
from adaptive_contact_sim import Simulation, SimulationSettings, drift_from, parse_drift
from adaptive_contact_sim.drift import DriftSchedule, Injection
from adaptive_contact_sim.elements import LEGS

RF = LEGS.index("rf")


def schedule(*injections: tuple[Drift, float]) -> DriftSchedule:
    return DriftSchedule(Injection(drift, at) for drift, at in injections)


def test_step_takes_its_joints_and_no_others() -> None:
    plan = schedule((Drift(kind="friction", value=4.0, leg="rf", joint="femur"), 2.0))
    assert not plan.due(1.98)
    assert plan.values(1.98)["friction"].max() == 1.0
    assert plan.due(2.0)
    values = plan.values(2.0)["friction"]
    assert values[RF, 1] == 4.0
    assert values.sum() == 17 + 4.0
    assert not plan.due(2.02)
    assert plan.holds() == {"friction": {"rf": {"femur": 4.0}}}


def test_value_is_absolute_and_nominal_takes_it_back() -> None:
    plan = DriftSchedule()
    for at, value in ((1.0, 4.0), (2.0, 4.0), (3.0, 2.0), (4.0, 1.0)):
        plan.add(Injection(Drift(kind="friction", value=value), at))
        assert np.all(plan.values(at)["friction"] == value)
    assert plan.holds() == {}


def test_ramp_starts_where_the_joint_is() -> None:
    ramp = Drift(kind="supply", value=9.0, shape="ramp", duration_s=10.0)
    plan = schedule((ramp, 5.0))
    assert plan.values(5.0)["supply"][0, 0] == 12.0
    assert plan.values(10.0)["supply"][0, 0] == pytest.approx(10.5)
    # Half way, one leg turns back up; the others go on.
    plan.add(
        Injection(Drift(kind="supply", value=12.0, leg="lf", shape="ramp", duration_s=1.0), 10.0)
    )
    assert plan.values(10.5)["supply"][0, 0] == pytest.approx(11.25)
    assert plan.values(10.5)["supply"][1, 0] == pytest.approx(10.35)
    last = plan.values(15.0)["supply"]
    assert last[0, 0] == 12.0
    assert np.all(last[1:] == 9.0)
    assert not plan.due(15.1)


def test_pulse_goes_back_to_what_was_before() -> None:
    plan = schedule(
        (Drift(kind="offset", value=0.01, leg="rm"), 0.0),
        (Drift(kind="offset", value=0.05, shape="pulse", duration_s=2.0), 1.0),
    )
    assert plan.values(0.5)["offset"][4, 0] == 0.01
    assert np.all(plan.values(2.9)["offset"] == 0.05)
    after = plan.values(3.0)["offset"]
    assert np.all(after[4] == 0.01)
    assert np.all(np.delete(after, 4, axis=0) == 0.0)


@given(st.integers(0, 10_000))
def test_random_walk_stays_between_nominal_and_value(seed: int) -> None:
    walk = Drift(kind="friction", value=5.0, shape="walk", duration_s=20.0, seed=seed)
    values = []
    plan, again = schedule((walk, 0.0)), schedule((walk, 0.0))
    for t in np.arange(0.0, 25.0, 0.1):
        value = plan.values(t)["friction"][0, 0]
        assert value == again.values(t)["friction"][0, 0]
        values.append(value)
    assert min(values) >= 1.0
    assert max(values) <= 5.0
    assert np.ptp(values) > 0.2
    assert values[-1] == values[201]  # it stays where it ended


@pytest.mark.parametrize(
    ("drift", "words"),
    [
        (Drift(kind="friction", value=50.0), "expected 0.1 to 10"),
        (Drift(kind="supply", value=0.0), "expected 7 to 14 V"),
        (Drift(kind="friction", value=float("nan")), "expected 0.1 to 10"),
        (Drift(kind="friction", value=2.0, leg="rx"), "no leg 'rx'"),
        (Drift(kind="friction", value=2.0, joint="knee"), "no joint 'knee'"),
        (Drift(kind="mass", value=0.05, joint="tibia"), "leave out the joint"),
        (Drift(kind="friction", value=2.0, shape="ramp"), "duration"),
        (Drift(kind="friction", value=2.0, duration_s=-1.0), "expected 0 to"),
        (Drift(kind="friction", value=2.0, seed=-1), "expected 0 or more"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(drift: Drift, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        DriftSchedule([Injection(drift)])


@functools.cache
def moved(*drift: Injection) -> tuple[Simulation, np.ndarray]:
    """A robot after three seconds of drift, and its angles in every tick."""
    sim, angles = Simulation(SimulationSettings(drift=drift)), []
    for _ in range(150):
        sim.advance()
        angles.append(sim.plant.joint_angles.copy())
    return sim, np.array(angles)


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("friction", 4.0),
        ("viscous", 10.0),
        ("supply", 9.4),
        ("compliance", 2.0),
        ("winding", 1.16),
        ("backlash", 0.02),
        ("offset", 0.015),
        ("mass", 0.08),
    ],
)
def test_every_kind_changes_how_its_leg_moves_and_only_then(kind: str, value: float) -> None:
    drifting, angles = moved(Injection(Drift(kind=kind, value=value, leg="rf"), 1.5))
    difference = np.abs(angles - moved()[1])
    assert difference[:75].max() == 0.0
    assert difference[:, 9:12].max() > 0.003
    assert list(drifting.now_holds()) == [kind]


@pytest.mark.parametrize(
    ("text", "at_s", "fields"),
    [
        (
            "friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s",
            20.0,
            {"leg": "rf", "joint": "femur", "value": 4.0, "shape": "ramp", "duration_s": 60.0},
        ),
        (
            "friction:value=4,shape=ramp,duration=2m",
            0.0,
            {"value": 4.0, "shape": "ramp", "duration_s": 120.0},
        ),
        ("friction:value=0.5", 0.0, {"value": 0.5}),
        ("friction:leg=all,value=0.5@3", 3.0, {"value": 0.5}),
        ("friction: value = 0.5 @ 500ms", 0.5, {"value": 0.5}),
        ("friction:joint=all,value=5e-1@1.5min", 90.0, {"value": 0.5}),
        ("friction:value=0.5@1h30m", 5400.0, {"value": 0.5}),
    ],
)
def test_a_drift_may_be_written_in_short(text: str, at_s: float, fields: dict[str, Any]) -> None:
    assert parse_drift(text) == Injection(Drift(kind="friction", **fields), at_s)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected mass"),
        ("frictoin:value=4", "did you mean 'friction'"),
        ("friction", "give a number"),
        ("friction:value", "not KEY=VALUE"),
        ("friction:value=", "not KEY=VALUE"),
        ("friction:valeu=4", "did you mean 'value'"),
        ("friction:value=4,value=5", "given twice"),
        ("friction:value=many", "Expected `float`"),
        ("friction:value=nan", "expected 0.1 to 10"),
        ("friction:value=inf", "expected 0.1 to 10"),
        ("friction:value=4,seed=1.5", "Expected `int`"),
        ("friction:value=4,duration=long", "such as 90s, 10m or 1h30m"),
        ("friction:value=4@soon", "such as 20s"),
        ("friction:value=4@-3s", "such as 20s"),
        ("friction:value=4@1e", "such as 20s"),
        ("friction:value=4,leg=xx", "no leg 'xx'"),
        ("friction:value=4,shape=sine", "sine"),
        ("friction:value=4,shape=ramp", "duration"),
        ("friction:value=400", "expected 0.1 to 10"),
    ],
)
def test_errors_are_one_line_that_helps(text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        parse_drift(text)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "friction"}, "has no value"),
        ({"value": 2.0}, "kind"),
        ({"kind": "friction", "value": "4"}, "Expected `float`"),
        ({"kind": "friction", "value": 4.0, "at": 3}, "did you mean 'at_s'"),
        ({"kind": "friction", "value": 4.0, "at_s": "3"}, "Expected `float`, got `str`"),
        ({"kind": 3, "value": 4.0}, "kind"),
    ],
)
def test_tables_are_checked_too(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        drift_from(fields, where="my.toml: [[drift]] 1")
    assert str(caught.value).startswith("my.toml: [[drift]] 1")
