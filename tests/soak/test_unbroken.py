"""A leg that is late after a fault: by the fault, or by a touch that is missed without it, too."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.adapt import ContactLearner, shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.score import COUNTED, ROWS, Events, Gatherer, match
from adaptive_contact.service.recording import read_recording

pytest.importorskip("mujoco")

from adaptive_contact_sim.recorder import TickRecorder
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.soak.unbroken import missed_anyway, unbroken
from adaptive_contact_sim.walk import WalkSettings

from .made import S
from .test_recovery import outcome

FAULT_OVER = 10 * S
TOUCHES = [9.9, 11.5, 12.9, 14.3]


@pytest.mark.parametrize(
    ("found", "without_fault", "anyway"),
    [
        ([True, False, True, True], [True, False, True, True], True),
        ([True, False, True, True], [True, True, True, True], False),
        ([True, False, False, True], [True, False, True, True], False),
        ([True, False, False, True], [True, False, False, True], True),
        ([True, False, False, False], [True, False, False, False], False),  # never right again
        ([True, True, True, True], [True, False, True, True], False),  # nothing was missed
    ],
)
def test_only_touches_that_nobody_finds_excuse_a_leg(
    found: list[bool], without_fault: list[bool], anyway: bool
) -> None:
    heard, other = outcome(TOUCHES, found), outcome(TOUCHES, without_fault)
    assert missed_anyway(heard, other, FAULT_OVER) is anyway


def test_touches_that_do_not_count_excuse_nobody() -> None:
    heard = outcome(TOUCHES, [True, False, True, True])
    grazing = next(i for i, row in enumerate(ROWS) if row not in COUNTED)
    rows = np.array([0, grazing, 0, 0])
    heard = dataclasses.replace(heard, touches=heard.touches._replace(row=rows))
    assert missed_anyway(heard, heard, FAULT_OVER) is False


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
    expected = match(
        stream,
        Events(
            np.array([e.t_ns for e in told], dtype=np.int64),
            np.array([e.contact for e in told], dtype=np.bool_),
            np.array([e.onset_ns for e in told], dtype=np.int64),
        ),
    )
    np.testing.assert_array_equal(alone.touches.found, expected.touches.found)
    assert alone.touches.found[alone.touches.onset_ns < 7 * S].mean() > 0.9
    assert not alone.touches.found[alone.touches.onset_ns > 8 * S].any()
