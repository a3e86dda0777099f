"""Baseline files: what no leg can have is refused in a line, not found out in a run."""

from __future__ import annotations

import json
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
    found: dict[str, Any] = json.loads(dump_baseline(baseline))
    return found


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_what_was_written_is_read_back(tree: dict[str, Any], robot: Robot, mark: bytes) -> None:
    """Also with the mark that an editor put before it."""
    again = parse_baseline(mark + json.dumps(tree).encode(), source="here")
    assert json.loads(dump_baseline(again)) == tree
    assert ContactLearner(robot, "rf", again).status.status == "valid"


@pytest.mark.parametrize("shape", [-0.5, 0.7, 1.0, float("nan")])
def test_a_tail_of_no_such_shape_is_refused(tree: dict[str, Any], shape: float) -> None:
    tree["tails"][1]["shape"] = shape
    text = json.dumps(tree).replace("NaN", "null")
    with pytest.raises(BaselineError, match=r"^here: "):
        parse_baseline(text.encode(), source="here")


@pytest.mark.parametrize("ticks", [0.0, -1.0, 1e400])
def test_ticks_that_are_no_counts_are_refused(tree: dict[str, Any], ticks: float) -> None:
    leg = tree["legs"]["rf"]
    leg["ticks"] = [ticks] * len(leg["ticks"])
    text = json.dumps(tree).replace("Infinity", "1e400")
    with pytest.raises(BaselineError, match=r"^here: "):
        parse_baseline(text.encode(), source="here")


@pytest.mark.parametrize("shape", [*SHAPE_RANGE, 0.5])
def test_every_shape_that_is_fitted_can_be_read_cautiously(shape: float) -> None:
    tail = Tail(level=10.0, rate=0.01, scale=2.0, shape=shape, ticks=10_000).cautious()
    assert shape <= tail.shape <= SHAPE_RANGE[1]
    assert tail.quantile(1e-6) > tail.level
