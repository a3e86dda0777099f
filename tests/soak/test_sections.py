"""What lies between two windows is a section, and errors are counted in the one they fall into."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.score import LegStream
from adaptive_contact.score.contacts import truth_changes
from adaptive_contact.score.outcome import Events
from adaptive_contact.wire import ContactTruth

pytest.importorskip("mujoco")

from . import sections
from .made import S
from .plan import Drifting
from .releases import judge_releases


def test_windows_last_two_seconds_and_what_lies_between_is_a_section() -> None:
    drifts = [Drifting("mass:a", 20.0, 0.0), Drifting("supply:b", 40.0, 10.0)]
    windows = sections.windows_of([("router", 5 * S, 7 * S)], drifts, epoch_ns=0)
    assert [(w.begin_ns / S, w.end_ns / S) for w in windows] == [(5, 9), (20, 22), (40, 42)]
    spans = sections.spans_between(windows, 0, 100 * S)
    assert [(s.begin_ns / S, s.end_ns / S, s.after, s.ramp) for s in spans] == [
        (0, 5, "begin", False),
        (9, 20, "router restarted", False),
        (22, 40, "mass:a@20s", False),
        (42, 52, "supply:b@40s", True),
        (52, 100, "supply:b@40s", False),
    ]
    # A fault in the midst of a ramp does not end it.
    both = sections.windows_of([("service", 44 * S, 45 * S)], drifts, epoch_ns=0)
    spans = sections.spans_between(both, 0, 100 * S)
    assert [(s.begin_ns / S, s.end_ns / S, s.ramp) for s in spans][-3:] == [
        (42, 44, True),
        (47, 52, True),
        (52, 100, False),
    ]


def test_wrong_releases_are_counted_where_they_fall() -> None:
    found = judge_releases(
        LegStream(
            "rf",
            np.arange(0, 9 * S, S),
            np.ones(9, dtype=bool),
            truth_changes([ContactTruth(t_ns=S, contact=True, force=9.0)]),
        ),
        Events(np.array([2 * S, 5 * S]), np.zeros(2, dtype=bool), np.array([2 * S, 5 * S])),
    )
    spans = [
        sections.Span(0, 3 * S, "begin", ramp=False),
        sections.Span(4 * S, 6 * S, "ramp", ramp=True),
    ]
    rows = sections.judge_sections([], [found], spans)
    assert [(one.releases, one.wrong_releases) for one in rows] == [(1, 1), (1, 1)]
