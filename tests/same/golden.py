"""Golden recordings: what learners are given, and what they must make of it; files in the tree.

Motions are stored in whole encoder steps, as physics differ between processors.  A recording is a
motion and what is done to it on its way (:data:`RECORDINGS`).  Expected are its events, its
statuses every 50 ticks, and the score of every tick.
"""

from __future__ import annotations

import json
import math
import random
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.fit.train import Stretch, cautious, learn
from adaptive_contact.model import save_baseline
from adaptive_contact.robot import parse_robot

from .compare import Comparison, compare
from .play import play
from .recordings import (
    PERIOD_NS,
    UNREAL,
    UNUSABLE,
    Recording,
    Round,
    cold,
    lost_samples,
    restarted,
    service_restart,
    shipped,
    spoilt,
    two_publishers,
    unfit_baseline,
    with_baseline_of,
    with_slope,
    without_lengths,
    wrong_signs,
)
from .trees import ROOT

FOLDER: Final = ROOT / "tests" / "golden"
LOOK_TICKS: Final = 50
# Absolute to 1 and relative beyond: processors and versions of numba differ by 1e-9.
TOLERANCE: Final = 1e-6
# What is kept of every tick.
FIGURES: Final = ("score", "p")
_PHASES: Final = (None, "stance", "swing")


# The robot of each motion.  They were simulated once (``git log -S write_motion -- tests/same``).
MOTIONS: Final[dict[str, str]] = {
    **dict.fromkeys(("pose", "drift", "caught", "post", "free", "tripod", "walk"), "hexapod"),
    "quadruped12": "quadruped12",
    "leg5": "leg5",
}


def motion(name: str) -> Recording:
    """A stored motion with its robot and baseline, as it was before anything happened to it."""
    robot = MOTIONS[name]
    text = shipped(robot, "robot.toml").decode()
    described = parse_robot(text, source=robot)
    with np.load(FOLDER / f"{name}.npz") as table:
        legs, step, phase = table["legs"].tolist(), table["step"], table["phase"]
        measured, desired = (
            table[f"{field}_first"]
            + step * np.cumsum(np.concatenate([0 * of[:1], of]), axis=0, dtype=np.int64)
            for field in ("measured", "desired")
            for of in [table[field]]
        )
    rounds: list[Round] = [
        {
            leg: {
                "t_ns": round(number * described.period_s * 1e9),
                "seq": number,
                "measured": measured[number, i].tolist(),
                "desired": desired[number, i].tolist(),
                "phase": _PHASES[phase[number, i]],
            }
            for i, leg in enumerate(legs)
        }
        for number in range(len(phase))
    ]
    return Recording(text, shipped(robot, "baseline.json"), rounds)


def _cut(recording: Recording, ticks: int, first: int = 0) -> Recording:
    recording.rounds = recording.rounds[first : first + ticks]
    return recording


def _inferred_phases(recording: Recording) -> Recording:
    """Half of the legs do not carry their phase."""
    for samples in recording.rounds:
        for leg in ("lf", "rm", "lr"):
            del samples[leg]["phase"]
    return recording


def _off_the_clock(recording: Recording) -> Recording:
    """Stamps that jitter, pauses, ticks that come late, and two other rates."""
    rng = random.Random(5407)
    late_ns = 0
    for number, samples in enumerate(recording.rounds):
        late_ns += 150_000_000 * (number in (1000, 1060))
        late_ns += 14_000_000 * (1060 < number < 1300 and rng.random() < 0.05)
        late_ns += 5_000_000 * (1400 < number < 1520) + 600_000 * (1640 < number < 1900)
        wide_ns = 12_000_000 if number > 600 else 5_000_000
        jitter_ns = round((rng.random() - 0.5) * wide_ns) if 300 < number < 900 else 0
        samples["rf"]["t_ns"] += PERIOD_NS + late_ns + jitter_ns
    return recording


def _faulty_source(recording: Recording) -> Recording:
    """For a while readings are copied commands; later swing and stance are swapped."""
    commands = [samples["rf"]["desired"] for samples in recording.rounds]
    for number, samples in enumerate(recording.rounds):
        sample = samples["rf"]
        if 250 <= number < 450:
            sample["measured"] = commands[number - 2]
        if 650 <= number < 850:
            sample["phase"] = "stance" if sample["phase"] == "swing" else "swing"
    return recording


