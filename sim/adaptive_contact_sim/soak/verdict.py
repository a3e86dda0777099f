"""A soak judged: wrong events outside the windows, uncounted losses, memory, recovery.

Every sample is accounted for: between any two statuses of a leg, samples accepted and samples
missed must together be the ticks that the source has gone through, whoever was killed meanwhile.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from adaptive_contact.robot import Robot
from adaptive_contact.score import Gatherer, LegOutcome, match
from adaptive_contact.score.contacts import TruthChanges
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ContactEvent, ServoSample, decode, leg_of_key
from adaptive_contact_sim.soak.conduct import Broken, Resident, Take
from adaptive_contact_sim.soak.plan import RECOVERY_S, SoakPlan
from adaptive_contact_sim.soak.sections import (
    Section,
    judge_sections,
    spans_between,
    windows_of,
)

__all__ = ["Verdict", "judge"]

MEMORY_MB: Final = 5.0
# The design's recall, over the whole walk and after each thing that happened to it.
MISSED_SHARE: Final = 0.01
# One touch in a hundred says nothing about a section of fifty: so many are forgiven in any.
FORGIVEN: Final = 2
# While a drift is under way its cause has not ended; so many errors per touch are honest there.
RAMP_SHARE: Final = 0.05
# What an event takes to get here, on top of what the detector may take.
_TRAVEL_NS: Final = 250_000_000
_NS: Final = 1_000_000_000
_EDGE: Final = 0.2  # of a life, at its begin and at its end, whose medians are compared


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a soak came to.

    Attributes:
        judged_ticks: swing leg-ticks outside the windows and ramps.
        inconsistent: events that no sample bears out, or that came twice.
        false_alarms: ``contact: true`` outside of both while the leg touched nothing.
        alarms: leg and time of each false alarm outside the windows, s of the walk.
        touches, missed_touches: outside of both.
        misses: leg and time of each touch missed outside the windows, s of the walk.
        sections: the same from each window to the next, those of ramps told apart.
        samples: that the source sent, all legs.
        missed_samples: counted as lost.
        uncounted: lost and not counted, or counted and not lost; the worst leg.
        rejects: refused samples by reason, all legs.
        outage_s: from the begin of each fault to the end of its cause.
        recovery_s: from there until every leg's first right event was heard here; infinite where
            one never was.
        late_legs: those for whom that was later than 2 s and than their first whole swing.
        memory_mb: growth of each life of the service after its warm-up, and its last value.
        worker_mb: the same of its child processes.
        refits: promoted, refused, rolled back.
        events, events_lost: heard here; lost by the service because a subscriber hung.
        state: saves and failures, legs restored at the restart.
        p99_ms: arrival of the deciding sample to its event being sent, at the end.
        failures: lines on what is not as it should be.
    """

    minutes: float
    judged_ticks: int
    inconsistent: int
    false_alarms: int
    alarms: list[tuple[str, float]]
    touches: int
    missed_touches: int
    misses: list[tuple[str, float]]
    sections: list[Section]
    samples: int
    missed_samples: int
    uncounted: int
    rejects: dict[str, int]
    outage_s: list[float]
    recovery_s: list[float]
    late_legs: list[list[str]]
    memory_mb: list[tuple[float, float]]
    worker_mb: list[tuple[float, float]]
    refits: dict[str, int]
    events: int
    events_lost: int
    state: dict[str, Any]
    p99_ms: float | None
    failures: list[str]


