"""Scores of recorded messages: phases, lifts, runs, what is missing, and the JSON of it."""

from __future__ import annotations

import io
import itertools
import json
import random
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from rich.console import Console

from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import inverse, parse_robot, shipped_robot
from adaptive_contact.score import ROWS, Score, score_messages
from adaptive_contact.score.tables import as_json, as_table
from adaptive_contact.wire import (
    JSON,
    MSGPACK,
    ContactEvent,
    ContactTruth,
    Message,
    ServoSample,
    contact_key,
    decode,
    encode,
    servo_key,
    truth_key,
)

MS = 1_000_000
TICK = 20 * MS
ROBOT = shipped_robot()
# A swing of 30 ticks: 12 up, 18 down; then 10 of stance.
HEIGHTS = np.concatenate(
    [np.linspace(-0.10, -0.05, 13)[1:], np.linspace(-0.05, -0.10, 19)[1:], np.full(10, -0.10)]
)


class LiftAssessment(NamedTuple):
    key: str
    payload: bytes
    encoding: str = MSGPACK


def heard(key: str, message: Message, encoding: str = MSGPACK) -> LiftAssessment:
    return LiftAssessment(key, encode(message, encoding), encoding)


def desired(tick: int) -> list[float]:
    leg = ROBOT.leg("rf")
    point = np.array([0.13, 0.0, HEIGHTS[tick % 40]])
    return [float(q) for q in inverse(point, leg.lengths_m)]


def walk(
    swings: int = 5, *, leg: str = "rf", phase: bool = True, run: int | None = 1, start: int = 0
) -> list[LiftAssessment]:
    """Samples of one leg; the swing of 600 ms begins at 800 k ms."""
    messages = []
    for k in range(40 * swings):
        command = desired(k)
        sample = ServoSample(
            t_ns=(start + k) * TICK,
            seq=k,
            measured=command,
            desired=command,
            phase=("swing" if k % 40 < 30 else "stance") if phase else None,
            run=run,
        )
        messages.append(heard(servo_key(leg), sample))
    return messages


def truth(at_ms: float, until_ms: float | None = None, *, leg: str = "rf") -> list[LiftAssessment]:
    key = truth_key(leg)
    begin = ContactTruth(
        t_ns=round(at_ms * MS), contact=True, force=3.0, speed_m_s=0.4, surface="hard"
    )
    changes = [heard(key, begin)]
    if until_ms is not None:
        end = ContactTruth(t_ns=round(until_ms * MS), contact=False, force=0.0)
        changes.append(heard(key, end, JSON))
    return changes


def event(at_ms: float, *, leg: str = "rf", contact: bool = True) -> ContactEvent:
    return ContactEvent(
        leg=leg,
        t_ns=round(at_ms * MS),
        seq=round(at_ms / 20),
        onset_ns=round(at_ms * MS) - 10 * MS,
        contact=contact,
        status="valid",
        score=2.0,
        residual=[0.0, 0.01, -0.01],
        model_version=1,
    )


def air(leg: str = "rf") -> LiftAssessment:
    return heard(truth_key(leg), ContactTruth(t_ns=0, contact=False, force=0.0))


def events(*times_ms: float) -> list[LiftAssessment]:
    return [heard(contact_key("rf"), event(ms)) for ms in times_ms]


def test_a_recording_with_everything() -> None:
    messages = [*walk(), air(), *truth(400, 780), *truth(1200, 1580), *events(420, 1000)]
    score = score_messages(messages, ROBOT)
    assert (score.total.counted.touches, score.total.counted.found) == (2, 1)
    assert score.total.false_alarms == 1
    assert score.outcomes[0].alarms_ns.tolist() == [1000 * MS]
    assert score.total.legs == ("rf",)
    assert score.notes == ()
    # The order of messages does not matter between keys.
    random.Random(3).shuffle(messages)
    messages.sort(key=lambda m: m.key, reverse=True)
    samples, others = (
        [m for m in messages if m.key.endswith("servo") is of] for of in (True, False)
    )
    samples.sort(key=lambda m: decode(m.payload, ServoSample, m.encoding).seq)
    assert as_json(score_messages([*others, *samples], ROBOT)) == as_json(score)


def test_swings_are_inferred_where_samples_do_not_tell() -> None:
    told = score_messages([*walk(), air(), *truth(400, 780)], ROBOT, [event(420)])
    inferred = score_messages([*walk(phase=False), air(), *truth(400, 780)], ROBOT, [event(420)])
    assert inferred.total.counted.found == told.total.counted.found == 1
    assert inferred.total.swings == told.total.swings
    assert (
        abs(inferred.total.judged_ticks - told.total.judged_ticks) < 0.15 * told.total.judged_ticks
    )


def test_swings_that_cannot_be_told_are_an_error() -> None:
    bare = parse_robot(
        '[robot]\nname="bare"\nperiod_s=0.02\nquantum_rad=0.005\n'
        '[[leg]]\nid="rf"\njoints=["a","b","c"]\n',
        source="test",
    )
    with pytest.raises(ConfigurationError, match="carry no phase and 'bare' gives no lengths_m"):
        score_messages([*walk(phase=False), air()], bare, [])
    score = score_messages([*walk(), air(), *truth(280, 780)], bare, [])
    assert ROWS[score.outcomes[0].touches.row[0]] == "lift"  # 280 of 600 ms: first half
    score = score_messages([*walk(), air(), *truth(280, 780)], ROBOT, [])
    assert ROWS[score.outcomes[0].touches.row[0]] == "headline"  # the command turns at 240 ms


