"""Replays recordings through the learners of whatever tree is on the path, and writes what came.

Runs as a process of its own with ``PYTHONPATH`` on a revision's tree::

    python -P play.py TREE RECORDING OUTCOME [RECORDING OUTCOME ...]

Only the public interface of a learner is used.
"""

from __future__ import annotations

import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgspec

import adaptive_contact
from adaptive_contact import ContactLearner, LearnerBank, ServoSample, load_baseline, load_robot


class Learners:
    """The legs of one recording: one learner, or several that go through time together."""

    def __init__(self, recording: dict[str, Any], folder: Path) -> None:
        robot, baseline = folder / "robot.toml", folder / "baseline.json"
        robot.write_text(recording["robot"], encoding="utf-8")
        self._robot = load_robot(robot)
        self._baseline = None
        if recording["baseline"] is not None:
            baseline.write_bytes(recording["baseline"])
            self._baseline = load_baseline(baseline)
        self.legs = tuple(dict.fromkeys(leg for samples in recording["rounds"] for leg in samples))
        self._begin()

    def _begin(self) -> None:
        if len(self.legs) == 1:
            self._bank = None
            self._alone = ContactLearner(self._robot, self.legs[0], self._baseline)
            return
        self._bank = LearnerBank(self._robot, self._baseline)
        for leg in self.legs:
            self._bank.learner(leg)

    def __getitem__(self, leg: str) -> Any:
        return self._alone if self._bank is None else self._bank.learner(leg)

    def update(self, samples: dict[str, ServoSample]) -> list[Any]:
        if self._bank is not None:
            return list(self._bank.update(samples))
        event = self._alone.update(samples[self.legs[0]])
        return [] if event is None else [event]

    def judged(self, leg: str) -> dict[str, float]:
        """The largest score of the last tick, and how probably the leg touches; NaN for none."""
        judged, p = self[leg].judged(), self[leg].state.p
        score = math.nan if judged is None else max(judged.scores.tolist())
        return {"score": score, "p": math.nan if p is None else p}

    def restart(self) -> None:
        """As when the service ends and starts again."""
        saved = {leg: msgspec.msgpack.encode(self[leg].snapshot()) for leg in self.legs}
        self._begin()
        for leg in self.legs:
            refused = self[leg].restore(msgspec.msgpack.decode(saved[leg]))
            if refused is not None:
                raise ValueError(refused)


def play(recording: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What the learners say of a recording, as plain values."""
    events: list[Any] = []
    looks: list[Any] = []
    fields: dict[str, list[str]] = {}
    judged: list[Any] = []
    out: dict[str, Any] = {
        "events": events,
        "looks": looks,
        "end": {},
        "fields": fields,
        "judged": judged,
    }

    def plain(kind: str, value: Any) -> Any:
        if value is not None and kind not in fields:
            fields[kind] = sorted(_fields(value))
        return msgspec.to_builtins(value, builtin_types=(bytes,))

    try:
        learners = Learners(recording, folder)
        restarts = set(recording["restarts"])
        asked: dict[int, set[str]] = {}
        for number, legs in recording["looks"]:
            asked.setdefault(number, set()).update(legs)
        for number, samples in enumerate(recording["rounds"]):
            if number in restarts:
                learners.restart()
            made = {leg: ServoSample(**sample) for leg, sample in samples.items()}
            for event in learners.update(made):
                events.append([number, event.leg, plain("event", event)])
            if recording["judged"]:
                judged += [[number, leg, learners.judged(leg)] for leg in sorted(learners.legs)]
            for leg in sorted(asked.get(number, ())):
                learner = learners[leg]
                status = plain("status", learner.status)
                looks.append([number, leg, status, list(learner.drain_confirmed())])
        for leg in learners.legs:
            learner = learners[leg]
            report = plain("report", learner.model_report)
            snapshot = msgspec.msgpack.decode(msgspec.msgpack.encode(learner.snapshot()))
            out["end"][leg] = {"report": report, "snapshot": snapshot}
    except Exception as fault:  # to be compared as any other outcome
        out["fault"] = f"{type(fault).__name__}: {fault}"
    return out


def _fields(value: Any, prefix: str = "") -> list[str]:
    """Names of a message's fields, and of those of messages in it."""
    names = []
    for name in value.__struct_fields__:
        names.append(f"{prefix}{name}")
        inner = getattr(value, name)
        if isinstance(inner, msgspec.Struct):
            names += _fields(inner, f"{prefix}{name}.")
    return names


def main(tree: str, *files: str) -> None:
    found = Path(adaptive_contact.__file__).resolve().parent.parent
    if found != Path(tree).resolve():
        sys.exit(f"found adaptive_contact in {found}; expected it in {tree}: check PYTHONPATH")
    for source, target in zip(files[::2], files[1::2], strict=True):
        recording = msgspec.msgpack.decode(Path(source).read_bytes())
        with tempfile.TemporaryDirectory() as folder:
            outcome = play(recording, Path(folder))
        Path(target).write_bytes(msgspec.msgpack.encode(outcome))


if __name__ == "__main__":
    main(*sys.argv[1:])