def judge(take: Take, plan: SoakPlan, robot: Robot) -> Verdict:
    """Judge a run."""
    gathered = Gatherer(robot)
    seq_of: dict[str, dict[int, int]] = {leg: {} for leg in robot.leg_ids}
    for record in read_recording(take.recording):
        gathered.take(record)
        if record.key.endswith("/servo"):
            leg = leg_of_key(record.key)
            sample = decode(record.payload, ServoSample, record.encoding)
            if leg is not None and isinstance(sample, ServoSample):
                seq_of[leg][sample.t_ns] = sample.seq
    gathered.replace_events(event for _, event in take.heard.events)
    epoch_ns = min(min(times) for times in seq_of.values())
    end_ns = max(max(times) for times in seq_of.values()) + 1
    windows = windows_of([dataclasses.astuple(one) for one in take.broken], plan.drifts, epoch_ns)
    streams = {leg: gathered.stream(leg) for leg in gathered.legs}
    outcomes = [match(stream, gathered.events(leg)) for leg, stream in streams.items()]
    sections = judge_sections(outcomes, spans_between(windows, epoch_ns, end_ns))
    settled = [one for one in sections if not one.ramp]
    edges = [(window.begin_ns, window.end_ns) for window in windows]
    right = _right_events(take, outcomes, {leg: one.truth for leg, one in streams.items()})
    back = [_recovery(fault, robot.leg_ids, right, outcomes) for fault in take.broken]

    newest = {status.leg: status for _, status in take.heard.statuses}
    services = [status for _, status in take.heard.services]
    uncounted = max((_uncounted(leg, seq_of[leg], take) for leg in robot.leg_ids), default=0)
    rejects: Counter[str] = Counter()
    refits: Counter[str] = Counter()
    for status in newest.values():
        rejects.update(status.rejects)
        counts = status.refits
        refits.update(
            promoted=counts.promoted, refused=counts.refused, rolled_back=counts.rolled_back
        )
    state = services[-1].state if services else None
    latency = services[-1].event_latency if services else None
    judged = Verdict(
        minutes=plan.minutes,
        judged_ticks=sum(one.ticks for one in settled),
        inconsistent=_inconsistent(take, seq_of) + take.heard.unreadable,
        false_alarms=sum(one.false_alarms for one in settled),
        alarms=[
            (one.leg, round((int(at_ns) - epoch_ns) / _NS, 2))
            for one in outcomes
            for at_ns in one.alarms_ns[_outside(one.alarms_ns, edges)]
        ],
        touches=sum(one.touches for one in settled),
        missed_touches=sum(one.missed for one in settled),
        misses=[
            (one.leg, round((int(at_ns) - epoch_ns) / _NS, 2))
            for one in outcomes
            for at_ns in one.touches.onset_ns[
                _outside(one.touches.onset_ns, edges) & ~one.touches.found
            ]
        ],
        sections=sections,
        samples=sum(map(len, seq_of.values())),
        missed_samples=sum(status.missed for status in newest.values()),
        uncounted=uncounted,
        rejects=dict(rejects),
        outage_s=[(fault.to_ns - fault.from_ns) / _NS for fault in take.broken],
        recovery_s=[recovery_s for recovery_s, _ in back],
        late_legs=[late for _, late in back],
        memory_mb=_memory(take.resident, plan.warm_up_s, lambda one: one.mb),
        worker_mb=_memory(take.resident, plan.warm_up_s, lambda one: one.workers_mb),
        refits=dict(refits),
        events=len(take.heard.events),
        events_lost=sum({s.instance: s.events_lost for s in services}.values()),
        state={}
        if state is None
        else {"saved": state.saved, "failed": state.failed, "restored": state.restored},
        p99_ms=None if latency is None else latency.p99,
        failures=[],
    )
    return dataclasses.replace(judged, failures=_failures(judged, robot, plan))


def _failures(found: Verdict, robot: Robot, plan: SoakPlan) -> list[str]:
    lines = [
        *_detection_failures(found),
        *_memory_failures(found, plan),
        *_state_failures(found, robot),
    ]
    if found.inconsistent:
        lines.append(f"{found.inconsistent} events that no sample bears out, or twice")
    if found.uncounted:
        lines.append(f"{found.uncounted} samples lost without being counted")
    if found.events_lost:
        lines.append(f"{found.events_lost} events lost")
    if len(found.recovery_s) != len(plan.faults):
        lines.append(f"{len(found.recovery_s)} faults came about, of {len(plan.faults)} planned")
    for recovery_s, late in zip(found.recovery_s, found.late_legs, strict=True):
        if late:
            lines.append(f"a fault took {recovery_s:.2f} s to recover from: {' '.join(late)}")
    if not found.refits.get("promoted", 0) + found.refits.get("refused", 0):
        lines.append("no refit came to an end, be it promoted or refused")
    return lines


def _detection_failures(found: Verdict) -> list[str]:
    lines = []
    if not found.touches:
        lines.append("not one touch was judged")
    if found.false_alarms:
        lines.append(f"{found.false_alarms} false alarms outside the windows")
    if found.missed_touches > max(FORGIVEN, MISSED_SHARE * found.touches):
        lines.append(f"{found.missed_touches} of {found.touches} touches missed")
    for one in found.sections:
        share = RAMP_SHARE if one.ramp else MISSED_SHARE
        allowed = max(FORGIVEN, share * one.touches)
        where = "during" if one.ramp else "after"
        if one.missed > allowed:
            lines.append(f"{one.missed} of {one.touches} touches missed {where} {one.after}")
        if one.ramp and one.false_alarms > allowed:
            lines.append(
                f"{one.false_alarms} false alarms to {one.touches} touches during {one.after}"
            )
    return lines


def _memory_failures(found: Verdict, plan: SoakPlan) -> list[str]:
    lines = []
    lives = 1 + sum(fault.kind == "service" for fault in plan.faults)
    if len(found.memory_mb) != lives:
        lines.append(f"memory is known of {len(found.memory_mb)} lives of the service, of {lives}")
    if not found.worker_mb:
        lines.append("memory of the service's child processes is not known")
    for whose, rows in (("the service", found.memory_mb), ("its children", found.worker_mb)):
        for life, (growth_mb, _) in enumerate(rows):
            if not growth_mb <= MEMORY_MB:
                lines.append(f"life {life + 1}: {whose} grew by {growth_mb:.1f} MB")
    return lines


