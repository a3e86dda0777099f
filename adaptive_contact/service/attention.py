"""What needs a person now, with what to do: the banner over the live page.

``doctor`` looks for three seconds at everything on the wire; this looks at what the service says of
itself and of its legs, as often as it says it.  One cause is one entry, as there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

from adaptive_contact.service.findings import Cause, Fault, Finding, Level, entries
from adaptive_contact.service.learnercheck import about_learner, all_lost
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.service.watch import View
from adaptive_contact.wire import LearnerStatus

# What each note asks for, in the order of `docs/operating.md`; the first that fits is meant.
_REMEDIES: Final[tuple[tuple[re.Pattern[str], str], ...]] = tuple(
    (re.compile(words), remedy)
    for words, remedy in (
        (
            r"of its command's way|times as far from the model as it should be",
            "Free the foot. Look at torque, temperature and supply of its servos. It ends "
            "by itself after three free lifts.",
        ),
        (
            r"a lasting change, or a foot that drags",
            "Look for a slipped horn, a loose screw, a wrong offset. Where the leg is sound and "
            "this stays, learn a new baseline, or stop the service, run `adaptive-contact state "
            "reset --leg ID`, and start it again.",
        ),
        (
            r"copies desired",
            "Publish the positions that the servos report, not the commands. It ends by itself "
            "within two swings.",
        ),
        (
            r"phase is swapped",
            "Turn phase around at the source, or leave it out. It ends by itself within two "
            "swings.",
        ),
        (
            r"at the top of the swing",
            "Do not act on this leg's contacts. Look for what is in its way; learn a new baseline.",
        ),
        (
            r"the baseline does not fit this leg",
            "Check that the baseline, the legs' ids, signs and offsets belong to this robot.",
        ),
        (
            r"no baseline|baseline has no leg|no leg that is known",
            "Let the leg swing, in many directions; it is known after some 10 swings.",
        ),
        (
            r"no phase|no lengths_m",
            "Give lengths_m in robot.toml, or have the controller send phase.",
        ),
        (r"samples are those of leg", "Give each leg the same id in the source and in robot.toml."),
        (
            r"no lift could be",
            "Publish at a higher rate, lift higher, or have phase begin with the lift.",
        ),
        (
            r"after phase had turned",
            "Send swing for some 5 ticks more, until the foot can have arrived.",
        ),
        (r"needs a preview", "Publish preview, or fit a baseline of a library without."),
        (
            r"ms apart, robot\.toml says",
            "Correct period_s in robot.toml, or the rate of the control loop.",
        ),
        (
            r"faults in learning",
            "This is a defect of adaptive-contact: report it with the service's log. The leg "
            "works on.",
        ),
        (r"t_ns jitters", "Stamp each reading when it is read, with a monotonic clock."),
        (r"no servo has answered|has not answered", "Look at the servo's cable, supply and id."),
        (
            r"no usable sample|payload refused",
            "Correct what the source publishes; docs/messages.md says what each reason means.",
        ),
        (
            r"no sample",
            "Start the bridge or the controller; `adaptive-contact doctor` says what is there.",
        ),
        (
            r"another program publishes|restarts every few samples",
            "Find the second program that publishes this leg, and stop it.",
        ),
    )
)
# Causes whose own remedy says more than the note's.
_OWN_REMEDY: Final = frozenset({Cause.SIGNS, Cause.NOT_THIS_ROBOT, Cause.LEG_SWAP})
# A count that has grown is shown for so long.
_SHOWN_NS: Final = 60_000_000_000
_CAP: Final = re.compile(r"^[a-z]")


def remedy_of(note: str) -> str | None:
    """What to do about the note of a leg, None where it is not known."""
    return next((remedy for words, remedy in _REMEDIES if words.search(note)), None)


class Attention:
    """Lists what needs a person; what has only been counted long ago does not."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._grown_ns: dict[str, int] = {}

    def look(self, view: View, statuses: Mapping[str, LearnerStatus], now_ns: int) -> list[Finding]:
        """What needs a person, the worst first.

        Args:
            view: what is known.
            statuses: last one of each leg.
            now_ns: monotonic.
        """
        if not view.connected:
            remedy = (
                "This page goes on by itself when `adaptive-contact serve`, or the router, is back."
            )
            return [_of_all("the router is lost", remedy)]
        if view.service is None and view.alive:
            return []
        if view.service is None:
            remedy = (
                "Start `adaptive-contact serve`, or give `watch` its --connect and --namespace."
            )
            return [_of_all("no service is running here", remedy)]
        if not view.alive:
            remedy = "Start `adaptive-contact serve` again."
            return [_of_all("the service is gone: no contact is reported", remedy)]
        faults = list(_faults(view, view.service, statuses))
        faults += [(None, fault) for fault in self._grown(view, view.service, now_ns)]
        return [_with_remedy(finding) for finding in entries(faults)]

    def _grown(self, view: View, service: ServiceStatus, now_ns: int) -> Iterator[Fault]:
        """Counts that have grown of late."""
        unheard = sum(leg.unheard for leg in view.legs)
        counts: tuple[tuple[Level, int, str, str], ...] = (
            (
                "error",
                service.events_lost,
                "contact events were lost to a subscriber that hung",
                "find the subscriber that blocks in its callback, and let it only enqueue there",
            ),
            (
                "error",
                service.callback_faults,
                "exceptions in the service's Zenoh callbacks",
                "this is a defect of adaptive-contact: report it with the service's log",
            ),
            (
                "warning",
                service.stalls,
                "times the service stood still for a second or more",
                "look at its log, and at what else the machine was doing",
            ),
            (
                "warning",
                unheard,
                "contacts were reported and did not arrive at this page",
                "look at the network between the service and `watch`",
            ),
        )
        for level, times, what, remedy in counts:
            if times > self._counts.get(what, times):
                self._grown_ns[what] = now_ns
            self._counts[what] = times
            if times and now_ns - self._grown_ns.get(what, -_SHOWN_NS) < _SHOWN_NS:
                yield Fault(level, Cause.SERVICE, f"{times} {what}", remedy, key=what)


