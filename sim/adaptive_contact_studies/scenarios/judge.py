"""One learner on one leg-run, held against the truth.

Figures of a scenario: what each learner did on all its leg-runs, as a tree of numbers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact.score import (
    LegOutcome,
    LegStream,
    Summary,
    SwingTable,
    contacts_of,
    is_harmful,
    match,
    summarise,
    swings_to_recovery,
)
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_studies.evaluate import leg_stream
from adaptive_contact_studies.scenarios.recording import Recording, file_of, load
from adaptive_contact_studies.scenarios.replay import (
    STATUSES,
    LegReplay,
    Replayed,
    SwingLog,
    load_replay,
    replay_file,
)
from adaptive_contact_studies.scenarios.runner import Folders
from adaptive_contact_studies.scenarios.spec import (
    Expect,
    LegRun,
    Mark,
    ReplaySpec,
    Scenario,
    Variant,
)

_VALID: Final = STATUSES.index("valid")
_AMBIGUOUS: Final = STATUSES.index("ambiguous")
# The phase in which a foot is caught, and the swings after which that can be detected: it is caught
# when it next rests, and two swings in a row have to show it.
CAUGHT: Final = "caught"
CAUGHT_GRACE: Final = 4
# Swings in a row that a learner calls itself valid, before it is taken at its word.
SETTLED: Final = 20


@dataclass(frozen=True)
class Recovery:
    """What happened after a mark."""

    swings: int | None  # until the leg could be relied on again, None where it could not
    alarms: int  # false ones on the way; all there were where it did not recover
    of: int  # swings that there were
    kind: str | None = None  # what the change was taken for, by the last report; None without one


@dataclass(frozen=True, eq=False)
class Judged:
    """One learner on one leg-run."""

    outcome: LegOutcome  # of all its events
    recovery: dict[str, Recovery]  # by name of the mark
    lock_out: int  # longest run of swings lost, from the first mark on
    confirmed: int  # ticks it took for free
    touched: int  # those of them on which the leg touched something
    touched_before: int  # those of these that began in touch, not with the touch itself
    # swings until it called itself valid and went on to, None where it did not
    until_valid: int | None
    valid_ns: int | None  # when it did
    wavered: bool  # whether it ever called itself anything else
    caught: int  # swings that ended while the foot was held by the stage, but for the first few
    caught_told: int  # those of them after which it called itself ambiguous


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
    caught, shown = _caught(scenario, replayed.log)
    return Judged(
        outcome=outcome,
        recovery=recovery,
        lock_out=longest_lock_out(within(outcome, first_s, np.inf).swings),
        confirmed=replayed.confirmed,
        touched=len(replayed.touched_ns),
        touched_before=_touched_before(stream, replayed),
        until_valid=until,
        valid_ns=valid_ns,
        wavered=bool(np.any(replayed.log.status != _VALID)),
        caught=caught,
        caught_told=shown,
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
    kind = KINDS[kinds[-1]] if len(kinds) else None
    return Recovery(count, int(np.sum(alarms)), len(swings.start_ns), kind)


def _caught(scenario: Scenario, log: SwingLog) -> tuple[int, int]:
    """Swings that ended while the foot was caught, and those after which that was reported."""
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


Tree = dict[str, Any]

LOCK_OUT_SWINGS: Final = 5
# What a change is taken for of which no kind is reported.
NOTHING: Final = "nothing"
_BOOTSTRAPS: Final = 2000


@dataclass(frozen=True, eq=False)
class Judgement:
    """A scenario's leg-runs, judged."""

    scenario: Scenario  # which
    # those that were recorded, in order; the simulation of the others diverged
    leg_runs: tuple[LegRun, ...]
    reference: list[LegOutcome]  # the frozen learner on what each is compared against
    # the full learner on the same, which raises far fewer false alarms
    full_reference: list[LegOutcome]
    variants: dict[Variant, list[Judged]]  # every learner, leg-run by leg-run

    @property
    def recordings(self) -> NDArray[np.intp]:
        """(leg-runs,) number of the recording that each is of, rising from 0."""
        seeds = [run.replay.recording.settings.seed for run in self.leg_runs]
        order = {seed: number for number, seed in enumerate(dict.fromkeys(seeds))}
        return np.array([order[seed] for seed in seeds], dtype=np.intp)


