from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact_sim import Simulation, SimulationSettings, TerrainSettings, WalkSettings
from adaptive_contact_sim.arrays import Run, record_arrays
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import LegGeometry
from tests.sim.touches import touches_of

Array = NDArray[np.float64]


def walk(gait: str = "tripod", kind: str = "rough", seconds: float = 20.0, **motion: object) -> Run:
    return record_arrays(
        SimulationSettings(
            motion=WalkSettings(gait=gait, **motion), terrain=TerrainSettings(kind=kind), seed=11
        ),
        seconds,
    )


@pytest.mark.parametrize(
    ("gait", "kind"),
    [
        ("tripod", "rough"),
        ("ripple", "flat"),
        ("wave", "rough"),
        pytest.param("ripple", "rough", marks=pytest.mark.slow),
        pytest.param("tripod", "steps", marks=pytest.mark.slow),
        pytest.param("tripod", "soft", marks=pytest.mark.slow),
    ],
)
def test_it_walks_and_touches(gait: str, kind: str) -> None:
    run = walk(gait, kind)
    way = np.linalg.norm(np.diff(run.position_m[::50, :2], axis=0), axis=1).sum()
    pace = {"tripod": 0.04, "ripple": 0.02, "wave": 0.008}[gait]
    assert way > pace * 20.0
    assert np.abs(run.position_m[:, :2]).max() < 2.3
    assert run.position_m[:, 2].min() > 0.07
    assert np.degrees(np.arccos(run.rotation[:, 2, 2].clip(-1, 1))).max() < 14.0
    speeds, left = [], []
    for leg in LEGS:
        stream = run.legs[leg]
        swings = np.flatnonzero(np.diff(stream.swing.astype(int)) == 1)
        in_swing = [(k, o) for k, o in touches_of(run, leg) if k > 50 and stream.swing[k]]
        assert len(in_swing) >= 0.8 * (len(swings) - 1)
        for k, onset in in_swing:
            speeds.append(onset.speed_m_s)
            after = stream.swing[k + 1 :]
            if after.all():
                continue
            left.append(int(np.argmin(after)))
    assert np.median(speeds) > 0.25
    # The command goes on for 60 ms after a touch: three more samples say swing.
    assert np.mean(np.array(left) >= 3) > 0.9
    assert np.median(left) == 3


def planned(kind: str, **motion: object) -> list[tuple[float | None, Array]]:
    """Per swing: ms from the turn to the first touch (None: not before the next), the stream."""
    run = walk(kind=kind, seconds=40.0, phase="planned", **motion)
    found = []
    for leg in LEGS:
        stream = run.legs[leg]
        edges = np.diff(stream.swing.astype(int))
        starts, turns = np.flatnonzero(edges == 1) + 1, np.flatnonzero(edges == -1) + 1
        onsets = np.array([onset.t_ns for onset in stream.onsets])
        for turn in turns[turns < starts[-1]]:
            begin, end = starts[starts < turn][-1] + 10, starts[starts > turn][0]
            inside = onsets[(onsets > run.t_ns[begin]) & (onsets < run.t_ns[end])]
            ms = float(inside[0] - run.t_ns[turn]) / 1e6 if len(inside) else None
            found.append((ms, stream.desired[turn - 1 : turn + 2]))
    return found


def test_a_planned_turn_comes_before_the_touch() -> None:
    swings = planned("flat")
    after = np.array([ms for ms, _ in swings if ms is not None])
    assert len(after) > 0.98 * len(swings) > 100
    # The servos bring the foot down some 70 ms after its command.
    assert 20.0 < np.median(after) < 90.0
    assert (after > 0.0).mean() > 0.9
    # The command goes no deeper from the turn on: it moves as in stance.
    geometry = LegGeometry()
    feet = [geometry.feet(np.repeat(d[:, None], len(LEGS), axis=1))[:, 0, 2] for _, d in swings]
    last, turned, then = np.transpose(feet)
    assert (turned < last).all()
    assert np.median(last - turned) > 0.004
    assert np.abs(then - turned).max() < 0.002


def test_a_stale_word_of_the_service_does_not_stop_the_next_swing() -> None:
    settings = SimulationSettings(
        motion=WalkSettings(stop_on="service"), terrain=TerrainSettings(kind="flat"), seed=3
    )
    free, stale = Simulation(settings), Simulation(settings)
    lifting = 0
    for k in range(150):
        for i, leg in enumerate(LEGS):
            # Before any swing, and all through the first third of each: it is not a descent yet.
            if k == 0 or (free.phase[i] == "swing" and lifting < 8):
                stale.notify_contact(leg)
        lifting = lifting + 1 if "swing" in free.phase else 0
        free.advance()
        stale.advance()
        assert free.phase == stale.phase
