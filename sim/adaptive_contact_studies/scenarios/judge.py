"""Figures of a scenario: what each learner did on all its leg-runs, held against the truth."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.core.learn.change_classifier import KINDS
from adaptive_contact.score import (
    LegOutcome,
    LegStream,
    Summary,
    SwingTable,
    is_harmful,
    match,
    summarise,
    swings_to_recovery,
)
from adaptive_contact_studies.scenarios.replay import STATUSES, LegReplay, Replayed, SwingLog
from adaptive_contact_studies.scenarios.spec import Mark, Scenario, Variant

Tree = dict[str, Any]

_VALID: Final = STATUSES.index("valid")
# Swings in a row that a learner calls itself valid, before it is taken at its word.
SETTLED: Final = 20
# What a change is taken for of which no kind is reported.
NOTHING: Final = "nothing"
_END_NS: Final = int(np.iinfo(np.int64).max)


class Recovery(NamedTuple):
    """What happened after a mark."""

    swings: int | None  # until the leg could be relied on again, None where it could not
    alarms: int  # false ones on the way; all there were where it did not recover
    kind: str  # what the change was taken for, by the last report


@dataclass(frozen=True, eq=False)
class Judged:
    """One learner on one leg-run."""

    outcome: LegOutcome  # of all its events
    recovery: dict[str, Recovery]  # by name of the mark
    lock_out: int  # longest run of swings lost, from the first mark on
    replay: LegReplay
    # swings until it called itself valid and went on to, None where it did not
    until_valid: int | None
    valid_ns: int | None  # when it did
    wavered: bool  # whether it ever called itself anything else
    caught: int  # swings that ended while the foot was held by the stage, but for the first few
    caught_told: int  # those of them after which it called itself ambiguous


@dataclass(frozen=True, eq=False)
class Judgement:
    """A scenario's leg-runs, judged."""

    scenario: Scenario
    recordings: list[int] = field(default_factory=list)  # of each leg-run, the recording it is of
    # the frozen and the full learner on what each is compared against; the full one raises far
    # fewer false alarms
    reference: list[LegOutcome] = field(default_factory=list)
    full_reference: list[LegOutcome] = field(default_factory=list)
    variants: dict[Variant, list[Judged]] = field(default_factory=dict)  # leg-run by leg-run


def score_scenario(
    scenario: Scenario, runs: Iterable[Replayed], references: Iterable[Replayed]
) -> Judgement:
    """Score all leg-runs of a scenario.

    Args:
        scenario: which.
        runs: its recordings, replayed.
        references: what each of them is compared against.
    """
    found = Judgement(scenario, variants={variant: [] for variant in scenario.variants})
    for number, (run, twin) in enumerate(zip(runs, references, strict=True)):
        for leg, stream in run.streams.items():
            learners = twin.learners[leg]
            found.recordings.append(number)
            stream_of_twin = twin.streams[leg]
            found.reference.append(match(stream_of_twin, learners["frozen"].events))
            found.full_reference.append(match(stream_of_twin, learners["full"].events))
            for variant, replayed in run.learners[leg].items():
                found.variants[variant].append(score_leg_run(scenario, stream, replayed))
    return found


def score_leg_run(scenario: Scenario, stream: LegStream, replayed: LegReplay) -> Judged:
    """Score what a learner made of a leg-run."""
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
    caught = _caught(scenario, replayed.log)
    return Judged(
        outcome=outcome,
        recovery=recovery,
        lock_out=longest_lock_out(within(outcome, first_s, np.inf).swings),
        replay=replayed,
        until_valid=until,
        valid_ns=valid_ns,
        wavered=bool(np.any(replayed.log.status != _VALID)),
        caught=len(caught),
        caught_told=int(np.sum(caught == STATUSES.index("ambiguous"))),
    )


def within(outcome: LegOutcome, from_s: float, to_s: float) -> LegOutcome:
    """The swings that begin in a stretch of time, with what lies in them."""
    end_ns = _END_NS if np.isinf(to_s) else round(to_s * 1e9)
    return outcome.between(round(from_s * 1e9), end_ns)


