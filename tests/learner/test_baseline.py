"""Baseline files: what no leg can have is refused in a line, not found out in a run."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.errors import BaselineError
from adaptive_contact.model import Baseline
from adaptive_contact.model.model_file import dump_baseline, parse_baseline
from adaptive_contact.model.tail import SHAPE_RANGE, Tail
from adaptive_contact.robot import Robot


@pytest.fixture
def tree(baseline: Baseline) -> dict[str, Any]:
    return json.loads(dump_baseline(baseline))


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_what_was_written_is_read_back(tree: dict[str, Any], robot: Robot, mark: bytes) -> None:
    """Also with the mark that an editor put before it."""
    again = parse_baseline(mark + json.dumps(tree).encode(), source="here")
    assert json.loads(dump_baseline(again)) == tree
    assert ContactLearner(robot, "rf", again).status.status == "valid"


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all fields; of lists, and of what a leg has, the first entry stands for all."""
    if path:
        yield path
    if isinstance(tree, dict):
        some = path[:1] == ("legs",) and len(path) != 2
        for key in list(tree)[: 1 if some else None]:
            yield from places(tree[key], (*path, key))
    elif isinstance(tree, list):
        yield from places(tree[0], (*path, 0))


LIST = [1.0] * 100_000
NUMBERS = [0, -1, 1e-300, 1e308, "Infinity", 10**400, None, "x", LIST, {"a": 1}]
NAMES = {
    *("format", "robot", "origin", "quantum_rad", "name", "past_measured", "past_desired"),
    *("preview", "slope_rad", "period_s", "level", "rate", "scale", "shape", "ticks", "joints"),
    *("axes", "rows", "terms", "covariance", "domain", "legs", "tails", "library"),
}
# What a leg may have, of what is written into each field.
PLAUSIBLE = {
    *(("terms", "0"), ("terms", "-1"), ("terms", "1e-300"), ("preview", "0")),
    *(("shape", "0"), ("shape", "1e-300")),  # of an exponential tail
    *(("legs/ticks", "0"), ("legs/ticks", "1e-300")),  # of one context
    *(("robot", "'x'"), ("origin", "'x'"), ("origin", "'Infinity'"), ("domain", "None")),
}


@pytest.mark.parametrize("value", NUMBERS, ids=lambda value: repr(value)[:10])
def test_every_field_that_no_leg_has_is_named(tree: dict[str, Any], value: Any) -> None:
    seen = set()
    for path in places(tree):
        changed = copy.deepcopy(tree)
        at = changed
        for key in path[:-1]:
            at = at[key]
        leaf = not isinstance(at[path[-1]], list | dict)
        at[path[-1]] = value
        field = next(key for key in reversed(path) if key in NAMES)
        seen.add(field)
        names = {field, f"{path[0]}/{field}"}
        text = json.dumps(changed).replace('"Infinity"', "1e400")
        possible = any((name, repr(value)[:9]) in PLAUSIBLE for name in names)
        if possible and leaf is not (value is None):
            thresholds = parse_baseline(text.encode(), source="here").thresholds(1.0)
            assert 0 < thresholds.min() <= thresholds.max() < 1e6
            continue
        with pytest.raises(
            BaselineError, match=rf"^here: .*({field.rstrip('s')}|library)"
        ) as refused:
            parse_baseline(text.encode(), source="here")
        assert len(str(refused.value)) < 500
    assert seen == NAMES


@pytest.mark.parametrize("times", [0.0, 0.1, 10.0])
def test_a_domain_is_of_the_rows_of_its_model(tree: dict[str, Any], times: float) -> None:
    """One of no rows would make a leg blind: its threshold would be out of reach."""
    leg = next(iter(tree["legs"].values()))
    leg["domain"] = [" ".join(str(times * float(x)) for x in row.split()) for row in leg["domain"]]
    with pytest.raises(BaselineError, match="domain"):
        parse_baseline(json.dumps(tree).encode(), source="here")


@pytest.mark.parametrize("shape", [*SHAPE_RANGE, 0.5])
def test_every_shape_that_is_fitted_can_be_read_cautiously(shape: float) -> None:
    tail = Tail(level=10.0, rate=0.01, scale=2.0, shape=shape, ticks=10_000).cautious()
    assert shape <= tail.shape <= SHAPE_RANGE[1]
    assert tail.quantile(1e-6) > tail.level
