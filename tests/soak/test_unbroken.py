"""A leg that is late after a fault: by the fault, or by a touch that is missed without it, too."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import COUNTED, ROWS, Events, Gatherer, LegOutcome, match
from adaptive_contact.service.recording import read_recording

pytest.importorskip("mujoco")

from adaptive_contact_sim.recorder import TickRecorder
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.walk import WalkSettings

from .arrival import SourceClock
from .conduct import Broken
from .made import S, event
from .recovery import recovery_of
from .test_recovery import outcome
from .unbroken import missed_anyway, unbroken

FAULT = Broken("service", 8 * S, 10 * S)
TOUCHES = [9.9, 11.5, 12.9, 14.3]
CLOCK = SourceClock({})


def anyway(heard: LegOutcome, without_fault: LegOutcome, right_s: float | None) -> bool:
    asked: list[int] = []

    def other(until_ns: int) -> LegOutcome:
        asked.append(until_ns)
        return without_fault

    right_ns = None if right_s is None else int(right_s * S)
    said = missed_anyway(heard, other, FAULT, right_ns, CLOCK)
    found = np.flatnonzero(heard.touches.found & (heard.touches.onset_ns > 10.5 * S))
    # No learner is taken through half an hour of samples for a leg that was never right again.
    assert asked == [int(heard.touches.onset_ns[k]) + 120_000_000 for k in found[:1]]
    return said


@pytest.mark.parametrize(
    ("found", "without_fault", "right_s", "excused"),
    [
        pytest.param("1011", "1011", 12.92, True, id="nobody finds the first"),
        pytest.param("1011", "1111", 12.92, False, id="the other does"),
        pytest.param("1001", "1011", 14.32, False, id="the other finds the second"),
        pytest.param("1001", "1001", 14.32, True, id="nobody finds the first two"),
        pytest.param("1011", "1011", 19.0, False, id="found, but told six seconds later"),
        pytest.param("1011", "1000", 12.92, False, id="the other finds none at all"),
        pytest.param("1000", "1000", None, False, id="never right again"),
    ],
)
def test_only_touches_that_nobody_finds_excuse_a_leg(
    found: str, without_fault: str, right_s: float | None, excused: bool
) -> None:
    heard = outcome(TOUCHES, [c == "1" for c in found])
    other = outcome(TOUCHES, [c == "1" for c in without_fault])
    assert anyway(heard, other, right_s) is excused


def test_a_touch_that_does_not_count_makes_no_leg_late() -> None:
    grazing = next(i for i, row in enumerate(ROWS) if row not in COUNTED)
    heard = outcome(TOUCHES, [True, False, True, True])
    rows = np.array([0, grazing, 0, 0])
    grazed = dataclasses.replace(heard, touches=heard.touches._replace(row=rows))
    right = {"rf": [(int(12.93 * S), event(0, t_ns=int(12.92 * S)))]}
    assert recovery_of(FAULT, ("rf",), right, [heard], CLOCK)[1] == ["rf"]
    assert recovery_of(FAULT, ("rf",), right, [grazed], CLOCK)[1] == []


def test_a_learner_that_nobody_broke_tells_what_a_learner_tells(tmp_path: Path) -> None:
    """Up to the time that is asked for, and no further."""
    path = tmp_path / "walk.mcap"
    sim = Simulation(SimulationSettings(motion=WalkSettings(), seed=3))
    learner = ContactLearner(shipped_robot(), "rf", shipped_baseline(shipped_robot().name))
    told = []
    with TickRecorder(path, sim) as recorder:
        for tick in sim.run(12.0):
            recorder.write(tick)
            event = learner.update(tick.samples["rf"])
            if event is not None and tick.samples["rf"].t_ns <= 8 * S:
                told.append(event)
    gathered = Gatherer(shipped_robot())
    for record in read_recording(path):
        gathered.take(record)
    stream = gathered.stream("rf")
    alone = unbroken(path, stream, shipped_robot(), until_ns=8 * S)
    expected = match(stream, Events.of(told))
    np.testing.assert_array_equal(alone.touches.found, expected.touches.found)
    assert alone.touches.found[alone.touches.onset_ns < 7 * S].mean() > 0.9
    assert not alone.touches.found[alone.touches.onset_ns > 8 * S].any()