def _state_failures(found: Verdict, robot: Robot) -> list[str]:
    lines = []
    if not found.state.get("saved"):
        lines.append("no state was saved")
    if found.state.get("failed"):
        lines.append(f"{found.state['failed']} states could not be saved")
    if len(found.state.get("restored", [])) != len(robot.leg_ids):
        lines.append("not every leg was restored after the restart")
    return lines


def _outside(times_ns: Any, windows: list[tuple[int, int]]) -> Any:
    keep = np.ones(len(times_ns), dtype=bool)
    for begin, end in windows:
        keep &= (times_ns < begin) | (times_ns > end)
    return keep


def _inconsistent(take: Take, seq_of: dict[str, dict[int, int]]) -> int:
    """Events on samples that were never sent, with an onset in the future, or heard twice."""
    seen: Counter[tuple[str, int, bool]] = Counter()
    wrong = 0
    for _, event in take.heard.events:
        seen[event.leg, event.t_ns, event.contact] += 1
        sent = seq_of.get(event.leg, {}).get(event.t_ns)
        wrong += sent != event.seq or event.onset_ns > event.t_ns
    return wrong + sum(count - 1 for count in seen.values())


def _uncounted(leg: str, seq_of: dict[int, int], take: Take) -> int:
    """The worst difference between ticks gone through and samples accounted for."""
    first: tuple[int, int] | None = None
    worst = 0
    for _, status in take.heard.statuses:
        if status.leg != leg or status.t_ns not in seq_of:
            continue  # nothing heard yet, at the start of a life
        seq, counted = seq_of[status.t_ns], status.ticks + status.missed
        if first is None:
            first = (seq, counted)
        worst = max(worst, abs((seq - first[0]) - (counted - first[1])))
    return worst


def _right_events(
    take: Take, outcomes: Sequence[LegOutcome], truth: Mapping[str, TruthChanges]
) -> dict[str, list[tuple[int, ContactEvent]]]:
    """Per leg the events that are true, with the wall clock of their arrival, in that order.

    A contact is right if it has found a touch, a release if the leg is in the air.
    """
    found_ns = {
        one.leg: set((one.touches.onset_ns + one.touches.latency_ns)[one.touches.found].tolist())
        for one in outcomes
    }
    right: dict[str, list[tuple[int, ContactEvent]]] = {leg: [] for leg in truth}
    for arrived_ns, event in sorted(take.heard.events, key=lambda pair: pair[0]):
        if event.leg not in truth:
            continue
        if event.contact:
            sound = event.t_ns in found_ns.get(event.leg, ())
        else:
            changes = truth[event.leg]
            at = int(np.searchsorted(changes.t_ns, event.t_ns, side="right")) - 1
            # One that only ends what a restart has cut short says nothing about detection.
            sound = event.score > 0.0 and (at < 0 or not changes.contact[at])
        if sound:
            right[event.leg].append((arrived_ns, event))
    return right


def _recovery(
    fault: Broken,
    legs: Sequence[str],
    right: Mapping[str, Sequence[tuple[int, ContactEvent]]],
    outcomes: Sequence[LegOutcome],
) -> tuple[float, list[str]]:
    """Seconds from the end of a fault to the last leg's first right event, and who was late.

    A leg that had nothing to tell for two seconds has until the first touch of a whole swing.
    """
    last_s, late = 0.0, []
    by_leg = {one.leg: one for one in outcomes}
    for leg in legs:
        first_ns = next(
            (
                arrived_ns
                for arrived_ns, event in right.get(leg, ())
                if arrived_ns > fault.to_ns and event.t_ns > fault.to_ns
            ),
            None,
        )
        took_s = float("inf") if first_ns is None else (first_ns - fault.to_ns) / _NS
        last_s = max(last_s, took_s)
        limit_ns = fault.to_ns + int(RECOVERY_S * _NS)
        if leg in by_leg:
            touches, swings = by_leg[leg].touches, by_leg[leg].swings
            whole = swings.start_ns[touches.swing] > fault.to_ns
            latest_ns = (touches.onset_ns + touches.window_ns)[whole]
            if len(latest_ns):
                limit_ns = max(limit_ns, int(latest_ns[0]) + _TRAVEL_NS)
        if first_ns is None or first_ns > limit_ns:
            late.append(leg)
    return last_s, late


def _memory(
    resident: tuple[Resident, ...], warm_up_s: float, of: Callable[[Resident], float]
) -> list[tuple[float, float]]:
    """Growth and last value of each life, MB, from medians, after the warm-up.

    A child process warms up from its own start on, which its first memory tells.
    """
    found = []
    for life in range(max((one.life for one in resident), default=-1) + 1):
        rows = [(one.after_s, of(one)) for one in resident if one.life == life]
        rows = [(after_s, mb) for after_s, mb in rows if mb > 0.0]  # false for NaN, too
        begin_s = rows[0][0] if rows else 0.0
        late = [mb for after_s, mb in rows if after_s - begin_s >= warm_up_s]
        if len(late) >= 5:
            edge = max(2, int(_EDGE * len(late)))
            growth = float(np.median(late[-edge:]) - np.median(late[:edge]))
            found.append((growth, late[-1]))
    return found
