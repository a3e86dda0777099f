"""What the detection study counts: the headline, false alarms, curves and limits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, LegStream, Row, TruthChanges, summarise
from adaptive_contact_studies import evaluate
from adaptive_contact_studies.paper import detection as study
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.detection import (
    BOTH,
    SLOW_FAST,
    Quiet,
    Touched,
    binned,
    rows_of,
)
from adaptive_contact_studies.paper.detectors import DETECTORS
from adaptive_contact_studies.paper.evaluation import AIM, AIMS, FACTORS, Evaluated, play
from adaptive_contact_studies.paper.plan import FULL, LegRun

TICK_NS = 20_000_000
TRIAL, SWING, TOUCH = 40, 35, 20  # ticks: of a trial, of its swing, from its begin to a touch


def events(ticks: list[int]) -> Events:
    t_ns = np.array(ticks, dtype=np.int64) * TICK_NS
    return Events(t_ns, np.ones(len(ticks), dtype=bool), t_ns)


def touched(
    kind: str, speeds: list[float | None], told: list[list[int]], force_n: float = 5.0
) -> Touched:
    """A stream of swings with a touch of each speed (None: without), and events told.

    Events are ticks after the begin of their own swing.
    """
    n = TRIAL * len(speeds) + 5
    tick = np.arange(n)
    inside = (tick % TRIAL >= TRIAL - SWING) & (tick < TRIAL * len(speeds))
    begin = [TRIAL * i + TRIAL - SWING for i in range(len(speeds))]
    onsets = [b + TOUCH for b, s in zip(begin, speeds, strict=True) if s is not None]
    # Let go in the stance that follows.
    changes = sorted([(o, True) for o in onsets] + [(o - TOUCH + SWING + 2, False) for o in onsets])
    fast = iter([s for s in speeds if s is not None])
    truth = TruthChanges(
        t_ns=np.array([t * TICK_NS - 5_000_000 * c for t, c in changes], dtype=np.int64),
        contact=np.array([c for _, c in changes], dtype=bool),
        speed_m_s=np.array([next(fast) if c else np.nan for _, c in changes]),
        soft=np.zeros(len(changes), dtype=bool),
        grazing=np.zeros(len(changes), dtype=bool),
        force_n=np.full(len(changes), force_n),
    )
    when = [b + e for b, own in zip(begin, told, strict=True) for e in own]
    number = np.where(inside, tick // TRIAL, -1)
    piece = dataclasses.replace(
        FULL.pieces("touch")[0], leg_run=LegRun(0, "rf"), kind=kind, role="touch"
    )
    score = np.full(n, 0.1)
    score[when] = 3.0
    stream = LegStream("rf", tick * TICK_NS, inside, truth)
    played = {"default": events(when)} | {f"aim {aim:g}": events(when) for aim in AIMS}
    scores = dict.fromkeys(DETECTORS, score)
    return Touched(piece, Evaluated(stream, number, inside.copy(), played, {}, scores, {}, {}))


@pytest.fixture
def streams() -> list[Touched]:
    """Three fast touches that are found; slowly approached, two fast ones missed, one found."""
    return [
        touched("hard", [0.5, 0.9, 0.3], [[TOUCH], [TOUCH + 1], [TOUCH]]),
        touched("hard slow", [0.4, 0.05, 0.6], [[], [TOUCH + 12], []]),
    ]


def test_fast_touches_in_slow_approaches_have_rows_of_their_own(streams: list[Touched]) -> None:
    outcomes = [t.outcome("default") for t in streams]
    rows = rows_of(streams, outcomes)
    assert {name: (row["found"], row["touches"]) for name, row in rows.items()} == {
        "headline": (3, 3),
        SLOW_FAST: (0, 2),
        BOTH: (3, 5),
        "slow": (1, 1),
    }
    assert list(rows)[:3] == ["headline", SLOW_FAST, BOTH]
    # Nothing is hidden: all the score's own headline touches are in both.
    assert rows[BOTH]["touches"] == summarise(outcomes).rows[Row.HEADLINE].touches


def test_kinds_and_limits_hold_to_the_same_headline(streams: list[Touched]) -> None:
    found = study._figures("default", streams, {"free": Quiet(), "stand": Quiet()})
    assert {kind: own["touches"] for kind, own in found["kinds"].items()} == {
        "hard": 3,
        "hard slow": 3,
    }
    outcomes = [t.outcome("default") for t in streams]
    bins = binned(streams, outcomes, "speed_m_s", (0.0, 0.1, 0.2, 2.5), ())
    assert [b["touches"] for b in bins] == [1, 0, 3]
    assert [b["recall"] for b in bins] == [1.0, None, 1.0]
    strong = touched("hard", [0.5], [[TOUCH]], force_n=150.0)
    bins = binned([strong], [strong.outcome("default")], "force_n", study._FORCE_EDGES_N, ())
    assert bins[-1]["touches"] == 1


def quiet_of(streams: list[Touched], alarms: np.ndarray) -> Quiet:
    """One free stream of an hour's ticks, and two events of the default."""
    swing = np.zeros(540_000, dtype=np.int64)
    events = dict.fromkeys(streams[0].found.events, streams[0].found.events["default"])
    found = Evaluated(
        streams[0].found.truth, swing, swing > 0, events, dict.fromkeys(DETECTORS, alarms), {},
        {"servo": np.ones(3), "paper": np.full(3, 4.0)}, {"servo": 4, "paper": 1},
    )  # fmt: skip
    quiet = Quiet()
    quiet.add(streams[0].piece, found)
    return quiet