def judge_scenario(scenario: Scenario, folders: Folders) -> Judgement:
    """Judge all leg-runs of a scenario that have replays."""
    done: list[LegRun] = []
    reference: list[LegOutcome] = []
    full_reference: list[LegOutcome] = []
    judged: dict[Variant, list[Judged]] = {variant: [] for variant in scenario.variants}
    for replay, twin in zip(scenario.replays, scenario.references, strict=True):
        own = _read(replay, folders)
        other = own if twin == replay else _read(twin, folders)
        if own is None or other is None:
            continue
        described = simulated_robot(scenario.robot).description
        for leg in replay.recording.legs:
            stream = leg_stream(own[0], leg, described)
            twin_stream = stream if other is own else leg_stream(other[0], leg, described)
            learners = other[1][leg]
            reference.append(match(twin_stream, learners[Variant.FROZEN].events))
            full_reference.append(match(twin_stream, learners[Variant.FULL].events))
            for variant, replayed in own[1][leg].items():
                judged[variant].append(judge(scenario, stream, replayed))
            done.append(LegRun(leg, replay, twin))
    return Judgement(scenario, tuple(done), reference, full_reference, judged)


def figures(judgement: Judgement) -> Tree:
    """All figures of a scenario."""
    scenario = judgement.scenario
    frozen = [judged.outcome for judged in judgement.variants[Variant.FROZEN]]
    from_s = scenario.marks[0].at_s if scenario.marks else 0.0
    until_s = scenario.phases[-1].to_s
    changed = scenario.expect in (Expect.RECOVER, Expect.FOLLOW)
    harmful: bool | None = None
    if changed and judgement.reference:
        harmful = is_harmful(
            [within(o, from_s, until_s) for o in frozen],
            [within(o, from_s, until_s) for o in judgement.reference],
        )
    return {
        "about": scenario.about,
        "motion": scenario.motion,
        "expect": scenario.expect.value,
        "leg_runs": len(judgement.leg_runs),
        "leg_runs_asked": len(scenario.leg_runs),
        "recordings": len(set(judgement.recordings.tolist())),
        "simulated_s": scenario.seconds,
        "counts_as_one_to_recover_from": harmful,
        "marks": {mark.name: mark.at_s for mark in scenario.marks},
        "phases": {p.name: [p.from_s, p.to_s] for p in scenario.phases},
        "judged_phases": list(scenario.judged),
        "reference": _summary(summarise(_judged_part(scenario, judgement.reference))),
        "variants": {
            variant.value: _variant(judgement, judged)
            for variant, judged in judgement.variants.items()
        },
    }


def quantile(values: Iterable[float | None], share: float) -> float | None:
    """The value that at least a share of them do not exceed; None stands for "never"."""
    ordered = sorted(math.inf if value is None else float(value) for value in values)
    if not ordered:
        return None
    found = ordered[max(math.ceil(share * len(ordered)) - 1, 0)]
    return None if math.isinf(found) else found


def _read(spec: ReplaySpec, folders: Folders) -> tuple[Recording, Replayed] | None:
    recording = load(file_of(spec.recording, folders.recordings))
    replayed = load_replay(spec, replay_file(spec, folders.replays))
    return None if recording is None or replayed is None else (recording, replayed)


def _judged_part(scenario: Scenario, outcomes: Sequence[LegOutcome]) -> list[LegOutcome]:
    """The phases over which a scenario is held to something."""
    phases = [scenario.phase(name) for name in scenario.judged]
    return [within(outcome, p.from_s, p.to_s) for p in phases for outcome in outcomes]