def longest_lock_out(swings: SwingTable) -> int:
    """Longest run of swings in which a leg could not be relied on.

    A swing is lost with a missed touch or a false alarm.  A blind leg is shown up by touches only,
    so that a swing without any, and without an alarm, does not end a run of lost touches; such a
    run counts the swings with touches.
    """
    lost = swings.errors > 0
    counted = (swings.touches > 0) | (swings.false_alarms > 0)
    return max(_longest_run(lost), _longest_run(lost[counted]))


def swings_until_valid(log: SwingLog) -> tuple[int | None, int | None]:
    """Swings until a learner called itself valid for :data:`SETTLED` swings in a row.

    A single later swing in which it is not valid is no part of how it began.

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


def figures(judgement: Judgement) -> Tree:
    """All figures of a scenario."""
    scenario, variants = judgement.scenario, judgement.variants
    frozen = [judged.outcome for judged in variants["frozen"]]
    from_s = scenario.marks[0].at_s if scenario.marks else 0.0
    until_s = scenario.phases[-1].to_s
    harmful: bool | None = None
    if scenario.expect in ("recover", "follow") and frozen:
        harmful = is_harmful(
            [within(o, from_s, until_s) for o in frozen],
            [within(o, from_s, until_s) for o in judgement.reference],
        )
    return {
        "about": scenario.about,
        "leg_runs": len(judgement.recordings),
        "recordings": len(set(judgement.recordings)),
        "simulated_s": scenario.seconds,
        "counts_as_one_to_recover_from": harmful,
        "variants": {name: _variant(judgement, judged) for name, judged in variants.items()},
    }


def quantile(values: Iterable[float | None], share: float) -> float | None:
    """The value that at least a share of them do not exceed; None stands for "never"."""
    ordered = sorted(math.inf if value is None else float(value) for value in values)
    if not ordered:
        return None
    found = ordered[max(math.ceil(share * len(ordered)) - 1, 0)]
    return None if math.isinf(found) else found


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
    kinds = log.kind[(log.t_ns >= mark_ns) & (log.t_ns < end_s * 1e9) & (log.kind >= 0)]
    kind = KINDS[kinds[-1]] if len(kinds) else NOTHING
    return Recovery(count, int(np.sum(alarms)), kind)


def _caught(scenario: Scenario, log: SwingLog) -> NDArray[np.int64]:
    """Statuses after swings that ended while the foot was caught, but for the first few."""
    # The phase in which a foot is caught, and the swings after which that can be detected: it is
    # caught when it next rests, and two swings in a row have to show it.
    ends = [(p.from_s, p.to_s) for p in scenario.phases if p.name == "caught"] or [(0.0, 0.0)]
    inside = (log.t_ns >= ends[0][0] * 1e9) & (log.t_ns < ends[0][1] * 1e9)
    return np.asarray(log.status[inside][4:])


def _longest_run(lost: NDArray[np.bool_] | Sequence[bool]) -> int:
    edges = np.diff(np.concatenate(([0], np.asarray(lost, dtype=np.int64), [0])))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return int(lengths.max(initial=0))


def _judged_part(scenario: Scenario, outcomes: Sequence[LegOutcome]) -> list[LegOutcome]:
    """The phases over which a scenario is held to something."""
    phases = [scenario.phase(name) for name in scenario.judged]
    return [within(outcome, p.from_s, p.to_s) for p in phases for outcome in outcomes]


def _variant(judgement: Judgement, judged: list[Judged]) -> Tree:
    scenario, before = judgement.scenario, judgement.scenario.phases[0]
    outcomes = [one.outcome for one in judged]
    own, reference, full = (
        _judged_part(scenario, of)
        for of in (outcomes, judgement.reference, judgement.full_reference)
    )
    confirmed = sum(one.replay.confirmed for one in judged)
    touched = sum(one.replay.touched for one in judged)
    tree: Tree = {
        "before": _summary([within(o, before.from_s, before.to_s) for o in outcomes]),
        "judged": _summary(own),
        **_lost(judgement, outcomes),
        "harmful": _harmful(own, reference, full),
        "recovery": {mark.name: _recovery_figures(judged, mark.name) for mark in scenario.marks},
        "longest_lock_out": max((one.lock_out for one in judged), default=0),
        "confirmed_ticks": confirmed,
        "touching_ticks_confirmed": touched,
        "touching_share": touched / confirmed if confirmed else None,
        "ever_doubted": sum(one.wavered for one in judged),
        "caught_swings": sum(one.caught for one in judged),
        "caught_told": sum(one.caught_told for one in judged),
    }
    if scenario.expect == "start":
        tree["start"] = _start(judgement, judged)
    return tree


def _recovery_figures(judged: list[Judged], mark: str) -> Tree:
    each = [one.recovery[mark] for one in judged]
    swings = [recovery.swings for recovery in each]
    alarms = [recovery.alarms for recovery in each]
    return {
        "recovered": sum(n is not None for n in swings),
        "swings_median": quantile(swings, 0.5),
        "swings_p95": quantile(swings, 0.95),
        "alarms_median": quantile(alarms, 0.5),
        "alarms_p95": quantile(alarms, 0.95),
        "taken_for": dict(Counter(recovery.kind for recovery in each)),
    }


def _start(judgement: Judgement, judged: list[Judged]) -> Tree:
    """How soon learners called themselves valid, and how good they were from then on."""
    until = [one.until_valid for one in judged]
    own, reference, full = (
        [
            outcome.between(one.valid_ns, _END_NS)
            for one, outcome in zip(judged, of, strict=True)
            if one.valid_ns is not None
        ]
        for of in ([one.outcome for one in judged], judgement.reference, judgement.full_reference)
    )
    return {
        "valid": sum(n is not None for n in until),
        "swings_median": quantile(until, 0.5),
        "swings_p95": quantile(until, 0.95),
        "when_valid": _summary(own),
        "reference": _summary(reference),
        "full_reference": _summary(full),
        "harmful": _harmful(own, reference, full),
    }


def _harmful(own: list[LegOutcome], *twins: list[LegOutcome]) -> bool:
    """Whether it is much worse than any of what it is compared against."""
    return bool(own) and any(is_harmful(own, twin) for twin in twins)


def _lost(judgement: Judgement, own: list[LegOutcome]) -> Tree:
    """Points of recall lost against the reference, with an interval over recordings."""
    counts = np.array(
        [
            [n for one in pair for n in _found(_judged_part(judgement.scenario, [one]))]
            for pair in zip(own, judgement.reference, strict=True)
        ],
        dtype=np.float64,
    ).reshape(-1, 4)
    if not counts[:, 1].sum() or not counts[:, 3].sum():
        return {"recall_lost_points": None, "recall_lost_interval": None}
    # Recordings are what is independent: legs of one share a body, its sway and its battery, and
    # one bad leg must not pass for many bad swings.
    numbers = np.unique(judgement.recordings, return_inverse=True)[1]
    whole = np.zeros((numbers[-1] + 1, counts.shape[1]))
    np.add.at(whole, numbers, counts)
    drawn = np.random.default_rng(0).integers(0, len(whole), (2000, len(whole)))
    low, high = np.nanpercentile(_points(whole[drawn].sum(axis=1)), (2.5, 97.5))
    return {
        "recall_lost_points": float(_points(counts.sum(axis=0))),
        "recall_lost_interval": [float(low), float(high)],
    }


def _points(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore", divide="ignore"):
        own = counts[..., 0] / counts[..., 1]
        reference = counts[..., 2] / counts[..., 3]
    return np.asarray(100.0 * (reference - own))


def _found(outcomes: list[LegOutcome]) -> tuple[int, int]:
    counted = summarise(outcomes).counted
    return counted.found, counted.touches


def _summary(outcomes: list[LegOutcome]) -> Tree:
    summary: Summary = summarise(outcomes)
    counted, hours = summary.counted, summary.per_hour_interval
    return {
        "touches": counted.touches,
        "found": counted.found,
        "recall": counted.recall,
        "recall_interval": list(counted.interval),
        "false_alarms": summary.false_alarms,
        "judged_ticks": summary.judged_ticks,
        "per_robot_hour": summary.per_hour,
        "per_robot_hour_interval": [hours.low, hours.high if math.isfinite(hours.high) else None],
    }
