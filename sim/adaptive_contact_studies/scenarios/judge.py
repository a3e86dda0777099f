"""One learner on one leg-run, held against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact.score import (
    LegOutcome,
    LegStream,
    SwingTable,
    contacts_of,
    match,
    swings_to_recovery,
)
from adaptive_contact_studies.scenarios.replay import STATUSES, LegReplay, SwingLog
from adaptive_contact_studies.scenarios.spec import Mark, Scenario

__all__ = [
    "SETTLED",
    "Judged",
    "Recovery",
    "judge",
    "longest_lock_out",
    "swings_until_valid",
    "within",
]

_VALID: Final = STATUSES.index("valid")
_AMBIGUOUS: Final = STATUSES.index("ambiguous")
# The phase in which a foot is caught, and the swings after which that can be told: it is caught
# when it next rests, and two swings in a row have to show it.
CAUGHT: Final = "caught"
CAUGHT_GRACE: Final = 4
# Swings in a row that a learner calls itself valid, before it is taken at its word.
SETTLED: Final = 20


@dataclass(frozen=True)
class Recovery:
    """What happened after a mark.

    Attributes:
        swings: until the leg could be relied on again, None where it could not.
        alarms: false ones on the way; all there were where it did not recover.
        of: swings that there were.
        kind: what the change was taken for, by what was told last; None where nothing was.
    """

    swings: int | None
    alarms: int
    of: int
    kind: str | None = None


@dataclass(frozen=True, eq=False)
class Judged:
    """One learner on one leg-run.

    Attributes:
        outcome: of all its events.
        recovery: by name of the mark.
        lock_out: longest run of swings lost, from the first mark on.
        confirmed: ticks it took for free.
        touched: those of them on which the leg touched something.
        touched_before: those of these that began in touch, not with the touch itself.
        until_valid: swings until it called itself valid and went on to, None where it did not.
        valid_ns: when it did.
        doubted: whether it ever called itself anything else.
        caught: swings that ended while the foot was held by the stage, but for the first few.
        caught_told: those of them after which it called itself ambiguous.
    """

    outcome: LegOutcome
    recovery: dict[str, Recovery]
    lock_out: int
    confirmed: int
    touched: int
    touched_before: int
    until_valid: int | None
    valid_ns: int | None
    doubted: bool
    caught: int
    caught_told: int


def judge(scenario: Scenario, stream: LegStream, replayed: LegReplay) -> Judged:
    """Judge what a learner made of a leg-run."""
    outcome = match(stream, replayed.events)
    marks = scenario.marks
    # Each mark's time ends with the next one; there may be none.
    ends = [*(mark.at_s for mark in marks[1:]), np.inf][: len(marks)]
    recovery = {
        mark.name: _recovery(outcome, replayed.log, mark, end, mixed=scenario.mixed)
        for mark, end in zip(marks, ends, strict=True)
    }
    first_s = marks[0].at_s if marks else 0.0
    until, valid_ns = swings_until_valid(replayed.log)
    caught, told = _caught(scenario, replayed.log)
    return Judged(
        outcome=outcome,
        recovery=recovery,
        lock_out=longest_lock_out(within(outcome, first_s, np.inf).swings),
        confirmed=replayed.confirmed,
        touched=len(replayed.touched_ns),
        touched_before=_touched_before(stream, replayed),
        until_valid=until,
        valid_ns=valid_ns,
        doubted=bool(np.any(replayed.log.status != _VALID)),
        caught=caught,
        caught_told=told,
    )


def within(outcome: LegOutcome, from_s: float, to_s: float) -> LegOutcome:
    """The swings that begin in a stretch of time, with what lies in them."""
    end_ns = np.iinfo(np.int64).max if np.isinf(to_s) else round(to_s * 1e9)
    return outcome.between(round(from_s * 1e9), end_ns)


def longest_lock_out(swings: SwingTable) -> int:
    """Longest run of swings in which a leg could not be relied on.

    A swing is lost with a missed touch or a false alarm.  A blind leg is shown up by touches only,
    so that a swing without any, and without an alarm, does not end a run of lost touches; such a
    run counts the swings with touches.
    """
    lost = swings.errors > 0
    telling = (swings.touches > 0) | (swings.false_alarms > 0)
    return max(_longest_run(lost), _longest_run(lost[telling]))


def swings_until_valid(log: SwingLog) -> tuple[int | None, int | None]:
    """Swings until a learner called itself valid for :data:`SETTLED` swings in a row.

    A single swing that it doubts later on is no part of how it began.

    Returns:
        Their number, 0 for one that did from the first, and the time; None where it never did.
    """
    valid = log.status == _VALID
    if len(valid) < SETTLED:
        return None, None
    runs = np.lib.stride_tricks.sliding_window_view(valid, SETTLED).all(axis=1)
    if not runs.any():
        return None, None
    at = int(np.argmax(runs))
    return (at + 1, int(log.t_ns[at])) if at else (0, 0)


def _recovery(
    outcome: LegOutcome, log: SwingLog, mark: Mark, end_s: float, *, mixed: bool
) -> Recovery:
    swings = within(outcome, mark.at_s, end_s).swings
    # Where every swing ends in contact there are none without, and recovery cannot need them.
    needed = {} if mixed else {"least_of_a_kind": 0}
    mark_ns = round(mark.at_s * 1e9)
    count = swings_to_recovery(swings, mark_ns, **needed)
    # By their own time: those of the swing that was under way at the mark are among them.
    until_s = end_s if count is None else swings.start_ns[count] / 1e9
    alarms = (outcome.alarms_ns >= mark_ns) & (outcome.alarms_ns < until_s * 1e9)
    told = log.kind[(log.t_ns >= mark_ns) & (log.t_ns < end_s * 1e9) & (log.kind >= 0)]
    kind = KINDS[told[-1]] if len(told) else None
    return Recovery(count, int(np.sum(alarms)), len(swings.start_ns), kind)


def _caught(scenario: Scenario, log: SwingLog) -> tuple[int, int]:
    """Swings that ended while the foot was caught, and those of them after which that was told."""
    phases = [phase for phase in scenario.phases if phase.name == CAUGHT]
    if not phases:
        return 0, 0
    inside = (log.t_ns >= phases[0].from_s * 1e9) & (log.t_ns < phases[0].to_s * 1e9)
    status = log.status[inside][CAUGHT_GRACE:]
    return len(status), int(np.sum(status == _AMBIGUOUS))


def _touched_before(stream: LegStream, replayed: LegReplay) -> int:
    """Touching ticks taken for free whose contact held at the sample before, too."""
    contacts = contacts_of(stream.truth, int(stream.t_ns[0]))
    tick = np.searchsorted(stream.t_ns, replayed.touched_ns)
    before = stream.t_ns[np.maximum(tick - 1, 0)]
    begun = np.searchsorted(contacts.onset_ns, before, side="right")
    return int(np.sum(begun > np.searchsorted(contacts.release_ns, before, side="right")))


def _longest_run(lost: NDArray[np.bool_] | Sequence[bool]) -> int:
    edges = np.diff(np.concatenate(([0], np.asarray(lost, dtype=np.int64), [0])))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return int(lengths.max(initial=0))