def _of_all(what: str, remedy: str) -> Finding:
    return Finding("error", None, what, remedy, Cause.SERVICE.value, [])


def _faults(
    view: View, service: ServiceStatus, statuses: Mapping[str, LearnerStatus]
) -> Iterator[tuple[str | None, Fault]]:
    for fault in _of_service(service):
        yield None, fault
    for leg in view.legs:
        status = statuses.get(leg.leg)
        if status is None:
            continue
        if leg.stale:
            what = "the service has said nothing of the leg for 2.5 s"
            remedy = "look at the service's log"
            yield leg.leg, Fault("error", Cause.UNREPORTED, what, remedy)
        else:
            # Refusals of old are counted in the leg's row.
            for fault in about_learner(status, status, service, set()):
                if fault.cause is not Cause.REFUSED:
                    silent = status.status == "silent"
                    yield leg.leg, fault._replace(level="error") if silent else fault
    yield from all_lost(statuses.values(), service)


def _of_service(service: ServiceStatus) -> Iterator[Fault]:
    if service.note is not None:
        yield Fault("error", Cause.SERVICE, service.note, "As it says.", key="note")
    for key, question in service.strays.items():
        yield Fault("error", Cause.KEY, f"nobody reads {key}", question, key=key)
    if service.state is not None:
        for line in service.state.refused:
            what = f"learned state was refused: {line}"
            remedy = (
                "The leg started from its baseline; `adaptive-contact state show` lists the rest."
            )
            yield Fault("warning", Cause.STATE_REFUSED, what, remedy, key=line)
        if service.state.exposed is not None:
            yield Fault("error", Cause.SERVICE, service.state.exposed, "As it says.", key="exposed")


def _with_remedy(finding: Finding) -> Finding:
    """The finding with the remedy of its note, where that says more; as a sentence."""
    remedy = None if finding.cause in _OWN_REMEDY else remedy_of(finding.what)
    text = remedy or finding.remedy
    text = _CAP.sub(lambda match: match.group().upper(), text)
    return finding._replace(remedy=text if text.endswith((".", "?")) else f"{text}.")
