"""Recordings: what a stagehand does, and what the truth says of it."""

from __future__ import annotations

import pickle
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import foot, shipped_robot
from adaptive_contact.score import LegStream, TruthChanges, contacts_of
from adaptive_contact.wire import Drift
from adaptive_contact_sim.arrays import LegArrays, Run, record_arrays
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.scenarios.replay import Replayed, hold, recorded, replayed, touching
from adaptive_contact_studies.scenarios.spec import RecordingSpec, ReplaySpec, Staging, Variant
from adaptive_contact_studies.work import Work

POSE = SimulationSettings(
    motion=PoseSettings(legs=("lm",), obstacles=ObstacleSettings(probability=0.5)), seed=9100
)
SPEC = RecordingSpec(POSE, 4.0, ("lm",))


def record(spec: RecordingSpec) -> tuple[Run, LegArrays]:
    run, _ = recorded(Work(None), spec)
    return run, run.legs["lm"]


def stream_of(spec: RecordingSpec) -> LegStream:
    found = replayed(Work(None), ReplaySpec(spec, variants=(Variant.FROZEN,)))
    assert isinstance(found, Replayed)
    return found.streams["lm"]


def test_it_is_the_simulators_own_stream() -> None:
    own, other = record(SPEC)[1], record_arrays(POSE, 4.0).legs["lm"]
    for name in ("measured", "desired", "swing"):
        np.testing.assert_array_equal(getattr(own, name), getattr(other, name))
    for mine, theirs in zip(stream_of(SPEC).truth, other.truth, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_every_setting_decides_the_key() -> None:
    drift = (Injection(Drift(kind="friction", value=4.0, leg="lm"), 1.0),)
    others = [
        replace(SPEC, seconds=5.0),
        replace(SPEC, legs=("lm", "lf")),
        replace(SPEC, staging=Staging(level_m=-0.04)),
        replace(SPEC, staging=Staging(caught_s=(1.0, 2.0))),
        replace(SPEC, staging=Staging(caught_s=(1.0, 2.0), trails_n=2.0)),
        replace(SPEC, settings=replace(POSE, seed=9101)),
        replace(SPEC, settings=replace(POSE, robot_seed=1)),
        replace(SPEC, settings=replace(POSE, drift=drift)),
        replace(SPEC, settings=replace(POSE, motion=WalkSettings())),
    ]
    keys = [repr(spec) for spec in (SPEC, replace(SPEC), *others)]
    assert len(set(keys)) == len(others) + 1
    assert [repr(pickle.loads(pickle.dumps(spec))) for spec in (SPEC, SPEC, *others)] == keys


def test_samples_say_which_readings_are_bad() -> None:
    faulty = replace(POSE, encoder=replace(POSE.encoder, dropped=0.1))
    run, leg = record(RecordingSpec(faulty, 2.0, ("lm",)))
    bad = ~leg.valid.all(axis=1)
    assert bad.any()
    for sample, expected in zip(samples_of(run, "lm"), bad.tolist(), strict=True):
        assert (sample.valid is not None) == expected
        assert sample.valid is None or not all(sample.valid)


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


def test_obstacles_can_stand_level() -> None:
    motion = PoseSettings(
        legs=("lm",), obstacles=ObstacleSettings(probability=1.0, shapes=("plate",))
    )
    spec = RecordingSpec(replace(POSE, motion=motion), 12.0, ("lm",), Staging(level_m=-0.045))
    run, leg = record(spec)
    described = shipped_robot().leg("lm")
    assert described.lengths_m is not None
    height = foot(leg.measured, described.lengths_m, described.joint_axes)[:, 2]
    contacts = contacts_of(leg.truth, 0)
    onset = contacts.onset_ns[contacts.touch & (contacts.onset_ns > 2e9)]
    at = height[np.searchsorted(run.t_ns, onset)]
    assert len(at) >= 18
    assert np.std(at) < 0.004


def test_contacts_can_be_switched_on_and_off() -> None:
    staged = replace(
        SPEC, seconds=16.0, staging=Staging(contacts=((0.0, 0.0), (6.0, 1.0), (11.0, 0.0)))
    )
    truth = record(staged)[1].truth
    begun = truth.t_ns[truth.contact] / 1e9
    assert not ((begun > 1.5) & (begun < 6.0)).any()
    assert np.count_nonzero((begun > 6.0) & (begun < 11.5)) >= 6
    assert not (begun > 12.5).any()


def test_obstacles_cannot_be_staged_in_a_walk() -> None:
    walk = replace(POSE, motion=WalkSettings())
    with pytest.raises(ConfigurationError, match="in pose only"):
        record(RecordingSpec(walk, 1.0, ("lm",), Staging(level_m=-0.04)))


def test_a_caught_foot_stays_and_the_truth_says_so() -> None:
    spec = replace(SPEC, seconds=10.0, staging=Staging(caught_s=(3.0, 7.0)))
    (run, leg), stream = record(spec), stream_of(spec)
    described = shipped_robot().leg("lm")
    assert described.lengths_m is not None
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


def test_holding_a_contact_overrides_what_was_told_in_between() -> None:
    truth = TruthChanges(
        t_ns=np.array([0, 100, 200, 300, 400]),
        contact=np.array([False, True, False, True, False]),
        speed_m_s=np.full(5, 0.3),
        soft=np.zeros(5, dtype=bool),
        grazing=np.zeros(5, dtype=bool),
        force_n=np.ones(5),
    )
    held = hold(truth, 50, 320)
    assert held.t_ns.tolist() == [0, 50, 320, 400]
    assert held.contact.tolist() == [False, True, True, False]
    ended = hold(truth, 50, 250)
    assert ended.t_ns.tolist() == [0, 50, 250, 300, 400]
    assert ended.contact.tolist() == [False, True, False, True, False]
