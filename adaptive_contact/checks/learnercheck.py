"""Finds faults in the learners' statuses, of one leg and of all together."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Final

from adaptive_contact.checks.findings import REFUSED_FOR, Cause, Fault
from adaptive_contact.notes import SWAPPED, speaks_of_angles
from adaptive_contact.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

# Words of notes on what the samples themselves may show.
_NOTED: Final[dict[str, Cause]] = {
    "ms apart, robot.toml says": "period",
    "t_ns jitters": "jitter",
    "ticks arrive together": "jitter",
    "restarts every few samples": "run",
    "seq wraps at": "seq",
    "carry no phase": "phase",
    "goals go beyond": "goals",
    "answered": "invalid",
    "payload refused": "unreadable",
}


def about_learner(
    before: LearnerStatus,
    status: LearnerStatus,
    service: ServiceStatus | None,
    causes: set[Cause],
    samples: int = 0,
) -> Iterator[Fault]:
    """Yield the faults that a leg's own status shows, without those known of its samples."""
    note = status.note or ""
    if speaks_of_angles(note):
        causes = causes | {"signs"}
    known = {str(reason) for cause in causes for reason in REFUSED_FOR.get(cause, ())}
    refused = {
        reason: times for reason, times in status.rejects.items() if times and reason not in known
    }
    if refused:
        listed = ", ".join(f"{reason} {times}" for reason, times in sorted(refused.items()))
        grown = sum(times - before.rejects.get(reason, 0) for reason, times in refused.items())
        yield Fault.from_table(
            "refused", listed, grown, level="warning" if grown else "note", total=samples
        )
    stale = "held" if "held" in note else "twins" if "of leg" in note else "old"
    doubts = {
        "echo": Fault.from_table("echo", note, key="some"),
        "unproved": Fault.from_table("near_echo-unproved", key="some"),
        "stale": Fault.from_table(stale, note, key="some"),
        "phase": Fault.from_table("phase-swapped", key="swapped"),
        "publishers": Fault.from_table("two_publishers", note, publishers=2),
    }
    if SWAPPED in note:
        yield Fault.from_table("leg_swap", note)
    elif speaks_of_angles(note):
        # A wrong yaw or a small zero changes no height, and the leg works on.
        works_on = status.status != "ambiguous"
        yield Fault.from_table("signs-service", note, level="warning" if works_on else "error")
    elif status.status == "learning":
        cold = service is not None and service.baseline is None
        yield Fault.from_table("learning-cold" if cold else "learning", status.note)
    elif status.doubt in doubts:
        if doubts[status.doubt].cause not in causes:
            yield doubts[status.doubt]
    elif status.status == "ambiguous" and status.doubt != "unjudged":
        yield Fault.from_table("ambiguous", status.note)
    elif status.note is not None:
        cause: Cause = next((c for words, c in _NOTED.items() if words in status.note), "leg_note")
        if cause not in causes:
            # Of two legs with the same note, figures differ.
            key = re.sub(r"[0-9.]+", "", status.note)
            yield Fault(
                "warning",
                cause,
                status.status,
                "docs/operating.md lists what to do for each note",
                status.note,
                key=key,
            )
    elif status.status == "silent":
        yield Fault.from_table("leg_note-silent")


def all_lost(
    of_legs: Iterable[LearnerStatus], service: ServiceStatus | None
) -> Iterator[tuple[str, Fault]]:
    """Report a fault that all legs share: it is not of a foot.

    Args:
        of_legs: last statuses of those whose streams show no cause.
        service: its status.
    """
    given = service is not None and service.baseline is not None
    statuses = [status for status in of_legs if status.status != "silent"]
    lost = [
        status
        for status in statuses
        if (status.status == "ambiguous" and status.doubt not in ("unjudged", "unproved"))
        or (status.status == "learning" and given)
    ]
    # Legs that fail together have one cause; one leg alone has its own.
    if len(statuses) < 2 or len(lost) < len(statuses):
        return
    for status in lost:
        yield status.leg, Fault.from_table("not_this_robot", status.note)
