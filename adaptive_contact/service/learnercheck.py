"""What the learners' own statuses say is wrong, of one leg and of all together."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

from adaptive_contact.conventions.judge import speaks_of_angles
from adaptive_contact.diagnose.leg_ids import SWAPPED
from adaptive_contact.service.findings import REFUSED_FOR, Cause, Fault, Level
from adaptive_contact.service.readings import ECHO_FOUND, ECHO_REMEDY
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

# Legs that fail together have one cause; one leg alone has its own.
_SEVERAL_LEGS: Final = 2
_FIGURES: Final = re.compile(r"[0-9.]+")
# Words of notes on what the samples themselves may show.
_NOTED: Final = {
    "ms apart, robot.toml says": Cause.PERIOD,
    "t_ns jitters": Cause.JITTER,
    "restarts every few samples": Cause.RUN,
    "carry no phase": Cause.PHASE,
    "answered": Cause.INVALID,
    "payload refused": Cause.UNREADABLE,
}
_NOTES: Final = "docs/operating.md says what each note asks for"


def about_learner(
    before: LearnerStatus, status: LearnerStatus, service: ServiceStatus | None, causes: set[Cause]
) -> Iterator[Fault]:
    """What a leg's own status says, but for what is known of its stream already."""
    note = status.note or ""
    if speaks_of_angles(note):
        causes = causes | {Cause.SIGNS}
    known = {str(reason) for cause in causes for reason in REFUSED_FOR.get(cause, ())}
    refused = {
        reason: times for reason, times in status.rejects.items() if times and reason not in known
    }
    if refused:
        listed = ", ".join(f"{reason} {times}" for reason, times in sorted(refused.items()))
        grown = any(times > before.rejects.get(reason, 0) for reason, times in refused.items())
        yield Fault(
            "warning" if grown else "note",
            Cause.REFUSED,
            "the service has refused samples or readings since its start",
            "docs/messages.md says what each reason means",
            listed,
            sum(refused.values()),
        )
    if SWAPPED in note:
        what = "samples come under another leg's id"
        remedy = "give each leg the same id in the source and in robot.toml"
        yield Fault("error", Cause.LEG_SWAP, what, remedy, note)
    elif speaks_of_angles(note):
        # A wrong yaw or a small zero changes no height, and the leg works on.
        level: Level = "error" if status.status == "ambiguous" else "warning"
        what = "angles are not counted as robot.toml says"
        remedy = "write what is said here into robot.toml, and start the service again"
        yield Fault(level, Cause.SIGNS, what, remedy, note)
    elif status.status == "learning":
        yield _learning(status, service)
    elif status.doubt == "echo":
        if Cause.ECHO not in causes:
            yield Fault("error", Cause.ECHO, ECHO_FOUND, ECHO_REMEDY, note, key="some")
    elif status.doubt == "phase":
        what = "phase is swapped: stance is published as swing, and swing as stance"
        remedy = "publish phase = swing while the foot is off the ground, or leave phase out"
        yield Fault("error", Cause.PHASE, what, remedy, key="swapped")
    elif status.status == "ambiguous":
        yield Fault(
            "error",
            Cause.AMBIGUOUS,
            "ambiguous: contacts of the leg are not to be relied on",
            f"look at the foot and its servos; {_NOTES}",
            status.note,
        )
    elif status.note is not None:
        cause = next((c for words, c in _NOTED.items() if words in status.note), Cause.LEG_NOTE)
        if cause not in causes:
            # Of two legs with the same note, figures differ.
            key = _FIGURES.sub("", status.note)
            yield Fault("warning", cause, status.status, _NOTES, status.note, key=key)
    elif status.status == "silent":
        what = "silent: the service uses none of the leg's samples"
        yield Fault("error", Cause.LEG_NOTE, what, "look at the service's log")


def _learning(status: LearnerStatus, service: ServiceStatus | None) -> Fault:
    if service is not None and service.baseline is None:
        return Fault(
            "warning",
            Cause.LEARNING,
            "learning: contacts are reported by what is known of any leg, until this one is known",
            f"let the leg swing, in many directions, or start with --baseline; {_NOTES}",
            status.note,
        )
    return Fault(
        "error",
        Cause.LEARNING,
        "learning: the baseline is not used, contacts are reported by what is known of any leg",
        "check that the baseline, the legs' ids, signs and offsets belong to this robot; until the "
        f"leg is known, let it swing; {_NOTES}",
        status.note,
    )


def all_lost(
    of_legs: Iterable[LearnerStatus], service: ServiceStatus | None
) -> Iterator[tuple[str, Fault]]:
    """What all legs have in common is not of a foot.

    Args:
        of_legs: last statuses of those whose streams show no cause.
        service: its status.
    """
    given = service is not None and service.baseline is not None
    statuses = [status for status in of_legs if status.status != "silent"]
    lost = [
        status
        for status in statuses
        if status.status == "ambiguous" or (status.status == "learning" and given)
    ]
    if len(statuses) < _SEVERAL_LEGS or len(lost) < len(statuses):
        return
    for status in lost:
        fault = Fault(
            "error",
            Cause.NOT_THIS_ROBOT,
            "all legs move otherwise than their models",
            "check, in this order: signs (directions), zeros (offsets_rad), the order of joints "
            "and of legs, and whether the baseline is of this robot; `adaptive-contact robot "
            "check` shows each joint",
            status.note,
        )
        yield status.leg, fault