def test_curves_are_of_the_headlines_touches(streams: list[Touched]) -> None:
    counts = np.concatenate([np.full(5, -1), np.arange(len(FACTORS) - 5)[::-1]])
    quiet = quiet_of(streams, counts)
    fast = [t for t in streams if not t.slow]
    curve = study._curve("servo ratio", fast, [quiet])
    assert len(curve) == len(FACTORS) - 5  # thresholds too low to be counted have no point
    at_aim = next(p for p in curve if abs(p["factor"] - 1.0) < 1e-6)
    assert (at_aim["recall"], at_aim["per_hour"]) == (1.0, len(FACTORS) - 1 - AIM)
    # Scores of 3 pass a threshold of 1, none of 10.
    assert curve[-1]["factor"] == pytest.approx(10.0)
    assert curve[-1]["recall"] == 0.0
    points = study._curve("default", fast, [quiet])
    assert [p["aim"] for p in points] == list(AIMS)
    assert {(p["recall"], p["per_hour"]) for p in points} == {(1.0, 3.0)}


def test_residuals_are_pooled_over_rows(streams: list[Touched]) -> None:
    quiet = quiet_of(streams, np.zeros(len(FACTORS), dtype=np.int64))
    assert quiet.rms_deg("servo") == pytest.approx([np.degrees(0.5)] * 3)
    assert quiet.rms_deg("paper", "0-rf") == pytest.approx([np.degrees(2.0)] * 3)


def test_the_sweep_is_wide_and_holds_the_aim() -> None:
    assert FACTORS[AIM] == pytest.approx(1.0)
    assert FACTORS[0] == pytest.approx(1e-3)


def test_a_step_at_the_foot_is_read_off_the_robots_description(robot: Robot) -> None:
    """52, 66 and 138 mm, 0.29° a step: from each joint to a stretched leg's foot."""
    limits = study.limits_of(robot)
    step = np.radians(300.0 / 1023.0)
    assert limits["step_m"]["tibia"] == pytest.approx(0.138 * step, rel=2e-3)
    assert limits["step_m"]["femur"] == pytest.approx(0.204 * step, rel=2e-3)
    assert limits["step_m"]["coxa"] == pytest.approx(0.256 * step, rel=2e-3)
    assert limits["step_n"]["femur"] == pytest.approx(1.5 / 32 / 0.204)


def test_what_was_not_counted_has_no_rate() -> None:
    assert study.rate_of(-1, 540_000) == {
        "count": -1, "hours": 1.0, "per_hour": None, "interval": [None, None]
    }  # fmt: skip
    assert study.rate_of(0, 0)["per_hour"] is None


def test_streams_side_by_side_decide_what_they_decide_alone(
    robot: Robot, touched_stream: Stream
) -> None:
    baseline = shipped_baseline(robot.name)
    assert baseline is not None
    rows = ("measured", "desired", "valid", "swing")
    first = {name: getattr(touched_stream.arrays, name)[:900] for name in rows}
    short = Stream(touched_stream.piece, dataclasses.replace(touched_stream.arrays, **first))
    both = (touched_stream, short)
    for stream, events in zip(both, play(robot, [baseline] * 2, both), strict=True):
        alone = Events.of(evaluate.play(stream.run, robot, baseline).events["rf"])
        assert len(alone.t_ns) > 3
        for a, b in zip(events, alone, strict=True):
            np.testing.assert_array_equal(a, b)
