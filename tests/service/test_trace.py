"""Ticks that are kept while somebody asks for them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from adaptive_contact.core.leg_learner import JudgedTick
from adaptive_contact.robot import Mount, parse_robot
from adaptive_contact.service.trace import LEASE_S, MOST_TICKS, Tracer, placed
from adaptive_contact.wire import LegState, LegTrace, Phase, ServoSample

S = 1_000_000_000
ROBOT = parse_robot(
    """
[robot]
name = "mini"
period_s = 0.02
quantum_rad = 0.00511
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.05, 0.07, 0.14]
[leg.angles]
directions = [1, -1, 1]
offsets_rad = [0.0, 0.5, 0.0]
[[leg]]
id = "lf"
joints = ["coxa", "femur", "tibia"]
""",
    source="mini",
)


def sample(
    seq: int, phase: Phase | None = "swing", femur: float = 0.2, joints: int = 3
) -> ServoSample:
    angles = [0.1, femur, -1.2, 0.0][:joints]
    return ServoSample(t_ns=seq * 20_000_000, seq=seq, measured=angles, desired=angles, phase=phase)


def asked(tracer: Tracer, after: str | None = None, now_ns: int = 0) -> dict[str, list[int]]:
    return {trace.leg: trace.seq for trace in tracer.answer(("rf", "lf"), after, now_ns)}


@pytest.fixture
def tracer() -> Tracer:
    """That somebody asks."""
    made = Tracer()
    asked(made)
    return made


def test_ticks_are_wanted_while_somebody_asks() -> None:
    tracer = Tracer()
    assert not tracer.wanted(0)
    assert asked(tracer) == {}
    assert tracer.wanted(int(LEASE_S * S) - 1)
    assert not tracer.wanted(int(LEASE_S * S))
    tracer.record("rf", sample(1), None)
    assert asked(tracer, now_ns=S) == {"rf": [1]}
    assert tracer.wanted(int(LEASE_S * S) + S - 1), "each question asks for more"
    assert asked(tracer, now_ns=100 * S) == {}, "what is old was kept for nobody"


def learner(leg: str, seq: int) -> Any:
    """Of a leg whose newest sample is ``seq``; its command shows a swing."""
    # In the description's angles the reading of the femur is 0.5 - 0.2, and was expected at 0.28.
    tick = JudgedTick(np.array([0.01, 0.02, 0.0]), np.array([1.5, 0.1, np.nan]), np.ones(3))
    return SimpleNamespace(
        leg=ROBOT.leg(leg),
        judged=lambda: tick,
        state=LegState(t_ns=2, seq=seq, contact=True, p=0.9, known=True),
        place=SimpleNamespace(leg=SimpleNamespace(swing_phase=1.0)),
    )


def test_each_asker_gets_what_it_has_not_had(tracer: Tracer) -> None:
    for seq in (1, 2, 3):
        tracer.record("rf", sample(seq), None)
        tracer.record("lf", sample(seq), None)
    (first, _) = tracer.answer(("rf", "lf"), None, 0)
    assert first.number == 6
    tracer.record("rf", sample(4), None)
    assert asked(tracer, "6") == {"rf": [4]}
    assert asked(tracer, "4") == {"rf": [3, 4], "lf": [3]}
    for none in (None, "", "-1", "x", "1e3", "٣", "9" * 5000, "999"):
        assert asked(tracer, none) == {"rf": [1, 2, 3, 4], "lf": [1, 2, 3]}, none


def test_what_is_kept_and_what_is_answered_is_bounded(tracer: Tracer) -> None:
    last = MOST_TICKS + 500
    for seq in range(1, last + 1):
        tracer.record("rf", sample(seq), None)
    assert asked(tracer)["rf"] == list(range(last - 199, last + 1))
    assert asked(tracer, "1")["rf"] == list(range(501, 701))
    assert asked(tracer, "700")["rf"] == list(range(701, 901)), "the rest comes with the next"


def test_the_last_sample_has_what_its_learner_made_of_it(tracer: Tracer) -> None:
    tracer.record("rf", sample(1, None), None)
    tracer.record("rf", sample(2, None), learner("rf", 2))
    tracer.record("rf", sample(3, "stance"), learner("rf", 3))
    tracer.record("rf", sample(4, None), learner("rf", 3))  # that was refused
    tracer.record("lf", sample(2, None), learner("lf", 2))
    rf, lf = tracer.answer(("rf", "lf"), None, 0)
    assert rf.p == [None, 0.9, 0.9, None]
    assert rf.test_ratio == [None, 1.5, 1.5, 1.5]
    assert [round(angle, 6) for angle in rf.predicted[1]] == [0.09, 0.22, -1.2]
    assert rf.swing == [None, True, False, None], "the sample's word, or the command's"
    assert lf.swing == [None], "without lengths nobody knows"


def test_places_are_of_the_newest_tick_in_the_angles_of_the_description() -> None:
    leg = replace(ROBOT.leg("rf"), mount=Mount(xyz_m=(0.1, -0.1, 0.0), yaw_rad=-0.5))
    trace = LegTrace(leg="rf", number=1, measured=[[0.0] * 3, [0.1, 0.2, -1.2]])
    assert placed(trace, leg).places_m == leg.outline([0.1, 0.5 - 0.2, -1.2])
    assert placed(LegTrace(leg="rf", number=1), leg).places_m == []
    assert placed(trace, ROBOT.leg("rf")).places_m == [], "where it is mounted is not described"
