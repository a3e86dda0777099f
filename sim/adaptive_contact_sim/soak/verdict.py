"""A soak judged: wrong events outside the windows, uncounted losses, memory, recovery.

Every sample is accounted for: between any two statuses of a leg, samples accepted and samples
missed must together be the ticks that the source has gone through, whoever was killed meanwhile.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any, Final

import numpy as np

from adaptive_contact.robot import Robot
from adaptive_contact.score import Gatherer, LegOutcome, match
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import LearnerStatus, ServoSample, decode, leg_of_key
from adaptive_contact_sim.soak.conduct import Resident, Take
from adaptive_contact_sim.soak.plan import RECOVERY_S, SoakPlan

__all__ = ["Verdict", "judge"]

MEMORY_MB: Final = 5.0
_NS: Final = 1_000_000_000
_EDGE: Final = 0.2  # of a life, at its begin and at its end, whose medians are compared


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a soak came to.

    Attributes:
        judged_ticks: swing leg-ticks outside the windows.
        inconsistent: events that no sample bears out, or that came twice.
        false_alarms: ``contact: true`` outside the windows while the leg touched nothing.
        alarms: leg and time of each of them, s of the walk.
        touches, missed_touches: outside the windows.
        samples: that the source sent, all legs.
        missed_samples: counted as lost.
        uncounted: lost and not counted, or counted and not lost; the worst leg.
        rejects: refused samples by reason, all legs.
        outage_s: from the begin of each fault to the end of its cause.
        recovery_s: from there to the last leg's first status, heard here, with a newer sample.
        memory_mb: growth of each life of the service after its warm-up, and its last value.
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
    samples: int
    missed_samples: int
    uncounted: int
    rejects: dict[str, int]
    outage_s: list[float]
    recovery_s: list[float]
    memory_mb: list[tuple[float, float]]
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
    windows = _windows(take, plan, epoch_ns)
    outcomes = [match(gathered.stream(leg), gathered.events(leg)) for leg in gathered.legs]

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
        judged_ticks=sum(_judged_ticks(one, windows) for one in outcomes),
        inconsistent=_inconsistent(take, seq_of) + take.heard.unreadable,
        false_alarms=sum(int(_outside(one.alarms_ns, windows).sum()) for one in outcomes),
        alarms=[
            (one.leg, round((int(at_ns) - epoch_ns) / _NS, 2))
            for one in outcomes
            for at_ns in one.alarms_ns[_outside(one.alarms_ns, windows)]
        ],
        touches=sum(int(_outside(one.touches.onset_ns, windows).sum()) for one in outcomes),
        missed_touches=sum(
            int((_outside(one.touches.onset_ns, windows) & ~one.touches.found).sum())
            for one in outcomes
        ),
        samples=sum(map(len, seq_of.values())),
        missed_samples=sum(status.missed for status in newest.values()),
        uncounted=uncounted,
        rejects=dict(rejects),
        outage_s=[(fault.to_ns - fault.from_ns) / _NS for fault in take.broken],
        recovery_s=_recoveries(take, robot),
        memory_mb=_memory(take.resident, plan.warm_up_s),
        refits=dict(refits),
        events=len(take.heard.events),
        events_lost=sum({s.instance: s.events_lost for s in services}.values()),
        state={}
        if state is None
        else {"saved": state.saved, "failed": state.failed, "restored": state.restored},
        p99_ms=None if latency is None else latency.p99,
        failures=[],
    )
    return dataclasses.replace(judged, failures=_failures(judged, robot))


def _failures(found: Verdict, robot: Robot) -> list[str]:
    lines = []
    if found.inconsistent:
        lines.append(f"{found.inconsistent} events that no sample bears out, or twice")
    if found.false_alarms:
        lines.append(f"{found.false_alarms} false alarms outside the windows")
    if found.uncounted:
        lines.append(f"{found.uncounted} samples lost without being counted")
    if found.events_lost:
        lines.append(f"{found.events_lost} events lost")
    for life, (growth_mb, _) in enumerate(found.memory_mb):
        if growth_mb > MEMORY_MB:
            lines.append(f"life {life + 1} of the service grew by {growth_mb:.1f} MB")
    for recovery_s in found.recovery_s:
        if not recovery_s <= RECOVERY_S:
            lines.append(f"a fault took {recovery_s:.2f} s to recover from")
    if len(found.state.get("restored", [])) != len(robot.leg_ids):
        lines.append("not every leg was restored after the restart")
    return lines


def _windows(take: Take, plan: SoakPlan, epoch_ns: int) -> list[tuple[int, int]]:
    """Times in which events may be wrong, by the samples' clock (the simulator's wall clock)."""
    after = int(RECOVERY_S * _NS)
    faults = [(fault.from_ns, fault.to_ns + after) for fault in take.broken]
    drifts = [
        (
            epoch_ns + int(drift.at_s * _NS),
            epoch_ns + int((drift.at_s + drift.duration_s) * _NS) + after,
        )
        for drift in plan.drifts
    ]
    return faults + drifts


def _outside(times_ns: Any, windows: list[tuple[int, int]]) -> Any:
    keep = np.ones(len(times_ns), dtype=bool)
    for begin, end in windows:
        keep &= (times_ns < begin) | (times_ns > end)
    return keep


def _judged_ticks(one: LegOutcome, windows: list[tuple[int, int]]) -> int:
    return int(one.swings.judged[_outside(one.swings.start_ns, windows)].sum())


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


def _recoveries(take: Take, robot: Robot) -> list[float]:
    """Seconds from the end of each fault to the last leg's first status with a newer sample."""
    found = []
    for fault in take.broken:
        back = {
            leg: min(
                (
                    arrived
                    for arrived, status in take.heard.statuses
                    if status.leg == leg and arrived > fault.to_ns and _fresh(status, fault.to_ns)
                ),
                default=None,
            )
            for leg in robot.leg_ids
        }
        late = [arrived for arrived in back.values() if arrived is not None]
        whole = len(late) == len(back)
        found.append((max(late) - fault.to_ns) / _NS if whole else float("inf"))
    return found


def _fresh(status: LearnerStatus, since_ns: int) -> bool:
    return status.status != "silent" and status.t_ns > since_ns - _NS


def _memory(resident: tuple[Resident, ...], warm_up_s: float) -> list[tuple[float, float]]:
    """Growth and last value of each life, MB, from medians, after the warm-up."""
    found = []
    for life in range(max((one.life for one in resident), default=-1) + 1):
        rows = [one.mb for one in resident if one.life == life and one.after_s >= warm_up_s]
        rows = [mb for mb in rows if mb == mb]
        if len(rows) >= 5:
            edge = max(2, int(_EDGE * len(rows)))
            growth = float(np.median(rows[-edge:]) - np.median(rows[:edge]))
            found.append((growth, rows[-1]))
    return found
