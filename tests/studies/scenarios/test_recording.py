"""Recordings: what a stagehand does, and what the truth says of it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot import foot, shipped_robot
from adaptive_contact.score import LegStream, TruthChanges
from adaptive_contact_sim import ObstacleSettings, PoseSettings, SimulationSettings
from adaptive_contact_sim.arrays import LegArrays, Run, record_arrays
from adaptive_contact_studies.scenarios.replay import recorded, replayed, touching
from adaptive_contact_studies.scenarios.spec import RecordingSpec, ReplaySpec, Staging
from adaptive_contact_studies.work import Work

POSE = SimulationSettings(
    motion=PoseSettings(legs=("lm",), obstacles=ObstacleSettings(probability=0.5)), seed=9100
)
SPEC = RecordingSpec(POSE, 4.0, ("lm",))


def record(spec: RecordingSpec) -> tuple[Run, LegArrays]:
    run, _ = recorded(Work(None), spec)
    return run, run.legs["lm"]


def stream_of(spec: RecordingSpec) -> LegStream:
    found = replayed(Work(None), ReplaySpec(spec, variants=("frozen",)))
    return found.streams["lm"]


def test_it_is_the_simulators_own_stream() -> None:
    own, other = record(SPEC)[1], record_arrays(POSE, 4.0).legs["lm"]
    for name in ("measured", "desired", "swing"):
        np.testing.assert_array_equal(getattr(own, name), getattr(other, name))
    for mine, theirs in zip(stream_of(SPEC).truth, other.truth, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_a_contact_covers_the_tick_in_which_it_ends() -> None:
    """The motion between two samples knows of a contact that held for any part of it."""
    tick = 20_000_000
    truth = TruthChanges(
        t_ns=np.array([0, 2 * tick + 1, 6 * tick + 1, 7 * tick + 1]),
        contact=np.array([False, False, True, False]),
        speed_m_s=np.zeros(4),
        soft=np.zeros(4, dtype=bool),
        grazing=np.zeros(4, dtype=bool),
        force_n=np.zeros(4),
    )
    times = np.arange(10, dtype=np.int64) * tick
    stream = LegStream("lm", times, np.zeros(10, dtype=bool), truth)
    # Begun between 6 and 7, ended between 7 and 8.
    assert np.flatnonzero(touching(stream)).tolist() == [7, 8]


def test_a_caught_foot_stays_and_the_truth_says_so() -> None:
    spec = replace(SPEC, seconds=10.0, staging=Staging(caught_s=(3.0, 7.0)))
    (run, leg), stream = record(spec), stream_of(spec)
    described = shipped_robot().leg("lm")
    real = foot(leg.measured, described.lengths_m, described.joint_axes)
    wanted = foot(leg.desired, described.lengths_m, described.joint_axes)
    t = run.t_ns / 1e9
    caught, free = (t > 4.0) & (t < 6.9), (t > 8.0)
    # The body sways instead: the foot leaves its place far less than it is told to.
    assert np.ptp(real[caught], axis=0).max() < 0.8 * np.ptp(wanted[caught], axis=0).max()
    assert np.abs(real - wanted)[caught].max() > np.abs(real - wanted)[free].max()
    assert touching(stream)[caught].all()
    assert not touching(stream)[free].all()
    begin = stream.truth.t_ns[np.searchsorted(stream.truth.t_ns, 3e9)]
    assert 3e9 <= begin <= 3.6e9
    assert mujoco.get_mjcb_passive() is None


def test_what_a_foot_trails_slows_it_and_is_no_touch() -> None:
    run, free = record(replace(SPEC, seconds=7.0))
    staging = Staging(caught_s=(3.0, 5.0), trails_n=4.0)
    spec = replace(SPEC, seconds=7.0, staging=staging)
    trailing = record(spec)[1]
    t = run.t_ns / 1e9

    def behind(leg: LegArrays, during: NDArray[np.bool_]) -> float:
        return float(np.abs(leg.measured - leg.desired)[during & leg.swing].mean())

    inside, before = (t > 3.6) & (t < 5.0), t < 3.0
    assert behind(trailing, inside) > 1.1 * behind(free, inside)
    assert behind(trailing, before) == behind(free, before)
    # A hold would be a contact through whole swings.
    lifted = inside & trailing.swing
    assert touching(stream_of(spec))[lifted].mean() < 0.6
    assert mujoco.get_mjcb_passive() is None
