"""Examines what is on the wire, for ``doctor``.

:class:`Examination` takes messages in for a few seconds; :func:`diagnose` then judges.  Neither
knows the network: :func:`examine` does.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import msgspec

from adaptive_contact.checks.findings import (
    EXPLAINS,
    Fault,
    Finding,
    Level,
    entries,
)
from adaptive_contact.checks.learnercheck import about_learner, all_lost
from adaptive_contact.checks.legcheck import check_ids, check_leg, check_twins
from adaptive_contact.service.link import Link, listen
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.status import SERVICE_STATUS, LegFacts, ServiceStatus
from adaptive_contact.wire import (
    LearnerStatus,
    Rejected,
    ServoSample,
    decode,
    leg_of_key,
    meant_key,
    namespace_of,
)
from adaptive_contact.wire.received import Received

_KEYS_KEPT: Final = 400


class KeyTraffic(msgspec.Struct, frozen=True, kw_only=True):
    """Counts one key: messages and bytes per second, mean payload size, and the encodings."""

    key: str
    rate_hz: float
    bytes_per_s: float
    mean_bytes: float
    encodings: list[str]


class Diagnosis(msgspec.Struct, frozen=True, kw_only=True):
    """Holds what was found.  ``router`` is a :class:`~adaptive_contact.service.settings.Reach`."""

    router: str
    router_line: str
    service: ServiceStatus | None = None
    service_alive: bool = False
    seconds: float = 0.0
    keys: list[KeyTraffic] = msgspec.field(default_factory=list)
    findings: list[Finding] = msgspec.field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """Return 0 where all is well, 1 with findings above a note, 2 without a router."""
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
    """Holds everything received in the time looked at; of each status the first and the last."""

    meters: dict[str, _Meter] = field(default_factory=dict)
    samples: dict[str, list[ServoSample]] = field(default_factory=dict)
    refused: dict[str, list[Rejected]] = field(default_factory=dict)
    learners: dict[str, tuple[LearnerStatus, LearnerStatus]] = field(default_factory=dict)
    service: tuple[ServiceStatus, ServiceStatus] | None = None
    uncounted_keys: int = 0

    def process_message(self, received: Received) -> None:
        """Process one message: count it, keep the newest status."""
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
        # A flood is measured by its count; its samples need not all be looked at.
        elif received.key.endswith("/servo") and meter.count <= 3000:
            sample = decode(received.payload, ServoSample, received.encoding)
            if isinstance(sample, Rejected):
                self.refused.setdefault(leg, []).append(sample)
            else:
                self.samples.setdefault(leg, []).append(sample)


def examine(link: Link, seconds: float) -> Diagnosis:
    """Listen for a while, then judge.

    Args:
        link: open and connected.
        seconds: how long; 3 s are enough for 50 Hz.
    """
    seen = Examination()
    elapsed = listen(link, "**", seconds, seen.process_message)
    reach = link.diagnose()
    return diagnose(
        seen,
        elapsed,
        alive=SERVICE_TOKEN in link.alive(SERVICE_TOKEN),
        router=reach.reach,
        router_line=reach.line,
    )


def diagnose(
    seen: Examination,
    seconds: float,
    *,
    alive: bool,
    router: str = "connected",
    router_line: str = "connected",
) -> Diagnosis:
    """Judge what was received within ``seconds``; ``alive``: whether a service's token is."""
    service = seen.service[1] if alive and seen.service is not None else None
    return Diagnosis(
        router=router,
        router_line=router_line,
        service=service,
        service_alive=alive,
        seconds=seconds,
        keys=[
            KeyTraffic(
                key=key,
                rate_hz=meter.count / seconds,
                bytes_per_s=meter.size / seconds,
                mean_bytes=meter.size / meter.count,
                encodings=[encoding for encoding, _ in meter.encodings.most_common(3)],
            )
            for key, meter in sorted(seen.meters.items())
        ],
        findings=entries(_faults(seen, seconds, alive, service)),
    )


_Faults = Iterator[tuple[str | None, Fault]]


