"""`adaptive-contact serve` with a learner that needs no learning; run as a script, or imported.

Contact is ``|measured[0] - desired[0]| > 0.2`` rad.  Everything else is the real command.  With
``--save-often``, ours alone, states are saved every second instead of every tenth.
"""

from __future__ import annotations

import sys
import types
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from msgspec.structs import replace

from adaptive_contact.core.detect.stream import NEXT, Accepted, StreamGuard
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.wire import (
    ContactEvent,
    DriftLevel,
    LearnerStatus,
    LegState,
    ModelReport,
    ModelTerm,
    RefitCounts,
    Reject,
    ServoSample,
    Status,
)

MAX_LEGS = 8
SAVE_PERIOD_S = 1.0


class FakeLearner:
    def __init__(self, leg: str, joints: int) -> None:
        self.name = leg
        self.leg = Leg(id=leg, joints=tuple(f"j{i}" for i in range(joints)))
        self.joints = joints
        self.word: Status = "valid"
        self.contact = False
        self.contacts = 0
        self.ticks = 0
        self.t_ns = self.seq = 0
        self.rejects: Counter[str] = Counter()
        self.guard = StreamGuard(joints)
        self.answer: Accepted | Reject = NEXT
        self.last_sample: ServoSample | None = None
        self.note: str | None = None
        self.refits = RefitCounts()
        self.drift = DriftLevel()
        self.owes_release = False
        self.fault: Exception | None = None  # raised by whoever asks
        self.report: ModelReport | None = ModelReport(
            leg=leg,
            model_version=3,
            joints=[f"j{i}" for i in range(joints)],
            terms=[[ModelTerm(name="q0", coefficient=1.0)] for _ in range(joints)],
            equations=["q0' = q0"] * joints,
        )

    def snapshot(self) -> dict[str, object]:
        stream = self.guard.snapshot()
        return {"contacts": self.contacts, "stream": stream, "weights": bytes(8000), "bias": 0.25}

    def restore(self, snapshot: dict[str, Any]) -> str | None:
        if not isinstance(snapshot.get("contacts"), int):
            return "implausible: contacts is no number"
        self.contacts = snapshot["contacts"]
        self.guard.restore(snapshot.get("stream"))
        return None

    @property
    def state(self) -> LegState:
        p = 0.9 if self.contact else 0.1
        return LegState(t_ns=self.t_ns, seq=self.seq, contact=self.contact, p=p, known=True)

    @property
    def older_runs(self) -> tuple[int | None, ...]:
        return self.guard.older_runs

    def judged(self) -> None:
        """There is no residual."""

    def count(self, reason: Reject, times: int = 1) -> None:
        self.rejects[reason] += times

    def request_release(self) -> None:
        self.owes_release = True

    def withdraw(self) -> ContactEvent | None:
        if not self.ticks:
            return None
        self.contact = False
        return replace(self._event(score=0.0), status="silent", withheld=True)

    def reset_after_fault(self, fault: Exception) -> None:
        self.fault = None
        self.note = f"begun anew: {fault}"

    @property
    def model_report(self) -> ModelReport | None:
        if self.fault is not None:
            raise self.fault
        return self.report

    @property
    def status(self) -> LearnerStatus:
        if self.fault is not None:
            raise self.fault
        return LearnerStatus(
            leg=self.name,
            t_ns=self.t_ns,
            status=self.word,
            model_version=3,
            residual_rms=[0.001] * self.joints,
            noise_floor=[0.001] * self.joints,
            ticks=self.ticks,
            missed=self.guard.missed,
            drift=self.drift,
            restarts=self.guard.restarts,
            rejects=dict(self.rejects),
            refits=self.refits,
            contact=self.contact,
            contacts=self.contacts,
            note=self.note or self.guard.note,
        )

    def update(self, sample: ServoSample) -> ContactEvent | None:
        self.answer = self.guard.admit(sample)
        if isinstance(self.answer, Reject):
            self.count(self.answer)
            return None
        self.last_sample = sample
        self.ticks += 1
        self.t_ns, self.seq = sample.t_ns, sample.seq
        contact = abs(sample.measured[0] - sample.desired[0]) > 0.2
        if contact == self.contact:
            return None
        self.contact = contact
        self.contacts += contact
        return self._event(score=2.0)

    def _event(self, score: float) -> ContactEvent:
        return ContactEvent(
            leg=self.name,
            t_ns=self.t_ns,
            seq=self.seq,
            onset_ns=self.t_ns,
            contact=self.contact,
            status=self.word,
            score=score,
            residual=[0.1] * self.joints,
            model_version=3,
        )


class FakeBank:
    def __init__(self, robot: Robot, baseline: object = None, **_: object) -> None:
        self._learners: dict[str, FakeLearner] = {}

    @property
    def legs(self) -> tuple[str, ...]:
        return tuple(self._learners)

    def learner(self, leg: str) -> FakeLearner | None:
        return self._learners.get(leg)

    def has_room(self, joints: Sequence[int]) -> bool:
        return len(self._learners) + len(joints) <= MAX_LEGS

    def make(self, leg: str, joints: int) -> FakeLearner:
        return FakeLearner(leg, joints)

    def add(self, learner: FakeLearner) -> None:
        self._learners[learner.name] = learner

    def detect_contacts(self, samples: Mapping[str, ServoSample]) -> list[ContactEvent]:
        events = [self._learners[leg].update(sample) for leg, sample in samples.items()]
        return [event for event in events if event is not None]

    def learn_from_tick(self) -> None:
        """There is nothing to learn."""


class FakeRefitter:
    def __init__(self, **_: object) -> None:
        """Takes what a refitter takes."""

    def start(self) -> None:
        """There is no process."""

    def close(self) -> None:
        """There is nothing to end."""


def no_process(**_: object) -> None:
    """There is nothing to refit, or to compile."""


def main() -> None:
    instead: dict[str, dict[str, object]] = {
        "core.bank": {"LearnerBank": FakeBank, "compile_ahead": no_process},
        "service.refits": {"ProcessRefitter": FakeRefitter},
        "service.refit_process": {"start_process": no_process, "end_process": None},
    }
    for name, content in instead.items():
        module = types.ModuleType(f"adaptive_contact.{name}")
        vars(module).update(content)
        sys.modules[module.__name__] = module
    if "--save-often" in sys.argv:
        sys.argv.remove("--save-often")
        from adaptive_contact.service.state.keeper import StateKeeper

        defaults = StateKeeper.__init__.__kwdefaults__
        defaults["period_s"] = SAVE_PERIOD_S
    import typer

    from adaptive_contact.cli._output import protect_output
    from adaptive_contact.cli.serve import serve
    from adaptive_contact.errors import AdaptiveContactError

    protect_output()
    try:
        typer.run(serve)
    except AdaptiveContactError as error:
        sys.exit(f"adaptive-contact: {error}")


if __name__ == "__main__":
    main()