def test_bad_messages_are_counted_and_change_nothing() -> None:
    messages = [*walk(), air(), *truth(400, 780), *events(420)]
    expected = score_messages(messages, ROBOT)
    sample = ServoSample(t_ns=0, seq=0, measured=[0.0] * 3, desired=[0.0] * 3, phase="swing")
    bad = [
        LiftAssessment(servo_key("rf"), b"\xc1"),
        LiftAssessment(truth_key("rf"), b"{}", JSON),
        LiftAssessment(contact_key("rf"), b"[]", JSON),
        LiftAssessment("robot/leg/*/servo", encode(sample)),
        LiftAssessment("robot/leg/a/b/servo", encode(sample)),
        heard(servo_key("rf"), ServoSample(t_ns=1, seq=1, measured=[0.0], desired=[0.0])),
        heard(servo_key("rf"), ServoSample(t_ns=-1, seq=1, measured=[0.0] * 3, desired=[0.0] * 3)),
        heard(
            servo_key("rf"),
            ServoSample(t_ns=1, seq=1, measured=[0.0] * 3, desired=[0.0, float("nan"), 0.0]),
        ),
        messages[3],  # once more, at the end: late
        LiftAssessment("other/servo", b"not ours"),
        LiftAssessment("robot/leg/rf/command", b"not used"),
    ]
    messages[20:20] = bad[:8]
    score = score_messages([*messages, *bad[8:]], ROBOT)
    assert score.total == expected.total
    assert score.rejects == {
        "malformed": 1,
        "missing_field": 1,
        "not_finite": 1,
        "out_of_range": 1,
        "time_backwards": 1,
        "unknown_leg": 2,
        "wrong_joints": 1,
        "wrong_type": 1,
    }
    assert any("9 messages could not be used" in note for note in score.notes)


def test_a_sample_that_comes_twice_counts_once() -> None:
    samples = walk(2)
    twice = [m for sample in samples for m in (sample, sample)]
    once = score_messages([*samples, air(), *truth(400, 780), *events(420)], ROBOT)
    score = score_messages([*twice, air(), *truth(400, 780), *events(420)], ROBOT)
    assert score.total == once.total
    assert score.rejects == {"time_backwards": 80}


def test_runs_that_follow_each_other_are_scored_together() -> None:
    first, second = walk(2, run=7), walk(2, run=9, start=100)
    score = score_messages([*first, *second, air()], ROBOT, [])
    assert score.total.swings == 4


@pytest.mark.parametrize(
    "walks",
    [
        [walk(3, run=7), walk(3, run=9)],
        # Two sources at once, whose times happen never to go back.
        [walk(1, run=7), walk(1, run=9, start=50), walk(1, run=7, start=100)],
        zip(walk(2, run=7), walk(2, run=9), strict=True),
    ],
)
def test_runs_that_overlap_are_refused(walks: Iterable[Iterable[LiftAssessment]]) -> None:
    with pytest.raises(RecordingError, match="runs whose times overlap"):
        score_messages([*itertools.chain(*walks), air()], ROBOT, [])


def test_what_is_missing_is_one_clear_line() -> None:
    for messages, word in [
        ([], "no servo samples"),
        ([air()], "no servo samples"),
        (walk(1), "no truth"),
        ([*walk(1), air()], "no contact events"),
    ]:
        with pytest.raises(RecordingError, match=word):
            score_messages(messages, ROBOT)


def test_legs_without_truth_are_left_out_and_named() -> None:
    messages = [*walk(), *walk(leg="lf"), air(), *truth(400, 780), *events(420)]
    strange = heard(contact_key("zz"), event(100, leg="zz"))
    score = score_messages([*messages, strange], ROBOT)
    assert set(score.legs) == {"rf"}
    assert "no truth of lf: left out" in score.notes
    assert "events of zz, which sent no samples: left out" in score.notes


def test_a_part_of_the_recording() -> None:
    messages = [*walk(), air(), *truth(400, 780), *truth(1200, 1580), *events(420, 1000)]
    late = score_messages(messages, ROBOT, from_s=0.8)
    assert (late.total.swings, late.total.counted.touches, late.total.false_alarms) == (4, 1, 1)
    early = score_messages(messages, ROBOT, to_s=0.8)
    assert (early.total.swings, early.total.counted.found, early.total.false_alarms) == (1, 1, 0)


@pytest.mark.parametrize(("at_ms", "told"), [(400, False), (590, True)])
def test_a_headline_that_is_empty_as_touches_end_the_swings_is_told(at_ms: int, told: bool) -> None:
    score = score_messages([*walk(), air(), *truth(at_ms, 780), *events(at_ms + 20)], ROBOT)
    assert score.total.counted.touches == 1
    assert any("no touch of the headline" in note for note in score.notes) == told


def test_legs_that_only_stand_are_told() -> None:
    score = score_messages([*walk(1)[30:], air()], ROBOT, [])
    assert score.notes == ("no swing in the recording: nothing could be judged",)
    assert score.total.per_hour is None


def full_score() -> Score:
    messages = [*walk(), *walk(leg="lf"), air(), air("lf"), *truth(400, 780), *events(420, 1000)]
    return score_messages(messages, ROBOT)


def test_every_field_of_the_json_is_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "scoring.md").read_text(encoding="utf-8")

    def names(value: Any) -> set[str]:
        if not isinstance(value, dict):
            return set()
        return set(value) | {name for inner in value.values() for name in names(inner)}

    tree = json.loads(json.dumps(as_json(full_score()), allow_nan=False))
    assert tree["legs"]["lf"]["precision"] is None
    told = names({**tree, "legs": {}})
    assert {name for name in told if f"`{name}`" not in text} == set()
    assert {row for row in ROWS if f"`{row}`" not in text} == set()


def test_the_table_tells_the_figures() -> None:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(as_table(full_score()))
    text = console.export_text()
    assert "headline" in text
    assert "100.0 %" in text
    assert "robot-hour" in text
    assert "precision" in text
