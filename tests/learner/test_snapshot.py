"""A snapshot is taken over whole or not at all."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot

from .conftest import FakeLeg, play

NO_TICKS = {name: {"shape": [0, n], "data": b""} for name, n in (("theta", 74), ("target", 3))}


@pytest.fixture(scope="module")
def robot() -> Any:
    return shipped_robot()


@pytest.fixture(scope="module")
def saved(robot: Any) -> dict[str, Any]:
    return from_file(learner(robot))


def from_file(saved: ContactLearner) -> dict[str, Any]:
    """A snapshot as it comes back from a file."""
    return msgpack.unpackb(msgpack.packb(saved.snapshot()))


def learner(robot: Any, leg: str = "rf") -> ContactLearner:
    return ContactLearner(robot, leg, shipped_baseline(robot.name))


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("format", 99, "format is 99"),
        ("library", {"name": "paper"}, "another library"),
        ("coefficients", {"shape": [1], "data": b"x" * 8}, "its model has shape"),
        ("coefficients", 3, "its model is no array"),
        ("level", float("nan"), "its level is nan"),
        ("level", "high", "its level is 'high'"),
        ("status", "happy", "its status is 'happy'"),
        ("segments", [{}], "is no array"),
        ("segments", [{"theta": 3}], "is no array"),
        ("segments", None, "its segments are no list"),
        ("segments", [NO_TICKS], "a segment has no ticks"),
        ("version", -1, "version or era"),
        ("era", -1, "version or era"),
        ("era", 2**70, "version or era"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    robot: Any, saved: dict[str, Any], name: str, value: object, says: str
) -> None:
    fresh = learner(robot)
    before = msgpack.packb(fresh.snapshot())
    line = fresh.restore({**saved, "follower": {**saved["follower"], name: value}})
    assert says in line
    assert "\n" not in line
    assert msgpack.packb(fresh.snapshot()) == before


def test_what_another_baseline_was_followed_from_is_refused(
    robot: Any, saved: dict[str, Any]
) -> None:
    """Another leg's, or none: what was learned from a prior says nothing of a baseline."""
    bare = ContactLearner(robot, "rf", None)
    assert "another baseline" in str(learner(robot, "lf").restore(saved))
    assert "another baseline" in str(bare.restore(saved))
    play(bare, FakeLeg(seed=3).stream(8))
    assert "another baseline" in str(learner(robot).restore(bare.snapshot()))


def test_a_leg_of_an_older_version_without_a_baseline_begins_anew(robot: Any) -> None:
    saved = {**learner(robot).snapshot(), "start": {"known": {}, "origin": "cold start"}}
    fresh = ContactLearner(robot, "rf", None)
    line = fresh.restore(saved)
    assert "older version" in line
    assert fresh.status.status == "learning"


def places(tree: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths of all values; of a list of segments, the first stands for all."""
    if isinstance(tree, dict) and "shape" not in tree:
        for key, value in tree.items():
            yield from places(value, (*path, key))
    elif isinstance(tree, list) and tree:
        yield from places(tree[0], (*path, 0))
    else:
        yield path


@pytest.mark.parametrize(
    "value", [-1, 1 << 63, 1e308, float("nan"), [1.0] * 1000, {"a": 1}], ids=repr
)
def test_no_number_of_a_file_is_counted_or_learned_on_from(robot: Any, value: Any) -> None:
    """Refused in a line, or left out; arrays are refused, with their names."""
    lived = learner(robot)
    play(lived, FakeLeg(seed=3).stream(4))
    tree = from_file(lived)
    fresh = learner(robot)
    for path in places(tree):
        changed = copy.deepcopy(tree)
        at = changed
        for key in path[:-1]:
            at = at[key]
        array = isinstance(at[path[-1]], dict)
        if array and isinstance(value, float):
            rows = np.frombuffer(at[path[-1]]["data"]).copy()
            rows[0] = value
            at[path[-1]]["data"] = rows.tobytes()
        else:
            at[path[-1]] = value
        line = fresh.restore(changed)
        assert line is not None or not array, path
        assert line is None or "\n" not in line
        status = msgspec.to_builtins(fresh.status)
        assert msgspec.msgpack.encode(status)
        numbers = [n for n in (*status.values(), *status["rejects"].values()) if type(n) is int]
        assert 0 <= min(numbers) <= max(numbers) < 1 << 62, path
