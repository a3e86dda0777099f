from __future__ import annotations

import re

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift
from adaptive_contact_sim.scenario import drift_from, parse_drift


def test_the_whole_form() -> None:
    injection = parse_drift("friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s")
    assert injection.at_s == 20.0
    assert injection.drift == Drift(
        kind="friction", leg="rf", joint="femur", value=4.0, shape="ramp", duration_s=60.0
    )


def test_a_shape_lasts_as_long_as_people_write_it() -> None:
    drift = parse_drift("friction:value=4,shape=ramp,duration=2m").drift
    assert drift.duration_s == 120.0


@pytest.mark.parametrize(
    ("text", "at_s"),
    [
        ("mass:value=0.05", 0.0),
        ("mass:leg=all,value=0.05@3", 3.0),
        ("mass: value = 0.05 @ 500ms", 0.5),
        ("mass:joint=all,value=5e-2@1.5min", 90.0),
        ("mass:value=0.05@1h30m", 5400.0),
    ],
)
def test_short_forms(text: str, at_s: float) -> None:
    injection = parse_drift(text)
    assert injection.at_s == at_s
    assert injection.drift == Drift(kind="mass", value=0.05)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected one of mass"),
        ("frictoin:value=4", "did you mean 'friction'"),
        ("friction", "give a number"),
        ("friction:", "not KEY=VALUE"),
        ("friction:value", "not KEY=VALUE"),
        ("friction:value=", "not KEY=VALUE"),
        ("friction:valeu=4", "did you mean 'value'"),
        ("friction:value=4,value=5", "given twice"),
        ("friction:value=many", "expected a number"),
        ("friction:value=nan", "expected a number"),
        ("friction:value=inf", "expected a number"),
        ("friction:value=4,seed=1.5", "expected a whole number"),
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
        ({"kind": "friction", "value": 4.0, "at_s": "3"}, "expected seconds"),
        ({"kind": 3, "value": 4.0}, "kind"),
    ],
)
def test_tables_are_checked_too(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        drift_from(fields, where="my.toml: [[drift]] 1")
    assert str(caught.value).startswith("my.toml: [[drift]] 1")
