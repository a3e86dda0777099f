"""What needs a person now, with what to do: the banner over the live page.

``doctor`` looks for three seconds at everything on the wire; this looks at what the service says of
itself and of its legs, as often as it says it.  One cause is one entry, as there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Final

from adaptive_contact.service.doctor import about_learner, all_lost
from adaptive_contact.service.findings import Cause, Fault, Finding, Level, entries
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.service.watch import View
from adaptive_contact.wire import LearnerStatus

__all__ = ["attention", "remedy_of"]

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
            r"no baseline|baseline has no leg|not good enough yet|a first model is being fitted",
            "Let the leg swing freely, in many directions; a first model takes some 40 swings.",
        ),
        (
            r"no phase|no lengths_m",
            "Give lengths_m in robot.toml, or have the controller send phase.",
        ),
        (
            r"samples are those of leg",
            "Give each leg the same id in the source and in robot.toml.",
        ),
        (
            r"no lift could be",
            "Publish at a higher rate, lift higher, or have phase begin with the lift.",
        ),
        (
            r"after phase had turned",
            "Send swing for some 5 ticks more, until the foot can have arrived.",
        ),
        (
            r"needs a preview",
            "Publish preview, or fit a baseline of a library without.",
        ),
        (
            r"ms apart, robot\.toml says",
            "Correct period_s in robot.toml, or the rate of the control loop.",
        ),
        (
            r"faults in learning",
            "This is a defect of adaptive-contact: report it with the service's log. The leg "
            "works on.",
        ),
        (
            r"t_ns jitters",
            "Stamp each reading when it is read, with a monotonic clock.",
        ),
        (
            r"no servo has answered|has not answered",
            "Look at the servo's cable, supply and id.",
        ),
        (
            r"no usable sample|payload refused",
            "Correct what the source publishes; docs/messages.md says what each reason means.",
        ),
        (
            r"no sample",
            "Start what publishes this leg's samples; `adaptive-contact doctor` says what is "
            "there.",
        ),
        (
            r"another program publishes|starts anew every few samples",
            "Find the second program that publishes this leg, and stop it.",
        ),
    )
)
# Causes whose own remedy says more than the note's.
_OWN_REMEDY: Final = frozenset({Cause.SIGNS, Cause.NOT_THIS_ROBOT, Cause.LEG_SWAP})
_CAP: Final = re.compile(r"^[a-z]")


def remedy_of(note: str) -> str | None:
    """What to do about the note of a leg, None where it is not known."""
    return next((remedy for words, remedy in _REMEDIES if words.search(note)), None)


def attention(view: View, statuses: Mapping[str, LearnerStatus]) -> list[Finding]:
    """What needs a person, the worst first.

    Args:
        view: what is known.
        statuses: last one of each leg.
    """
    if not view.connected:
        return [
            _of_all(
                "error",
                "the router is lost",
                "This page reconnects by itself as soon as "
                "`adaptive-contact serve`, or the router, is back.",
            )
        ]
    if not view.alive and view.service is not None:
        return [
            _of_all(
                "error",
                "the service is gone: no contact is reported",
                "Start `adaptive-contact serve` again.",
            )
        ]
    if view.service is None:
        if view.alive:
            return []
        return [
            _of_all(
                "error",
                "no service is running here",
                "Start `adaptive-contact serve`, or give `watch` its --connect and --namespace.",
            )
        ]
    return [_with_remedy(finding) for finding in entries(_faults(view, view.service, statuses))]


def _of_all(level: Level, what: str, remedy: str) -> Finding:
    return Finding(level, None, what, remedy, Cause.SERVICE.value, [])


def _faults(
    view: View, service: ServiceStatus, statuses: Mapping[str, LearnerStatus]
) -> Iterator[tuple[str | None, Fault]]:
    for fault in _of_service(service):
        yield None, fault
    unheard = sum(leg.unheard for leg in view.legs)
    if unheard:
        what = f"{unheard} contacts were reported and did not arrive at this page"
        remedy = "look at the network between the service and `watch`"
        yield None, Fault("warning", Cause.SERVICE, what, remedy, key="unheard")
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
        yield Fault(
            "error",
            Cause.KEY,
            f"nobody reads {key}",
            question,
            key=key,
        )
    if service.state is not None:
        for line in service.state.refused:
            what = f"learned state was refused: {line}"
            remedy = (
                "The leg started from its baseline; `adaptive-contact state show` lists the rest."
            )
            yield Fault("warning", Cause.STATE_REFUSED, what, remedy, key=line)
        if service.state.exposed is not None:
            yield Fault("error", Cause.SERVICE, service.state.exposed, "As it says.", key="exposed")
    counts: tuple[tuple[Level, int, str, str], ...] = (
        (
            "error",
            service.events_lost,
            "contact events were lost to a subscriber that hung",
            "Find the subscriber that blocks in its callback, and let it only enqueue there.",
        ),
        (
            "error",
            service.callback_faults,
            "exceptions in the service's Zenoh callbacks",
            "This is a defect of adaptive-contact: report it with the service's log.",
        ),
        (
            "warning",
            service.stalls,
            "times the service stood still for a second or more",
            "Look at its log, and at what else the machine was doing.",
        ),
    )
    for level, times, what, remedy in counts:
        if times:
            yield Fault(level, Cause.SERVICE, f"{times} {what}", remedy, key=what)


def _with_remedy(finding: Finding) -> Finding:
    """The finding with the remedy of its note, where that says more; as a sentence."""
    remedy = None if finding.cause in _OWN_REMEDY else remedy_of(finding.what)
    text = remedy or finding.remedy
    text = _CAP.sub(lambda match: match.group().upper(), text)
    return finding._replace(remedy=text if text.endswith((".", "?")) else f"{text}.")
