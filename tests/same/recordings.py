"""Recordings on which revisions are compared: made once, from seeds, and kept.

A recording is a row of rounds, each with at most one sample per leg, and with it what the learners
start from.  Every revision replays the very same files, so that a change of the simulator between
two revisions does not count.
"""

from __future__ import annotations

import concurrent.futures
import copy
import hashlib
import json
import math
import re
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np

import quadruped_stand
from adaptive_contact.fit.train import learn
from adaptive_contact.model import Window, save_baseline
from adaptive_contact.robot import parse_robot
from adaptive_contact_sim import (
    EncoderSettings,
    ObstacleSettings,
    PoseGroupSettings,
    PoseSettings,
    SimulationSettings,
    record_arrays,
)
from adaptive_contact_studies.scenarios.spec import Staging
from adaptive_contact_studies.training import stretch_of

from .simulated import (
    CHANGE_S,
    LONG_POSE_S,
    PERIOD_NS,
    TRIPOD,
    Recording,
    Round,
    Sample,
    Spoiler,
    change,
    hexapod,
    hexapod_pose,
    hexapod_walk,
    looks_of,
    plain,
    shipped,
    simulated,
)

__all__ = ["RECIPES", "Recording", "kept"]


def kept(folder: Path, names: Sequence[str], *, processes: int = 2) -> dict[str, Path]:
    """Files of recordings, by name; those that are not there are simulated.

    Args:
        folder: where they are kept.
        names: of :data:`RECIPES`.
        processes: how many are simulated at a time.
    """
    folder.mkdir(parents=True, exist_ok=True)
    here = Path(__file__)
    recipes = here.read_bytes() + here.with_name("simulated.py").read_bytes()
    digest = hashlib.sha256(recipes).hexdigest()[:12]
    files = {name: folder / f"{name}-{digest}.msgpack" for name in names}
    missing = [name for name, path in files.items() if not path.is_file()]
    for name, path in files.items():  # of an older recipe
        for old in folder.glob(f"{name}-{'?' * len(digest)}.msgpack"):
            if old != path:
                old.unlink()
    with concurrent.futures.ProcessPoolExecutor(max(1, min(processes, len(missing)))) as pool:
        list(pool.map(_make, missing, [files[name] for name in missing]))
    return files


def write(recording: Recording, path: Path) -> None:
    """Write a recording, whole or not at all."""
    draft = path.with_suffix(".draft")
    draft.write_bytes(msgspec.msgpack.encode(recording))
    draft.replace(path)


def _make(name: str, path: Path) -> None:
    write(RECIPES[name](), path)


# -- starts ----------------------------------------------------------------------------------------


def cold(recording: Recording) -> Recording:
    recording.baseline = None
    return recording


def with_baseline_of(recording: Recording, other: str) -> Recording:
    assert recording.baseline is not None
    table = json.loads(recording.baseline)
    table["legs"] = {"rf": table["legs"][other]}
    recording.baseline = json.dumps(table).encode()
    return recording


def unfit_baseline(recording: Recording) -> Recording:
    """A baseline that promises an eighth of the noise: given up, and the leg learned again."""
    assert recording.baseline is not None
    table = json.loads(recording.baseline)
    leg = table["legs"]["rf"]
    leg["covariance"] = (np.array(leg["covariance"]) / 70.0).tolist()
    recording.baseline = json.dumps(table).encode()
    return recording


def _no_lengths() -> Recording:
    # Without geometry a lift is told by its time, which needs swings of 0.4 s and more.
    recording = hexapod_pose(5203, segment_ticks=14, drift=change("friction", 4.0, 30.0))
    recording.robot = re.sub(r"(?m)^lengths_m.*\n", "", recording.robot)
    return recording


