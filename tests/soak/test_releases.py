"""A release is wrong if the leg stands loaded, and right if it was or is about to be free."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.score import LegStream
from adaptive_contact.score.contacts import truth_changes
from adaptive_contact.score.outcome import Events
from adaptive_contact.wire import ContactTruth

pytest.importorskip("mujoco")

from .made import S
from .releases import judge_releases

TRUE_S = [(1.0, True), (2.0, False), (3.0, True), (4.0, False)]


def releases(*told_s: tuple[float, float]) -> list[bool]:
    """Releases at (onset, deciding sample) of a leg that touches from 1 to 2 and from 3 to 4 s."""
    truth = truth_changes(
        [ContactTruth(t_ns=int(at * S), contact=on, force=9.0 * on) for at, on in TRUE_S]
    )
    t_ns = np.arange(0, 5 * S, S // 50)
    stream = LegStream("rf", t_ns, np.zeros(len(t_ns), dtype=bool), truth)
    at = [(int(t * S), on, int(onset * S)) for onset, t in told_s for on in (True, False)]
    columns = [np.array(column) for column in zip(*at, strict=True)]
    return judge_releases(stream, Events(*columns)).wrong.tolist()


def test_a_release_of_a_leg_that_stands_loaded_is_wrong() -> None:
    assert releases((1.2, 1.24)) == [True]
    assert releases((1.5, 1.5), (3.7, 3.74), (2.5, 2.6)) == [True, True, False]


def test_a_release_just_before_the_leg_comes_off_is_right() -> None:
    assert releases((1.72, 1.78), (1.95, 2.0), (2.02, 2.3)) == [False, False, False]


def test_a_leg_that_was_free_at_the_onset_was_released_truly() -> None:
    assert releases((2.98, 3.04), (0.9, 1.1)) == [False, False]
    assert releases((0.1, 0.2)) == [False], "nothing has touched yet"