def _parts() -> list[Recording]:
    return [_cut(motion("pose"), ticks, at) for ticks, at in ((450, 0), (400, 450), (500, 900))]


def _late_descents(recording: Recording) -> Recording:
    """Whose foot waits for two ticks on its way down, which no lift shows, mostly near its top."""
    read = [samples["rf"]["measured"] for samples in recording.rounds]
    ticks = swings = 0
    for number, samples in enumerate(recording.rounds):
        ticks = ticks + 1 if samples["rf"]["phase"] == "swing" else 0
        swings += ticks == 1
        if ticks > (13, 15, 16, 17, 13, 15, 16)[swings % 7]:
            samples["rf"]["measured"] = read[number - 2]
    return recording


def _with_holes(recording: Recording) -> Recording:
    """Two samples of each swing do not come, at the time of most touches."""
    ticks, rounds = 0, []
    for samples in recording.rounds:
        ticks = ticks + 1 if samples["rf"]["phase"] == "swing" else 0
        rounds += [] if ticks in (15, 16) else [samples]
    recording.rounds = rounds
    return recording


def _slipped_horn(recording: Recording) -> Recording:
    """A horn slips by 8°: lifts so far off that they look like those of a foot that is held."""
    steps = 27 * math.radians(300.0 / 1023.0)
    for samples in recording.rounds[200:]:
        samples["rf"]["measured"][2] += steps
    return recording


