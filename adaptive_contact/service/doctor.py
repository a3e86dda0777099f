"""What is on the wire, and what looks wrong: the examination behind ``doctor``.

:class:`Examination` takes messages in for a few seconds; :func:`diagnose` then judges.  Neither
knows the network: :func:`examine` does.
"""

from __future__ import annotations

import difflib
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final

import msgspec

from adaptive_contact.service.legcheck import Finding, Level, check_leg
from adaptive_contact.service.link import Link
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.status import SERVICE_STATUS, LegFacts, ServiceStatus
from adaptive_contact.service.traffic import Received
from adaptive_contact.wire import (
    LearnerStatus,
    Rejected,
    ServoSample,
    Status,
    decode,
    leg_of_key,
)

__all__ = ["Diagnosis", "Examination", "KeyTraffic", "diagnose", "examine"]

# A flood is measured by its count; its samples need not all be looked at.
_SAMPLES_KEPT: Final = 3000
_KEYS_KEPT: Final = 400
_BACKLOG: Final = 50_000
_POLL_S: Final = 0.05

_LEG_KINDS: Final = ("servo", "contact", "learner", "model", "truth", "command")
_OTHER_KEYS: Final = (SERVICE_STATUS, "robot/sim/drift")
_ENCODINGS: Final = ("application/msgpack", "application/json")


class KeyTraffic(msgspec.Struct, frozen=True, kw_only=True):
    """One key: messages and bytes per second, the mean size of a payload, and the encodings."""

    key: str
    rate_hz: float
    bytes_per_s: float
    mean_bytes: float
    encodings: list[str]


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """What was found.  ``router`` is a :class:`~adaptive_contact.service.probe.Reach`."""

    router: str
    router_line: str
    service: ServiceStatus | None = None
    service_alive: bool = False
    seconds: float = 0.0
    keys: list[KeyTraffic] = msgspec.field(default_factory=list)
    findings: list[Finding] = msgspec.field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 where all is well, 1 with findings that are more than a note, 2 without a router."""
        if self.router != "connected":
            return 2
        return int(any(finding.level != "note" for finding in self.findings))


@dataclass(slots=True)
class _Meter:
    count: int = 0
    size: int = 0
    encodings: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True)
class Examination:
    """Everything heard in the time looked at; of each status the first and the last."""

    meters: dict[str, _Meter] = field(default_factory=dict)
    samples: dict[str, list[ServoSample]] = field(default_factory=dict)
    refused: dict[str, list[Rejected]] = field(default_factory=dict)
    learners: dict[str, tuple[LearnerStatus, LearnerStatus]] = field(default_factory=dict)
    service: tuple[ServiceStatus, ServiceStatus] | None = None
    uncounted_keys: int = 0

    def take(self, received: Received) -> None:
        """Take one message in."""
        meter = self.meters.get(received.key)
        if meter is None:
            if len(self.meters) >= _KEYS_KEPT:
                self.uncounted_keys += 1
                return
            meter = self.meters[received.key] = _Meter()
        meter.count += 1
        meter.size += len(received.payload)
        meter.encodings[received.encoding] += 1
        if received.key == SERVICE_STATUS:
            status = decode(received.payload, ServiceStatus, received.encoding)
            if isinstance(status, ServiceStatus):
                self.service = (status if self.service is None else self.service[0], status)
            return
        leg = leg_of_key(received.key)
        if leg is None:
            return
        if received.key.endswith("/learner"):
            learner = decode(received.payload, LearnerStatus, received.encoding)
            if isinstance(learner, LearnerStatus):
                self.learners[leg] = (self.learners.get(leg, (learner, learner))[0], learner)
        elif received.key.endswith("/servo") and meter.count <= _SAMPLES_KEPT:
            sample = decode(received.payload, ServoSample, received.encoding)
            if isinstance(sample, Rejected):
                self.refused.setdefault(leg, []).append(sample)
            else:
                self.samples.setdefault(leg, []).append(sample)


def examine(link: Link, seconds: float, stop: threading.Event | None = None) -> Diagnosis:
    """Listen for a while, then judge.

    Args:
        link: open and connected.
        seconds: how long; 3 s are enough for 50 Hz.
        stop: ends the listening early.
    """
    stop = stop or threading.Event()
    waiting: deque[Received] = deque(maxlen=_BACKLOG)
    heard = Examination()
    began = time.monotonic()
    everything = link.subscribe("**", waiting.append)
    while time.monotonic() - began < seconds and not stop.wait(_POLL_S):
        for _ in range(len(waiting)):
            heard.take(waiting.popleft())
    elapsed = time.monotonic() - began
    everything.close()
    for _ in range(len(waiting)):
        heard.take(waiting.popleft())
    reach = link.diagnose()
    return diagnose(
        heard,
        elapsed,
        alive=SERVICE_TOKEN in link.alive(SERVICE_TOKEN),
        router=reach.reach,
        router_line=reach.line,
    )


def diagnose(
    heard: Examination,
    seconds: float,
    *,
    alive: bool,
    router: str = "connected",
    router_line: str = "connected",
) -> Diagnosis:
    """Judge what was heard within ``seconds``; ``alive`` tells whether a service's token is."""
    service = heard.service[1] if alive and heard.service is not None else None
    findings = [*_about_service(heard, alive), *_about_keys(heard, seconds)]
    described: dict[str, LegFacts] = {} if service is None else service.legs
    published = heard.samples.keys() | heard.refused.keys()
    for leg in [*described, *sorted(published - set(described))] if published else []:
        findings += check_leg(
            leg,
            heard.samples.get(leg, []),
            heard.refused.get(leg, []),
            seconds=seconds,
            period_s=None if service is None else service.period_s,
            facts=described.get(leg),
        )
        if leg in heard.learners:
            findings += _about_learner(*heard.learners[leg])
    if not published:
        findings.append(
            Finding(
                "error",
                None,
                "nobody publishes servo samples",
                "start the bridge or `adaptive-contact sim`, with the same --namespace",
            )
        )
    return Diagnosis(
        router=router,
        router_line=router_line,
        service=service,
        service_alive=alive,
        seconds=seconds,
        keys=_traffic(heard, seconds),
        findings=findings,
    )


