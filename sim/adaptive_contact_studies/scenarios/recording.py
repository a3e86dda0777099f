"""Recordings of scenarios: simulated once, kept on disk, read back as the learners' samples.

A recording holds what a learner may see of the kept legs and the truth about them; nothing else of
the simulation.  Files are named by a hash of everything that decides their content, the
simulator's behaviour included, and are written whole or not at all.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import adaptive_contact_sim
from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.score import (
    TruthChanges,
    contacts_of,
    truth_changes,
)
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.arrays import record_run
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.cache import code_digest, name_of, read_arrays, write_arrays
from adaptive_contact_studies.scenarios import staging
from adaptive_contact_studies.scenarios.spec import RecordingSpec
from adaptive_contact_studies.scenarios.staging import stagehand

FORMAT: Final = 1
_TRUTH: Final = TruthChanges._fields


@dataclass(frozen=True, eq=False)
class LegRecord:
    """One leg's stream, row k being control tick k."""

    measured: Array  # (n, J) rad, read at the start of tick k
    desired: Array  # (n, J) rad, written right after
    valid: Mask  # (n, J) readings known to be good
    swing: Mask  # (n,) the phase of tick k
    truth: TruthChanges  # changes of its true contact


@dataclass(frozen=True, eq=False)
class Recording:
    """The kept legs of a run."""

    t_ns: Ints  # (n,) time stamps of the ticks
    legs: dict[str, LegRecord]  # by name

    def touching(self, leg: str) -> Mask:
        """(n,) whether the leg touched anything between the sample before and this one."""
        contacts = contacts_of(self.legs[leg].truth, int(self.t_ns[0]))
        before = np.concatenate((self.t_ns[:1], self.t_ns[:-1]))
        begun = np.searchsorted(contacts.onset_ns, self.t_ns, side="right")
        ended = np.searchsorted(contacts.release_ns, before, side="right")
        return np.asarray(begun > ended)


def record(spec: RecordingSpec) -> Recording:
    """Simulate, as fast as possible.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    sim = Simulation(spec.settings)
    with stagehand(sim, spec.staging, spec.legs[0]) as hand:
        run = record_run(sim, spec.seconds, legs=spec.legs, before_tick=hand.before_tick)
    legs = {}
    for leg, of in run.legs.items():
        truth = of.truth
        if hand.held_ns is not None and leg == spec.legs[0]:
            truth = hold(truth, *hand.held_ns)
        legs[leg] = LegRecord(of.measured, of.desired, of.valid, of.swing, truth)
    return Recording(run.t_ns, legs)


def hold(truth: TruthChanges, from_ns: int, to_ns: int) -> TruthChanges:
    """Truth with a contact added that holds from one time to another.

    Args:
        truth: in order of time.
        from_ns: when it begins; what the truth says from here on is lost.
        to_ns: when it ends; what the truth last said by then holds afterwards.
    """
    inside = (truth.t_ns >= from_ns) & (truth.t_ns <= to_ns)
    until = truth.t_ns <= to_ns
    after = bool(truth.contact[until][-1]) if until.any() else False
    rest = TruthChanges._make(column[~inside] for column in truth)
    ends = [(from_ns, True), (to_ns, after)]
    held = [ContactTruth(t_ns=t, contact=on, force=0.0, surface="soft") for t, on in ends]
    added = truth_changes(held)
    both = TruthChanges._make(np.concatenate(pair) for pair in zip(rest, added, strict=True))
    order = np.argsort(both.t_ns, kind="stable")
    return TruthChanges._make(column[order] for column in both)


def save(recording: Recording, path: Path) -> None:
    """Write a recording, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    arrays: dict[str, NDArray[Any]] = {"t_ns": recording.t_ns}
    for leg, of in recording.legs.items():
        arrays |= {f"{leg}.{name}": getattr(of, name) for name in _STREAMS}
        arrays |= {f"{leg}.truth.{name}": getattr(of.truth, name) for name in _TRUTH}
    write_arrays(path, arrays)