def _preview_library() -> Recording:
    """A baseline whose library looks one command ahead, learned here from free swings."""
    recording = hexapod_pose(5204, drift=change("supply", 9.5))
    commands = [samples["rf"]["desired"] for samples in recording.rounds]
    for number, samples in enumerate(recording.rounds[:-2]):
        samples["rf"]["preview"] = commands[number + 1 : number + 3]
    robot = parse_robot(recording.robot, source="hexapod")
    run = record_arrays(SimulationSettings(seed=5205), 300.0)
    training = learn(
        robot,
        {"rf": [stretch_of(run, "rf")]},
        origin="tests/same",
        window=Window(past_measured=2, past_desired=2, preview=1),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "baseline.json"
        save_baseline(training.baseline, path)
        recording.baseline = path.read_bytes()
    for number in range(2000, 2040):  # the controller does not say what comes next
        recording.rounds[number]["rf"].pop("preview", None)
    return recording


def service_restart(recording: Recording) -> Recording:
    """The service starts again while the leg touches, and while an old publisher still speaks."""
    rounds: list[Round] = []
    for number, samples in enumerate(recording.rounds):
        samples["rf"]["run"] = 71 if number < 1400 else 72
        rounds.append(samples)
        if 1400 <= number < 1700:  # a process that was thought to have ended
            rounds.append({"rf": {**samples["rf"], "run": 71}})
    recording = streams(recording, rounds)
    recording.restarts = [700, 1601, 3001]
    return recording


def _quadruped() -> Recording:
    scenario = quadruped_stand.Scenario("same", "", 5207, 60.0, 0.5, (300.0, 3000.0))
    rounds: list[Round] = []
    for leg, sample in quadruped_stand.record(scenario).samples:
        if not rounds or leg in rounds[-1]:
            rounds.append({})
        rounds[-1][leg] = plain(sample)
    return Recording(
        shipped("quadruped", "robot.toml").decode(),
        shipped("quadruped", "baseline.json"),
        rounds,
        looks_of(rounds),
    )


# -- streams with faults ---------------------------------------------------------------------------


def streams(recording: Recording, rounds: Iterable[Round]) -> Recording:
    """The recording with other rounds; the status is noted at every tenth."""
    recording.rounds = list(rounds)
    legs = sorted({leg for samples in recording.rounds for leg in samples})
    numbers = [*range(0, len(recording.rounds), 10), len(recording.rounds) - 1]
    recording.looks = [(number, legs) for number in numbers]
    return recording


def restarted(parts: Sequence[Recording], *, run: bool) -> Recording:
    """A source that starts again: in a swing, in a stance, and then every few samples."""
    rounds: list[Round] = []
    number = 0
    for part in parts:
        pieces = [part.rounds]
        if part is parts[1]:  # a loop of starts
            pieces += [part.rounds[k : k + 30] for k in range(0, 150, 30)]
        for piece in pieces:
            number += 1
            for seq, samples in enumerate(copy.deepcopy(piece)):
                for sample in samples.values():
                    sample["seq"], sample["t_ns"] = seq, seq * PERIOD_NS
                    if run:
                        sample["run"] = 1_700_000_000_000 + number
                rounds.append(samples)
    return streams(parts[0], rounds)


def _parts() -> list[Recording]:
    return [hexapod_pose(5301 + i, seconds=s) for i, s in enumerate((21.0, 14.1, 20.0))]


def tripod(seed: int, seconds: float, encoder: EncoderSettings) -> Recording:
    """Three legs in pose at a time."""
    poses = tuple(
        PoseSettings(legs=(leg,), obstacles=ObstacleSettings(probability=0.4)) for leg in TRIPOD
    )
    settings = SimulationSettings(motion=PoseGroupSettings(poses), seed=seed, encoder=encoder)
    rounds = simulated(settings, seconds, TRIPOD)
    return streams(hexapod(rounds), rounds)


def lost_samples(recording: Recording) -> Recording:
    """Samples lost of one of three legs or of all."""
    rng = np.random.default_rng(5311)
    lost: set[tuple[int, str]] = set()
    for leg in (*TRIPOD, *TRIPOD, "all"):
        for start in rng.integers(100, 2900, 20).tolist():
            length = int(rng.choice([1, 1, 2, 3, 6, 40]))
            legs = TRIPOD if leg == "all" else (leg,)
            lost |= {(start + i, of) for i in range(length) for of in legs}
    rounds = [
        {leg: s for leg, s in samples.items() if (number, leg) not in lost}
        for number, samples in enumerate(recording.rounds)
    ]
    return streams(recording, [samples for samples in rounds if samples])


def late_ticks(recording: Recording) -> Recording:
    """Ticks that come late, their readings as well as their stamps, and pauses of the source."""
    rng = np.random.default_rng(5313)
    late_ns = 0
    for number, samples in enumerate(recording.rounds):
        if number in (900, 1700):  # that no number shows
            late_ns += 150_000_000
        if number > 2000 and rng.random() < 0.05:
            late_ns += 14_000_000
        samples["rf"]["t_ns"] += late_ns
    return streams(recording, recording.rounds)


def stamp_jitter(recording: Recording) -> Recording:
    """Readings on time with stamps that are not: by 3 ms, then by 6 ms (standard deviation)."""
    rng = np.random.default_rng(5322)
    for number, samples in enumerate(recording.rounds):
        deviation_ns = 0.0 if number < 500 else 3e6 if number < 1500 else 6e6
        jitter_ns = float(np.clip(rng.normal(), -1.5, 1.5)) * deviation_ns
        samples["rf"]["t_ns"] += 20_000_000 + round(jitter_ns)
    return streams(recording, recording.rounds)


def other_rate(recording: Recording) -> Recording:
    """Ticks of 25 ms for 8 s, and of 20.6 ms for 8 s."""
    t_ns = 0
    for number, samples in enumerate(recording.rounds):
        t_ns += 25_000_000 if 700 <= number < 1020 else PERIOD_NS
        t_ns += 600_000 if 1300 <= number < 1700 else 0
        samples["rf"]["t_ns"] = t_ns
    return streams(recording, recording.rounds)


def two_publishers(first: Recording, second: Recording) -> Recording:
    """Two sources of one leg: together, the older alone again, and the newer again."""
    rounds: list[Round] = []
    for number, (one, other) in enumerate(zip(first.rounds, second.rounds, strict=True)):
        one["rf"]["run"], other["rf"]["run"] = 41, 42
        other["rf"]["t_ns"] += 7_000_000
        if number < 600 or 900 <= number < 1500 or number >= 1800:
            rounds.append(one)
        if 600 <= number < 1200 or number >= 1500:
            rounds.append(other)
    return streams(first, rounds)


def spoilt(recording: Recording, spoilers: Sequence[Spoiler]) -> Recording:
    """One bad sample a second and some, each kind in turn."""
    last = len(recording.rounds) - 20
    rounds: list[Round] = []
    for number, samples in enumerate(recording.rounds):
        sample = samples["rf"]
        kind, place = divmod(number - 300, 57)
        if place or not 300 <= number < last:
            rounds.append(samples)
            continue
        before = copy.deepcopy(recording.rounds[number - 1]["rf"])
        spoilt, instead = spoilers[kind % len(spoilers)](copy.deepcopy(sample), before)
        rounds.append({"rf": spoilt})
        if not instead:
            rounds.append(samples)
    return streams(recording, rounds)


def _with(sample: Sample, **fields: Any) -> Sample:
    return {**sample, **fields}


def _one(values: Sequence[float], joint: int, value: float) -> list[float]:
    return [value if i == joint else old for i, old in enumerate(values)]


# Samples that no learner can use, and whether each comes instead of the good one or besides.
UNUSABLE: Final[tuple[Spoiler, ...]] = (
    lambda s, _: (_with(s, measured=_one(s["measured"], 1, math.nan)), True),
    lambda s, _: (_with(s, desired=_one(s["desired"], 0, math.inf)), False),
    lambda _, before: (before, False),  # twice
    lambda s, before: (_with(before, t_ns=s["t_ns"]), False),  # its number twice
    lambda s, before: (_with(s, t_ns=before["t_ns"]), True),  # its time twice
    lambda _, before: (_with(before, t_ns=before["t_ns"] - 90_000_000), False),  # backwards
    lambda s, _: (_with(s, measured=s["measured"][:2]), True),
    lambda s, _: (_with(s, valid=[True, True]), False),
    lambda s, _: (_with(s, measured=_one(s["measured"], 2, 100.0)), True),
    lambda s, _: (_with(s, measured=_one(s["measured"], 2, 8.1 * math.pi)), False),
    lambda s, _: (_with(s, seq=s["seq"] + 20_000_000), False),
    lambda s, _: (_with(s, seq=-1), False),
    lambda s, _: (_with(s, t_ns=2**63), False),
    lambda s, _: (_with(s, preview=[[0.0, 0.0, math.nan]]), False),
    lambda s, _: (_with(s, preview=[[0.0, 0.0, 0.0]] * 65), False),
    lambda s, _: (_with(s, valid=[True, False, True]), True),
    lambda s, _: (_with(s, valid=[False, False, False]), True),
)
# Readings that no leg can have made.
UNREAL: Final[tuple[Spoiler, ...]] = (
    lambda s, _: (_with(s, measured=_one(s["measured"], 1, -math.pi)), True),
    lambda s, _: (_with(s, measured=[x + 2 * math.pi for x in s["measured"]]), True),
    lambda s, _: (_with(s, measured=[0.0, 0.0, 0.0]), True),
    lambda s, _: (_with(s, measured=_one(s["measured"], 2, 0.0)), True),
    lambda s, before: (_with(s, measured=before["measured"]), True),  # to the last bit
)


def wrong_signs(recording: Recording) -> Recording:
    """Pitch angles that grow downwards: the baseline is of another leg, and one is learned."""
    for samples in recording.rounds:
        for sample in samples.values():
            for name in ("measured", "desired"):
                yaw, *pitches = sample[name]
                sample[name] = [yaw, *(-angle for angle in pitches)]
    return recording


# Seeds are those of no test, benchmark or baseline; names are permanent.
RECIPES: Final[dict[str, Callable[[], Recording]]] = {
    "walk-flat": lambda: hexapod_walk(5001, "flat"),
    "walk-rough": lambda: hexapod_walk(5002, "rough", "ripple"),
    "walk-soft": lambda: hexapod_walk(5003, "soft"),
    "walk-no-phase": lambda: hexapod_walk(5004, "rough", phase=False),
    "pose-obstacles": lambda: hexapod_pose(5101, seconds=LONG_POSE_S),
    "pose-free": lambda: hexapod_pose(5102, obstacles=0.0),
    "pose-friction4": lambda: hexapod_pose(5103, drift=change("friction", 4.0)),
    "pose-joint6": lambda: hexapod_pose(5104, drift=change("friction", 6.0, joint="femur")),
    "pose-supply": lambda: hexapod_pose(5105, drift=change("supply", 9.0)),
    "pose-mass": lambda: hexapod_pose(5106, drift=change("mass", 0.1)),
    "pose-offset": lambda: hexapod_pose(5107, drift=change("offset", 0.05, joint="tibia")),
    "pose-creeping": lambda: hexapod_pose(
        5108, drift=change("friction", 3.0, shape="ramp", duration_s=60.0)
    ),
    "pose-passing": lambda: hexapod_pose(
        5109, drift=change("mass", 0.1, shape="pulse", duration_s=25.0)
    ),
    "pose-slipped": lambda: hexapod_pose(5111, drift=change("offset", 0.2)),
    "pose-post": lambda: hexapod_pose(5113, obstacles=0.9, approach="forward"),
    "trailing-foot": lambda: hexapod_pose(
        5112, staging=Staging(caught_s=(CHANGE_S, 50.0), trails_n=12.0)
    ),
    "caught-foot": lambda: hexapod_pose(5110, staging=Staging(caught_s=(CHANGE_S, 50.0))),
    "cold-start": lambda: cold(hexapod_pose(5201)),
    "other-leg": lambda: with_baseline_of(hexapod_pose(5202), "lf"),
    "unfit-baseline": lambda: unfit_baseline(hexapod_pose(5208)),
    "no-lengths": _no_lengths,
    "preview-library": _preview_library,
    "quadruped": _quadruped,
    "service-restart": lambda: service_restart(hexapod_pose(5206, drift=change("friction", 4.0))),
    "restart-with-run": lambda: restarted(_parts(), run=True),
    "restart-without-run": lambda: restarted(_parts(), run=False),
    "lost-samples": lambda: lost_samples(tripod(5310, 60.0, EncoderSettings(dropped=0.01))),
    "failing-readings": lambda: tripod(5312, 60.0, EncoderSettings(repeated=0.01, bogus=0.003)),
    "late-ticks": lambda: late_ticks(hexapod_pose(5314, seconds=60.0)),
    "other-rate": lambda: other_rate(hexapod_pose(5320, seconds=50.0)),
    "stamp-jitter": lambda: stamp_jitter(hexapod_pose(5323, seconds=50.0)),
    "two-publishers": lambda: two_publishers(
        hexapod_pose(5331, seconds=40.0), hexapod_pose(5332, seconds=40.0)
    ),
    "bad-samples": lambda: spoilt(hexapod_pose(5341, seconds=70.0), UNUSABLE),
    "bad-readings": lambda: spoilt(hexapod_pose(5342, seconds=60.0), UNREAL),
    "wrong-signs": lambda: wrong_signs(hexapod_pose(5351, obstacles=0.3)),
}