def _newcomers(recording: Recording) -> Recording:
    """Starts of the source that do not last, then sources beside it that say to be newer."""
    rounds: list[Round] = []
    for number, samples in enumerate(recording.rounds):
        sample = samples["rf"]
        sample["run"] = 100 + number // 6 if 100 <= number < 160 else 99 if number < 100 else 200
        rounds.append(samples)
        begun, pace = divmod(number - 300, 300)
        every = (3, 6, 4, 9)[begun % 4]
        if 0 <= begun < 9 and pace % every == 0:
            rounds.append({"rf": {**sample, "run": 300 + begun, "seq": pace // every}})
    recording.rounds = rounds
    return recording


def _fitted(recording: Recording, of: Recording) -> Recording:
    """A baseline that is learned here, of swings that touch now and then."""
    robot = parse_robot(recording.robot, source="golden")
    samples = [samples["rf"] for samples in of.rounds]
    measured, desired = (np.array([s[name] for s in samples]) for name in ("measured", "desired"))
    swing = np.array([s["phase"] == "swing" for s in samples])
    stretch = Stretch(measured, desired, swing, cautious(swing), swing | True, certain=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "baseline.json"
        save_baseline(learn(robot, {"rf": [stretch] * 8}, origin="golden").baseline, path)
        recording.baseline = path.read_bytes()
    return recording


RECORDINGS: Final[dict[str, Callable[[], Recording]]] = {
    "drift": lambda: motion("drift"),
    "cold-start": lambda: cold(motion("pose")),
    "other-leg": lambda: with_baseline_of(_cut(motion("pose"), 1000), "lf"),
    "held-foot": lambda: motion("caught"),
    "lift-strikes": lambda: motion("post"),
    "walk": lambda: _inferred_phases(motion("walk")),
    "quadruped12": lambda: motion("quadruped12"),
    "leg5": lambda: motion("leg5"),
    "lost-samples": lambda: lost_samples(motion("tripod")),
    "clock": lambda: _off_the_clock(_cut(motion("pose"), 2000)),
    "bad-samples": lambda: spoilt(motion("pose"), (*UNUSABLE, *UNREAL)),
    "faulty-source": lambda: _faulty_source(_cut(motion("pose"), 1000)),
    "restarts": lambda: restarted(_parts(), run=True),
    "publishers": lambda: two_publishers(motion("drift"), _cut(motion("pose"), 1500)),
    "service": lambda: service_restart(_cut(motion("pose"), 1800)),
    "few-touches": lambda: cold(motion("free")),
    "early-touches": lambda: _late_descents(_cut(motion("free"), 1200)),
    "newcomers": lambda: _newcomers(motion("pose")),
    "fitted": lambda: _fitted(motion("post"), motion("free")),
    "signs": lambda: wrong_signs(_cut(motion("pose"), 1500)),
    "holes": lambda: _with_holes(_cut(motion("pose"), 1500)),
    "slipped-horn": lambda: _slipped_horn(_cut(motion("pose"), 900)),
    "slope-off-by-4": lambda: cold(with_slope(_cut(motion("pose"), 1500), 0.25)),
    "unfit-baseline": lambda: unfit_baseline(_cut(motion("pose"), 1500)),
    "no-lengths": lambda: without_lengths(motion("drift")),
}


def with_looks(recording: Recording, ticks: int = 10) -> dict[str, Any]:
    """A recording of whose legs the status is noted every so many ticks, as plain values."""
    legs = sorted({leg for samples in recording.rounds for leg in samples})
    numbers = range(len(recording.rounds))[ticks - 1 :: ticks]
    return asdict(replace(recording, looks=[(number, legs) for number in numbers]))


def found(name: str) -> dict[str, Any]:
    """What the learners make of a recording."""
    recording = with_looks(RECORDINGS[name](), LOOK_TICKS)
    recording["judged"] = True
    with tempfile.TemporaryDirectory() as folder:
        outcome = play(recording, Path(folder))
    outcome["end"] = {}  # its format may change
    for look in outcome["looks"]:
        look[3] = [len(look[3]), *look[3][-1:]]
    for _, _, event in outcome["events"]:
        event["onset_ns"] /= 1.0  # estimated: to the tolerance
    return outcome


def compared(name: str) -> Comparison:
    """What is expected of a recording against what is found."""
    return compare(expected(name), found(name), tolerance=TOLERANCE)


def remake(name: str) -> str:
    """Make again what is expected of a recording; what was the first tick that differed."""
    outcome = found(name)
    first = "new"
    if (FOLDER / f"{name}.jsonl").is_file():
        first = compare(expected(name), outcome, tolerance=TOLERANCE).first
    if first != "none":
        write(name, outcome)
    return first


def write(name: str, outcome: dict[str, Any]) -> None:
    """Write what is expected: a line per event, and per status with what has changed in it."""
    lines = [outcome["fields"], outcome.get("fault")]
    lines += [[*at, "event", _short(event)] for *at, event in outcome["events"]]
    before: dict[str, Any] = {}
    for number, leg, status, confirmed in outcome["looks"]:
        changed = {k: v for k, v in status.items() if before.get(leg, {}).get(k, _short) != v}
        lines.append([number, leg, "status", _short(changed), confirmed])
        before[leg] = status
    text = "\n".join(json.dumps(line) for line in lines)
    (FOLDER / f"{name}.jsonl").write_text(text + "\n", encoding="utf-8")
    figures: dict[str, list[list[float]]] = {}
    for _, leg, of in outcome["judged"]:
        figures.setdefault(leg, []).append([of[figure] for figure in FIGURES])
    kept: dict[str, Any] = {leg: np.array(rows, np.float32) for leg, rows in figures.items()}
    np.savez_compressed(FOLDER / f"{name}.scores.npz", **kept)


def _short(value: Any) -> Any:
    """Numbers to nine digits."""
    if isinstance(value, dict):
        return {key: _short(of) for key, of in value.items()}
    if isinstance(value, list):
        return [_short(of) for of in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


def expected(name: str) -> dict[str, Any]:
    """What was written."""
    lines = (FOLDER / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
    fields, fault, *rest = map(json.loads, lines)
    events, looks, last = [], [], {}
    for number, leg, kind, values, *confirmed in rest:
        if kind == "event":
            events.append([number, leg, values])
        else:
            last[leg] = {**last.get(leg, {}), **values}
            looks.append([number, leg, last[leg], *confirmed])
    with np.load(FOLDER / f"{name}.scores.npz") as figures:
        judged = [
            [number, leg, dict(zip(FIGURES, row, strict=True))]
            for leg in figures.files
            for number, row in enumerate(figures[leg].tolist())
        ]
    return {"events": events, "looks": looks, "judged": judged, "fields": fields, "end": {}} | (
        {} if fault is None else {"fault": fault}
    )