def _traffic(heard: Examination, seconds: float) -> list[KeyTraffic]:
    return [
        KeyTraffic(
            key=key,
            rate_hz=meter.count / seconds,
            bytes_per_s=meter.size / seconds,
            mean_bytes=meter.size / meter.count,
            encodings=[encoding for encoding, _ in meter.encodings.most_common(3)],
        )
        for key, meter in sorted(heard.meters.items())
    ]


def _about_service(heard: Examination, alive: bool) -> list[Finding]:
    if not alive:
        return [
            Finding(
                "error",
                None,
                "a router is there, but no service",
                "start `adaptive-contact serve`, or `serve --connect` to join this router",
            )
        ]
    if heard.service is None:
        return [
            Finding(
                "warning",
                None,
                "a service is alive, but did not say how it is",
                "listen longer with --seconds; if it stays so, it is stuck: look at its log",
            )
        ]
    before, service = heard.service
    found = [
        Finding(
            _still(times, before.rejects.get(reason, 0)),
            None,
            f"the service refused {times} payloads that belong to no leg ({reason})",
            "its log names a key; leg ids are letters, digits, '_', '.' or '-', no wildcards",
        )
        for reason, times in service.rejects.items()
    ]
    if service.note is not None:
        found.append(Finding("error", None, f"the service says: {service.note}", "as it says"))
    found += [
        Finding(
            "note",
            None,
            f"learned state was refused: {line}",
            "the leg started from its baseline; `adaptive-contact state show` lists what there is",
        )
        for line in ([] if service.state is None else service.state.refused)
    ]
    counts: list[tuple[Level, int, str, str]] = [
        (
            "error",
            service.callback_faults,
            "exceptions in the service's Zenoh callbacks",
            "this is a bug; report it with the service's log",
        ),
        (
            "error",
            service.events_lost,
            "contact events were lost to a subscriber that hung",
            "find the subscriber that blocks in its callback, and let it only enqueue there",
        ),
        (
            _still(service.slow_puts, before.slow_puts),
            service.slow_puts,
            "contact events were held up by a subscriber that hung",
            "find the subscriber that blocks in its callback, and let it only enqueue there",
        ),
        (
            "warning",
            service.stalls,
            "times the service stood still for a second or more",
            "look at its log, and at what else the machine was doing",
        ),
    ]
    found += [
        Finding(level, None, f"{times} {what}", remedy)
        for level, times, what, remedy in counts
        if times
    ]
    if service.baseline is None:
        found.append(
            Finding(
                "warning",
                None,
                "the service started without a baseline, so no leg had a model",
                "make one with `adaptive-contact fit`, and start with --baseline",
            )
        )
    return found