def _faults(
    seen: Examination, seconds: float, alive: bool, service: ServiceStatus | None
) -> _Faults:
    """Yield all that is wrong, causes and consequences, each with its leg."""
    described: dict[str, LegFacts] = {} if service is None else service.legs
    for fault in _about_service(seen, alive):
        yield None, fault
    strays = list(_about_keys(seen, seconds))
    yield from strays
    published = seen.samples.keys() | seen.refused.keys()
    if not published and not any(fault.cause == "key" for _, fault in strays):
        yield None, Fault.from_table("nobody_publishes")
        return
    known = [leg for leg, facts in described.items() if facts.described]
    if known and service is not None:
        for fault in check_ids(sorted(published), known, service.robot):
            yield None, fault
    twins = dict(check_twins(seen.samples))
    unexplained: list[str] = []
    for leg in [*described, *sorted(published - set(described))]:
        if leg not in published and leg in described and not described[leg].described:
            yield leg, Fault.from_table("silent-gone", key=leg)
            continue
        of_leg = check_leg(
            leg,
            seen.samples.get(leg, []),
            seen.refused.get(leg, []),
            seconds=seconds,
            period_s=None if service is None else service.period_s,
            facts=described.get(leg),
        )
        if leg in twins:
            of_leg.append(twins[leg])
        causes = {fault.cause for fault in of_leg if fault.level != "note"}
        causes |= {fault.cause for of, fault in strays if of == leg}
        if not any("not_this_robot" in EXPLAINS.get(cause, ()) for cause in causes):
            unexplained.append(leg)
        if leg in seen.learners:
            count = len(seen.samples.get(leg, ())) + len(seen.refused.get(leg, ()))
            noted = {fault.cause for fault in of_leg}
            of_leg += about_learner(*seen.learners[leg], service, noted, count)
        elif service is not None:
            of_leg.append(Fault.from_table("unreported", seconds=seconds))
        for fault in of_leg:
            yield leg, fault
    statuses = [seen.learners[leg][1] for leg in unexplained if leg in seen.learners]
    yield from all_lost(statuses, service)


def _about_service(seen: Examination, alive: bool) -> Iterator[Fault]:
    if not alive:
        yield Fault.from_table("no_service")
        return
    if seen.service is None:
        yield Fault.from_table("service_quiet")
        return
    before, service = seen.service
    taken = service.samples - before.samples
    for reason, times in service.rejects.items():
        known = before.rejects.get(reason, 0)
        level = _still(times, known)
        fault = Fault.from_table("strange_leg", key=reason, level=level, times=times, reason=reason)
        yield fault._replace(size=times - known, total=taken)
    if service.note is not None:
        yield Fault.from_table("service-note", key="note", note=service.note)
    for line in [] if service.state is None else service.state.refused:
        yield Fault.from_table("state_refused", key=line, line=line)
    slow, late = service.slow_puts - service.late_puts, service.late_puts
    counts: list[tuple[str, int, Level | None]] = [
        ("service-callback_faults", service.callback_faults, None),
        ("service-events_lost", service.events_lost, None),
        ("service-slow_puts", slow, _still(slow, before.slow_puts - before.late_puts)),
        ("service-late_puts", late, _still(late, before.late_puts)),
        ("service-stalls", service.stalls, None),
    ]
    for name, times, how in counts:
        if times:
            yield Fault.from_table(name, key=name, level=how, times=times)


def _about_keys(seen: Examination, seconds: float) -> _Faults:
    for key, meter in sorted(seen.meters.items()):
        stray = _stray(key, f"{key} ({meter.count / seconds:.1f}/s)")
        if stray is not None:
            yield stray
    if seen.uncounted_keys:
        yield None, Fault.from_table("too_many_keys", kept=_KEYS_KEPT, messages=seen.uncounted_keys)


def _stray(key: str, shown: str) -> tuple[str | None, Fault] | None:
    """Return the fault of a key outside the contract, and its remedy."""
    if leg_of_key(key) is not None:
        return None
    namespace = namespace_of(key)
    if namespace:
        return None, Fault.from_table("namespace", shown, key=namespace, namespace=namespace)
    meant = meant_key(key)
    if meant is not None:
        name = "key" if meant.endswith("/servo") else "other_key"
        leg = leg_of_key(meant) or ""
        # One entry for all legs whose keys are misspelt in the same way.
        return leg, Fault.from_table(name, shown, key=key.replace(leg, "LEG"), meant=meant)
    if "robot/leg/" not in key:
        return None
    return None, Fault.from_table("other_key-leg", shown, key="leg")


def _still(now: int, before: int) -> Level:
    """Return the level of a count: a warning while it grows, else a note."""
    return "warning" if now > before else "note"
