"""Scores a recording: every leg's events against its truth.

The composition of this package for those who have messages; those who have arrays call
:func:`~adaptive_contact.score.matching.match` and
:func:`~adaptive_contact.score.summary.summarise` themselves.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

from adaptive_contact.errors import RecordingError
from adaptive_contact.robot import Robot
from adaptive_contact.score.matching import match
from adaptive_contact.score.outcome import LegOutcome
from adaptive_contact.score.streams import Gatherer, Received
from adaptive_contact.score.summary import Summary, summarise
from adaptive_contact.wire import NS_PER_S, ContactEvent


@dataclasses.dataclass(frozen=True, slots=True)
class Score:
    """Holds a scored recording."""

    outcomes: tuple[LegOutcome, ...]  # every judged leg, in order of appearance
    total: Summary  # all legs together
    legs: dict[str, Summary]  # each leg alone
    rejects: dict[str, int]  # messages that could not be used, by reason
    notes: tuple[str, ...]  # what a reader of the figures should know, one line each


def score_messages(
    messages: Iterable[Received],
    robot: Robot,
    events: Iterable[ContactEvent] | None = None,
    *,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> Score:
    """Score a recording that holds samples and truth.

    Args:
        messages: of the recording.
        robot: whose geometry shows swings and lifts.
        events: scored instead of those in the recording.
        from_s: judge the swings that begin this long after the first sample, s, or later.
        to_s: and before this.

    Raises:
        RecordingError: samples, truth or events are missing, or runs overlap in time.
        ConfigurationError: swings cannot be found (see :meth:`Gatherer.stream`).
    """
    gathered = Gatherer(robot)
    for message in messages:
        gathered.add_message(message)
    if not gathered.legs:
        usable = "usable " if gathered.rejects else ""
        raise RecordingError(
            f"no {usable}servo samples (robot/leg/*/servo) in the recording; record while the "
            "source runs, and look at it with `adaptive-contact doctor`"
        )
    if not set(gathered.legs) & set(robot.leg_ids):
        raise RecordingError(
            f"its legs ({', '.join(gathered.legs)}) are not those of robot '{robot.name}' "
            f"({', '.join(robot.leg_ids)}); give the --config of the robot that was recorded"
        )
    if not gathered.legs_with_truth:
        raise RecordingError(
            "no truth (robot/leg/*/truth) in the recording; only recordings with "
            "truth, of the simulator or of foot switches, can be scored"
        )
    if events is not None:
        gathered.replace_events(events)
    elif not gathered.legs_with_events:
        raise RecordingError(
            "no contact events (robot/leg/*/contact) in the recording; make them with "
            "`adaptive-contact replay RECORDING --events OUT.jsonl` and give them with --events"
        )
    outcomes = tuple(
        match(gathered.stream(leg), gathered.events(leg)) for leg in gathered.legs_with_truth
    )
    start_ns = min(outcome.span_ns[0] for outcome in outcomes)
    if from_s > 0.0 or to_s < math.inf:
        from_ns = start_ns + round(from_s * NS_PER_S)
        # One past the last sample, so that an open end takes in all.
        end_ns = max(outcome.span_ns[1] for outcome in outcomes) + 1
        to_ns = end_ns if math.isinf(to_s) else start_ns + round(to_s * NS_PER_S)
        outcomes = tuple(outcome.between(from_ns, to_ns) for outcome in outcomes)
    total = summarise(outcomes)
    return Score(
        outcomes=outcomes,
        total=total,
        legs={outcome.leg: summarise([outcome]) for outcome in outcomes},
        rejects={reason.value: n for reason, n in sorted(gathered.rejects.items()) if n},
        notes=_notes(gathered, total),
    )


def _notes(gathered: Gatherer, total: Summary) -> tuple[str, ...]:
    rows = total.rows
    blind = [leg for leg in gathered.legs if leg not in gathered.legs_with_truth]
    unseen = sorted(set(gathered.legs_with_events) - set(gathered.legs))
    withheld = ", ".join(f"{leg} {count}" for leg, count in sorted(gathered.withheld.items()))
    rejects = [(reason, n) for reason, n in sorted(gathered.rejects.items()) if n]
    refused, reasons = sum(n for _, n in rejects), ", ".join(f"{r.value} {n}" for r, n in rejects)
    late = "late" in rows and not rows[total.headline].touches
    notes = (
        blind and f"no truth of {', '.join(blind)}: left out",
        unseen and f"events of {', '.join(unseen)}, which sent no samples: left out",
        not total.swings and "no swing in the recording: nothing could be judged",
        withheld and f"events withheld while the leg was ambiguous, scored as none: {withheld}",
        refused and f"{refused} messages could not be used: {reasons}",
        late and "no touch of the headline: swings end with theirs, as where events stop them",
    )
    return tuple(note for note in notes if note)