def _about_keys(heard: Examination, seconds: float) -> list[Finding]:
    found = []
    for key, meter in sorted(heard.meters.items()):
        odd = [encoding for encoding in meter.encodings if not encoding.startswith(_ENCODINGS)]
        if odd and leg_of_key(key) is not None:
            found.append(
                Finding(
                    "warning",
                    leg_of_key(key),
                    f"{key} has the encoding {odd[0]}; it is taken for msgpack",
                    "declare application/msgpack or application/json when publishing",
                )
            )
        stray = _stray(key)
        if stray is not None:
            rate = meter.count / seconds
            found.append(Finding("warning", None, f"{key} ({rate:.1f}/s) {stray[0]}", stray[1]))
    if heard.uncounted_keys:
        found.append(
            Finding(
                "warning",
                None,
                f"more than {_KEYS_KEPT} keys; {heard.uncounted_keys} messages were not looked at",
                "use --namespace to look at one robot",
            )
        )
    return found


def _stray(key: str) -> tuple[str, str] | None:
    """What is wrong with a key outside the contract, and what to do."""
    if leg_of_key(key) is not None or key in _OTHER_KEYS or key.startswith("robot/bridge/"):
        return None
    head, robot, tail = key.partition("robot/leg/")
    if robot and head:
        namespace = head.rstrip("/")
        return f"lies under '{namespace}'", f"look there with --namespace {namespace}"
    if robot:
        leg, _, kind = tail.partition("/")
        near = difflib.get_close_matches(kind, _LEG_KINDS, n=1)
        if kind not in _LEG_KINDS and near:
            return "is read by nobody", f"did you mean robot/leg/{leg}/{near[0]}?"
        return "names no usable leg", "a leg id has 1 to 32 letters, digits, '_', '.' or '-'"
    return None


_NOTES: Final = "docs/operating.md says what each note asks for"
_REMEDIES: Final[dict[Status, str]] = {
    "learning": f"let the leg swing freely, in many directions; {_NOTES}",
    "adapting": _NOTES,
    "ambiguous": f"look at the foot and its servos, trust its contacts less; {_NOTES}",
    "valid": _NOTES,
    "silent": _NOTES,
}


def _about_learner(before: LearnerStatus, status: LearnerStatus) -> list[Finding]:
    found = []
    refused = {reason: times for reason, times in status.rejects.items() if times}
    if refused:
        listed = ", ".join(f"{reason} {times}" for reason, times in sorted(refused.items()))
        found.append(
            Finding(
                _still(sum(refused.values()), sum(before.rejects.values())),
                status.leg,
                f"the service has refused samples of it since its start: {listed}",
                "docs/messages.md says what each reason means",
            )
        )
    if status.status == "silent":
        return found  # the stream itself has been judged
    if status.note is not None:
        what = f"{status.status}: {status.note}"
        found.append(Finding("note", status.leg, what, _REMEDIES[status.status]))
    return found


def _still(now: int, before: int) -> Level:
    """What was refused long ago is a note; what is being refused is a fault."""
    return "warning" if now > before else "note"