def load(path: Path) -> Recording | None:
    """Read a recording; None where there is none, or none that can be read."""
    arrays = read_arrays(path)
    if arrays is None or "t_ns" not in arrays:
        return None
    names = dict.fromkeys(name.split(".", 1)[0] for name in arrays if "." in name)
    return Recording(arrays["t_ns"], {leg: _leg(arrays, leg) for leg in names})


def made(spec: RecordingSpec, folder: Path) -> Recording:
    """The recording, simulated now unless the folder has it.

    Raises:
        ConfigurationError: it cannot be written.
        SimulationDivergedError: the physics blew up.
    """
    path = file_of(spec, folder)
    found = load(path)
    if found is None:
        found = record(spec)
        save(found, path)
    return found


def file_of(spec: RecordingSpec, folder: Path) -> Path:
    """Where a recording lives."""
    return folder / f"{key_of(spec)}.npz"


def key_of(spec: RecordingSpec) -> str:
    """Hash of everything that decides a recording."""
    return name_of(FORMAT, simulator_fingerprint(spec.settings.robot), _unseen_code(), spec)


@functools.cache
def simulator_fingerprint(robot: str = "hexapod") -> str:
    """Hash of what the simulator does in a second of all that a robot does.

    Of the hexapod that is a pose of one leg and of a tripod, and a walk; others do one of both.
    """
    from adaptive_contact.wire import Drift

    drift = (
        Injection(Drift(kind="friction", value=4.0), 0.5),
        Injection(Drift(kind="mass", value=0.1), 0.5),
    )
    alone = PoseSettings(obstacles=ObstacleSettings(probability=1.0, soft=0.5))
    pose = SimulationSettings(motion=alone, seed=7, drift=drift)
    walk = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=7, drift=drift
    )
    tripod = TRIPODS[0]
    together = PoseGroupSettings(tuple(replace(alone, legs=(leg,)) for leg in tripod))
    group = replace(pose, motion=together)
    digest = hashlib.sha256()
    runs: list[tuple[SimulationSettings, tuple[str, ...]]] = [
        *((pose, ("rf",)), (replace(pose, drift=()), ("rf",)), (walk, ("rf",)), (group, tripod))
    ]
    if robot != walk.robot:
        known = simulated_robot(robot)
        own = SimulationSettings.of(robot, "pose" if known.walk is None else "walk")
        runs = [(replace(own, seed=7, drift=drift), known.layout.legs)]
    for settings, legs in runs:
        recording = record(RecordingSpec(settings, 1.5, legs))
        for name in legs:
            leg = recording.legs[name]
            for array in (leg.measured, leg.desired, leg.swing, *leg.truth):
                digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


@functools.cache
def _unseen_code() -> str:
    """Hash of the code that decides recordings, but not the short runs of the fingerprint."""
    simulator = Path(adaptive_contact_sim.__file__).parent
    digest = hashlib.sha256()
    for file in (Path(staging.__file__), *(simulator / name for name in _UNSEEN)):
        # Recordings on disk are from when the scenarios were a folder of the simulator.
        code = file.read_text(encoding="utf-8").replace(*_MOVED)
        digest.update(code_digest(code).encode())
    return digest.hexdigest()[:16]


_MOVED: Final = ("adaptive_contact_studies.scenarios", "adaptive_contact_sim.trials")
# Besides what holds feet: backlash, faults of encoders, other grounds, how drifts grow.
_UNSEEN: Final = ("gear.py", "encoder.py", "terrain.py", "drift.py")
_STREAMS: Final = ("measured", "desired", "valid", "swing")


def _leg(arrays: Mapping[str, NDArray[Any]], leg: str) -> LegRecord:
    truth = TruthChanges._make(arrays[f"{leg}.truth.{name}"] for name in _TRUTH)
    return LegRecord(**{name: arrays[f"{leg}.{name}"] for name in _STREAMS}, truth=truth)
