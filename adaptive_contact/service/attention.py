"""Lists what needs a person now, with what to do: the banner of the live page.

``doctor`` looks for three seconds at everything on the wire; this looks at what the service says of
itself and of its legs, as often as it says it.  One cause is one entry, as there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

from adaptive_contact.checks.findings import Fault, Finding, entries, said
from adaptive_contact.checks.learnercheck import about_learner, all_lost
from adaptive_contact.service.watch import View
from adaptive_contact.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

# How long a count that has grown is shown.
_SHOWN_NS: Final = 60_000_000_000


def remedy_of(note: str) -> str | None:
    """Return what to do about the note of a leg, None where it is not known."""
    return next((text for words, text in said()["notes"].items() if re.search(words, note)), None)


class Attention:
    """Lists what needs a person; what has only been counted long ago does not."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._grown_ns: dict[str, int] = {}

    def list_findings(
        self, view: View, statuses: Mapping[str, LearnerStatus], now_ns: int
    ) -> list[Finding]:
        """List what needs a person, the worst first."""
        unseen = (
            (
                not view.connected,
                "the router is lost",
                "This page goes on by itself when `adaptive-contact serve`, or the router, is "
                "back.",
            ),
            (
                view.service is None and not view.alive,
                "no service is running here",
                "Start `adaptive-contact serve`, or give `watch` its --connect and --namespace.",
            ),
            (
                not view.alive,
                "the service is gone: no contact is reported",
                "Start `adaptive-contact serve` again.",
            ),
        )
        for holds, what, remedy in unseen:
            if holds:
                return [Finding("error", None, what, remedy, "service", [])]
        if view.service is None:
            return []
        faults = list(_faults(view, view.service, statuses))
        faults += [(None, fault) for fault in self._grown(view, view.service, now_ns)]
        return [_with_remedy(finding) for finding in entries(faults)]

    def _grown(self, view: View, service: ServiceStatus, now_ns: int) -> Iterator[Fault]:
        """Counts that have grown of late."""
        unheard = sum(leg.unheard for leg in view.legs)
        counts = {
            "service-events_lost": service.events_lost,
            "service-callback_defects": service.callback_faults,
            "service-stalls": service.stalls,
            "service-unheard": unheard,
        }
        for name, times in counts.items():
            if times > self._counts.get(name, times):
                self._grown_ns[name] = now_ns
            self._counts[name] = times
            if times and now_ns - self._grown_ns.get(name, -_SHOWN_NS) < _SHOWN_NS:
                yield Fault.from_table(name, key=name, times=times)


def _faults(
    view: View, service: ServiceStatus, statuses: Mapping[str, LearnerStatus]
) -> Iterator[tuple[str | None, Fault]]:
    for fault in _list_service_faults(service):
        yield None, fault
    for leg in view.legs:
        status = statuses.get(leg.leg)
        if status is None:
            continue
        if leg.stale:
            yield leg.leg, Fault.from_table("unreported-page")
        else:
            # Older refusals are counted in the leg's row.
            for fault in about_learner(status, status, service, set()):
                if fault.cause != "refused":
                    silent = status.status == "silent"
                    yield leg.leg, fault._replace(level="error") if silent else fault
    yield from all_lost(statuses.values(), service)


def _list_service_faults(service: ServiceStatus) -> Iterator[Fault]:
    if service.note is not None:
        yield Fault("error", "service", service.note, "As it says.", key="note")
    for key, question in service.strays.items():
        yield Fault("error", "key", f"nobody reads {key}", question, key=key)
    if service.state is not None:
        for line in service.state.refused:
            yield Fault.from_table("state_refused-page", key=line, line=line)
        if service.state.exposed is not None:
            yield Fault("error", "service", service.state.exposed, "As it says.", key="exposed")


def _with_remedy(finding: Finding) -> Finding:
    """Give a finding the remedy of its note, where that says more; written as a sentence."""
    # Causes whose own remedy says more than the note's.
    remedy = (
        None
        if finding.cause in ("signs", "not_this_robot", "leg_swap")
        else remedy_of(finding.what)
    )
    text = remedy or finding.remedy
    text = re.sub(r"^[a-z]", lambda match: match.group().upper(), text)
    return finding._replace(remedy=text if text.endswith((".", "?")) else f"{text}.")
