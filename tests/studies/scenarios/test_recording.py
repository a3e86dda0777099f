"""Recordings: what is kept, what a stagehand does, what decides a file's name."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import foot, shipped_robot
from adaptive_contact.score import TruthChanges, contacts_of
from adaptive_contact.wire import Drift
from adaptive_contact_sim.arrays import record_arrays
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.cache import code_digest, learner_sources
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.scenarios.recording import (
    LegRecord,
    Recording,
    file_of,
    hold,
    key_of,
    load,
    made,
    record,
    save,
)
from adaptive_contact_studies.scenarios.spec import RecordingSpec, Staging

POSE = SimulationSettings(
    motion=PoseSettings(legs=("lm",), obstacles=ObstacleSettings(probability=0.5)), seed=9100
)
SPEC = RecordingSpec(POSE, 4.0, ("lm",))


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record(SPEC)


def test_it_is_the_simulators_own_stream(recording: Recording) -> None:
    run = record_arrays(POSE, 4.0)
    own, other = recording.legs["lm"], run.legs["lm"]
    np.testing.assert_array_equal(recording.t_ns, run.t_ns)
    np.testing.assert_array_equal(own.measured, other.measured)
    np.testing.assert_array_equal(own.desired, other.desired)
    np.testing.assert_array_equal(own.swing, other.swing)
    messages = other.changes
    assert own.truth.t_ns.tolist() == [m.t_ns for m in messages]
    assert own.truth.contact.tolist() == [m.contact for m in messages]
    assert own.truth.grazing.tolist() == [m.grazing for m in messages]
    speeds = [np.nan if m.speed_m_s is None else m.speed_m_s for m in messages]
    np.testing.assert_array_equal(own.truth.speed_m_s, speeds)


def test_a_file_gives_back_what_was_saved(recording: Recording, tmp_path: Path) -> None:
    save(recording, tmp_path / "r.npz")
    back = load(tmp_path / "r.npz")
    assert back is not None
    for name in ("measured", "desired", "valid", "swing"):
        np.testing.assert_array_equal(
            getattr(back.legs["lm"], name), getattr(recording.legs["lm"], name)
        )
    for mine, theirs in zip(recording.legs["lm"].truth, back.legs["lm"].truth, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert samples_of(back, "lm") == samples_of(recording, "lm")


def test_a_damaged_file_is_made_anew(recording: Recording, tmp_path: Path) -> None:
    path = file_of(SPEC, tmp_path)
    path.write_bytes(b"PK\x03\x04 half of it")
    assert load(path) is None
    again = made(SPEC, tmp_path)
    np.testing.assert_array_equal(again.legs["lm"].measured, recording.legs["lm"].measured)
    assert load(path) is not None


def test_a_folder_that_cannot_be_written_is_told_in_one_line(
    recording: Recording, tmp_path: Path
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        save(recording, tmp_path / "absent" / "r.npz")
    assert "\n" not in str(caught.value)


def test_every_setting_decides_the_key() -> None:
    drift = (Injection(Drift(kind="friction", value=4.0), 1.0),)
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
    assert len({key_of(spec) for spec in (SPEC, replace(SPEC), *others)}) == len(others) + 1


def test_another_process_finds_the_same_file() -> None:
    drift = (Injection(Drift(kind="friction", value=4.0, leg="lm"), 1.0),)
    spec = replace(SPEC, settings=replace(POSE, drift=drift))
    assert key_of(pickle.loads(pickle.dumps(spec))) == key_of(spec)


def test_samples_tell_bad_readings() -> None:
    faulty = replace(POSE, encoder=replace(POSE.encoder, dropped=0.1))
    taken = record(RecordingSpec(faulty, 2.0, ("lm",)))
    samples = samples_of(taken, "lm")
    bad = ~taken.legs["lm"].valid.all(axis=1)
    assert bad.any()
    for sample, told in zip(samples, bad.tolist(), strict=True):
        assert (sample.valid is not None) == told
        assert sample.valid is None or not all(sample.valid)


def test_a_contact_covers_the_tick_in_which_it_ends() -> None:
    """The motion between two samples knows of a contact that held for any part of it."""
    tick = 20_000_000
    times = np.arange(10, dtype=np.int64) * tick
    truth = TruthChanges(
        t_ns=np.array([0, 2 * tick + 1, 6 * tick + 1, 7 * tick + 1]),
        contact=np.array([False, False, True, False]),
        speed_m_s=np.zeros(4),
        soft=np.zeros(4, dtype=bool),
        grazing=np.zeros(4, dtype=bool),
        force_n=np.zeros(4),
    )
    blank, flags = np.zeros((10, 3)), np.zeros(10, dtype=bool)
    leg = LegRecord(blank, blank, np.ones((10, 3), dtype=bool), flags, truth)
    touching = Recording(times, {"lm": leg}).touching("lm")
    # Begun between 6 and 7, ended between 7 and 8.
    assert np.flatnonzero(touching).tolist() == [7, 8]


def test_obstacles_can_stand_level() -> None:
    motion = PoseSettings(
        legs=("lm",), obstacles=ObstacleSettings(probability=1.0, shapes=("plate",))
    )
    spec = RecordingSpec(replace(POSE, motion=motion), 12.0, ("lm",), Staging(level_m=-0.045))
    taken = record(spec)
    leg, described = taken.legs["lm"], shipped_robot().leg("lm")
    assert described.lengths_m is not None
    height = foot(leg.measured, described.lengths_m, described.joint_axes)[:, 2]
    contacts = contacts_of(leg.truth, 0)
    onset = contacts.onset_ns[contacts.touch & (contacts.onset_ns > 2e9)]
    at = height[np.searchsorted(taken.t_ns, onset)]
    assert len(at) >= 18
    assert np.std(at) < 0.004


def test_contacts_can_be_switched_on_and_off() -> None:
    staged = replace(
        SPEC, seconds=16.0, staging=Staging(contacts=((0.0, 0.0), (6.0, 1.0), (11.0, 0.0)))
    )
    truth = record(staged).legs["lm"].truth
    begun = truth.t_ns[truth.contact] / 1e9
    assert not ((begun > 1.5) & (begun < 6.0)).any()
    assert np.count_nonzero((begun > 6.0) & (begun < 11.5)) >= 6
    assert not (begun > 12.5).any()


def test_obstacles_cannot_be_staged_in_a_walk() -> None:
    walk = replace(POSE, motion=WalkSettings())
    with pytest.raises(ConfigurationError, match="in pose only"):
        record(RecordingSpec(walk, 1.0, ("lm",), Staging(level_m=-0.04)))


def test_a_caught_foot_stays_and_the_truth_says_so() -> None:
    taken = record(replace(SPEC, seconds=10.0, staging=Staging(caught_s=(3.0, 7.0))))
    leg, described = taken.legs["lm"], shipped_robot().leg("lm")
    assert described.lengths_m is not None
    real = foot(leg.measured, described.lengths_m, described.joint_axes)
    wanted = foot(leg.desired, described.lengths_m, described.joint_axes)
    t = taken.t_ns / 1e9
    caught, free = (t > 4.0) & (t < 6.9), (t > 8.0)
    # The body sways instead: the foot leaves its place far less than it is told to.
    assert np.ptp(real[caught], axis=0).max() < 0.8 * np.ptp(wanted[caught], axis=0).max()
    assert np.abs(real - wanted)[caught].max() > np.abs(real - wanted)[free].max()
    assert taken.touching("lm")[caught].all()
    assert not taken.touching("lm")[free].all()
    begin = leg.truth.t_ns[np.searchsorted(leg.truth.t_ns, 3e9)]
    assert 3e9 <= begin <= 3.6e9
    assert mujoco.get_mjcb_passive() is None


def test_what_a_foot_trails_slows_it_and_is_no_touch() -> None:
    free = record(replace(SPEC, seconds=7.0))
    staging = Staging(caught_s=(3.0, 5.0), trails_n=4.0)
    trailing = record(replace(SPEC, seconds=7.0, staging=staging))
    t = free.t_ns / 1e9

    def behind(taken: Recording, during: NDArray[np.bool_]) -> float:
        leg = taken.legs["lm"]
        return float(np.abs(leg.measured - leg.desired)[during & leg.swing].mean())

    inside, before = (t > 3.6) & (t < 5.0), t < 3.0
    assert behind(trailing, inside) > 1.1 * behind(free, inside)
    assert behind(trailing, before) == behind(free, before)
    # A hold would be a contact through whole swings.
    lifted = inside & trailing.legs["lm"].swing
    assert trailing.touching("lm")[lifted].mean() < 0.6
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


def test_words_about_the_simulator_void_no_recording_and_its_constants_do() -> None:
    code = (
        '"""Holds feet."""\nSPRING = 3000.0\ndef hold(x):\n    """Hold."""\n    return SPRING * x'
    )
    words = code.replace("Hold.", "It is held.").replace("= 3000.0", "= 3000.0  # N/m")
    assert code_digest(words) == code_digest(code)
    assert code_digest(code.replace("3000.0", "50.0")) != code_digest(code)


def test_all_that_decides_what_a_learner_does_voids_its_replays() -> None:
    """Whatever the bank of learners imports, but messages, files and errors."""
    code = """
import sys
import adaptive_contact.bank
names = [name for name in sys.modules if name.startswith("adaptive_contact.")]
print("\\n".join(sys.modules[name].__file__ for name in names))
"""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    imported = {Path(line) for line in done.stdout.splitlines()}
    others = imported - set(learner_sources())
    assert {p.parent.name if p.parent.name == "wire" else p.name for p in others} == {
        "errors.py", "files.py", "wire",
    }  # fmt: skip
