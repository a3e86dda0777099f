"""What may happen to a recording on its way: other starts, and streams with faults."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final

import numpy as np

# One leg's sample as plain values; what is left out has its default.
Sample = dict[str, Any]
Round = dict[str, Sample]
# Makes a bad sample of one and the one before; whether it comes instead, or besides.
Spoiler = Callable[[Sample, Sample], tuple[Sample, bool]]

PERIOD_NS: Final = 20_000_000
TRIPOD: Final = ("lm", "rf", "rr")


@dataclass
class Recording:
    """What learners are given, and when they are asked.

    Attributes:
        robot: content of ``robot.toml``.
        baseline: content of a baseline file, None for a cold start.
        rounds: samples, by leg.
        looks: after which round the status of which legs is noted.
        restarts: before which rounds the service that has the learners is started again.
        judged: whether score and p of every tick are noted.
    """

    robot: str
    baseline: bytes | None
    rounds: list[Round]
    looks: list[tuple[int, list[str]]] = field(default_factory=list)
    restarts: list[int] = field(default_factory=list)
    judged: bool = False


def shipped(name: str, file: str) -> bytes:
    return resources.files("adaptive_contact_models").joinpath(name, file).read_bytes()


# -- starts ----------------------------------------------------------------------------------------


def cold(recording: Recording) -> Recording:
    recording.baseline = None
    return recording


def with_baseline_of(recording: Recording, other: str) -> Recording:
    table = json.loads(recording.baseline)
    table["legs"] = {"rf": table["legs"][other]}
    recording.baseline = json.dumps(table).encode()
    return recording


def unfit_baseline(recording: Recording) -> Recording:
    """A baseline that promises an eighth of the noise: given up, and the leg learned again."""
    table = json.loads(recording.baseline)
    leg = table["legs"]["rf"]
    leg["covariance"] = (np.array(leg["covariance"]) / 70.0).tolist()
    recording.baseline = json.dumps(table).encode()
    return recording


def without_lengths(recording: Recording) -> Recording:
    recording.robot = re.sub(r"(?m)^lengths_m.*\n", "", recording.robot)
    return recording


def with_slope(recording: Recording, share: float) -> Recording:
    """The servos' slope described as so many times what it is."""
    given = re.compile(r"(?m)(?<=^slope_rad = )[\d.]+")
    recording.robot = given.sub(lambda found: str(share * float(found[0])), recording.robot)
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


# -- streams with faults ---------------------------------------------------------------------------


def streams(recording: Recording, rounds: Iterable[Round]) -> Recording:
    """The recording with other rounds."""
    recording.rounds = list(rounds)
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
