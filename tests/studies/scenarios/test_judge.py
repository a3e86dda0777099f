"""Lock-outs, valid after how many swings, quantiles, goals."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.score import SwingTable
from adaptive_contact_studies.scenarios.judge import (
    SETTLED,
    longest_lock_out,
    swings_until_valid,
)
from adaptive_contact_studies.scenarios.replay import STATUSES, SwingLog


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