def _variant(judgement: Judgement, judged: list[Judged]) -> Tree:
    scenario = judgement.scenario
    outcomes = [one.outcome for one in judged]
    confirmed, touched = sum(j.confirmed for j in judged), sum(j.touched for j in judged)
    lock_outs = [one.lock_out for one in judged]
    tree: Tree = {
        "phases": {
            p.name: _summary(summarise([within(o, p.from_s, p.to_s) for o in outcomes]))
            for p in scenario.phases
        },
        "judged": _summary(summarise(_judged_part(scenario, outcomes))),
        **_lost(scenario, outcomes, judgement.reference, judgement.recordings),
        "harmful": _harmful(
            _judged_part(scenario, outcomes),
            _judged_part(scenario, judgement.reference),
            _judged_part(scenario, judgement.full_reference),
        ),
        "recovery": {mark.name: _recovery_figures(judged, mark.name) for mark in scenario.marks},
        "longest_lock_out": max(lock_outs, default=0),
        f"lock_outs_over_{LOCK_OUT_SWINGS}": sum(n > LOCK_OUT_SWINGS for n in lock_outs),
        "confirmed_ticks": confirmed,
        "touching_ticks_confirmed": touched,
        "touching_since_before": sum(one.touched_before for one in judged),
        "touching_share": touched / confirmed if confirmed else None,
        "ever_doubted": sum(one.wavered for one in judged),
        "caught_swings": sum(one.caught for one in judged),
        "caught_told": sum(one.caught_told for one in judged),
    }
    if scenario.expect is Expect.START:
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
        "swings": swings,
        "alarms": alarms,
        "taken_for": dict(Counter(recovery.kind or NOTHING for recovery in each)),
    }


def _start(judgement: Judgement, judged: list[Judged]) -> Tree:
    """How soon learners called themselves valid, and how good they were from then on."""
    until = [one.until_valid for one in judged]
    end_ns = np.iinfo(np.int64).max
    own, reference, full = [], [], []
    for one, frozen_twin, full_twin in zip(
        judged, judgement.reference, judgement.full_reference, strict=True
    ):
        if one.valid_ns is not None:
            own.append(one.outcome.between(one.valid_ns, end_ns))
            reference.append(frozen_twin.between(one.valid_ns, end_ns))
            full.append(full_twin.between(one.valid_ns, end_ns))
    return {
        "valid": sum(n is not None for n in until),
        "swings_median": quantile(until, 0.5),
        "swings_p95": quantile(until, 0.95),
        "swings": until,
        "when_valid": _summary(summarise(own)),
        "reference": _summary(summarise(reference)),
        "full_reference": _summary(summarise(full)),
        "harmful": _harmful(own, reference, full),
    }


def _harmful(own: list[LegOutcome], *twins: list[LegOutcome]) -> bool:
    """Whether it is much worse than any of what it is compared against."""
    return bool(own) and any(is_harmful(own, twin) for twin in twins)


def _lost(
    scenario: Scenario,
    own: list[LegOutcome],
    reference: list[LegOutcome],
    recordings: NDArray[np.intp],
) -> Tree:
    """Points of recall lost against the reference, with an interval over recordings."""
    counts = np.array(
        [
            [*_found(_judged_part(scenario, [a])), *_found(_judged_part(scenario, [b]))]
            for a, b in zip(own, reference, strict=True)
        ],
        dtype=np.float64,
    ).reshape(-1, 4)
    if not counts[:, 1].sum() or not counts[:, 3].sum():
        return {"recall_lost_points": None, "recall_lost_interval": None}
    # Recordings are what is independent: legs of one share a body, its sway and its battery, and
    # one bad leg must not pass for many bad swings.
    whole = np.zeros((recordings[-1] + 1, counts.shape[1]))
    np.add.at(whole, recordings, counts)
    drawn = np.random.default_rng(0).integers(0, len(whole), (_BOOTSTRAPS, len(whole)))
    samples = _points(whole[drawn].sum(axis=1))
    low, high = np.nanpercentile(samples, (2.5, 97.5))
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


def _summary(summary: Summary) -> Tree:
    counted, late = summary.counted, summary.counted.latency
    hours = summary.per_hour_interval
    return {
        "touches": counted.touches,
        "found": counted.found,
        "recall": counted.recall,
        "recall_interval": list(counted.interval),
        "latency_median_ms": None if late is None else late.median_ms,
        "latency_p95_ms": None if late is None else late.p95_ms,
        "false_alarms": summary.false_alarms,
        "judged_ticks": summary.judged_ticks,
        "robot_hours": summary.robot_hours,
        "per_robot_hour": summary.per_hour,
        "per_robot_hour_interval": [hours.low, hours.high if math.isfinite(hours.high) else None],
        "swings": summary.swings,
        "swings_with_errors": summary.lost_swings,
    }
