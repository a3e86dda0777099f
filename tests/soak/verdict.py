"""A soak judged: wrong events outside the windows, uncounted losses, memory, recovery.

Every sample is accounted for: between any two statuses of a leg, samples accepted and samples
missed must together be the ticks that the source has gone through, whoever was killed meanwhile.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, Gatherer, match
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import NS_PER_S, ServoSample, decode, leg_of_key

from .accounts import (
    forgotten_s,
    inconsistent,
    last_words,
    state_of,
    uncounted,
)
from .arrival import SourceClock, judge_arrivals
from .conduct import SoakPlan, Take
from .memory import grown
from .recovery import recovery_of, right_events
from .sections import (
    judge_releases,
    judge_sections,
    spans_between,
    summed,
    windows_of,
)

MEMORY_MB: Final = 5.0
# The same over half an hour, as a slope: what goes on like that is a leak.
SLOPE_MB_MIN: Final = MEMORY_MB / 30.0
# So long a walk with its drifts teaches something: at least one refit is promoted.
TEACHES_MINUTES: Final = 10.0
# A machine with other work lets a process wait for longer than an event may take, now and then.
LATE_SHARE: Final = 0.001
# A service saves each leg every 10 s, a little later where samples or the disk are in the way; what
# it learned since then a crash may cost.
FORGETS_S: Final = 12.0
# The design's recall, over the whole walk and after each thing that happened to it.
MISSED_SHARE: Final = 0.01
# One touch in a hundred says nothing about a section of fifty: so many are forgiven in any.
FORGIVEN: Final = 2
# While a drift is under way its cause has not ended; so many errors per touch are honest there.
RAMP_SHARE: Final = 0.05


def heard_of(events: Events, first_ns: int) -> Events:
    """A leg's events without the release that a service owes it with its first sample.

    That one takes back what another service may have said; the leg stands, as likely as not.
    """
    own = events.t_ns > first_ns
    return Events._make(column[own] for column in events)


def judge(take: Take, plan: SoakPlan, robot: Robot) -> tuple[dict[str, Any], list[str]]:
    """Judge a run.

    Returns:
        What it came to, as `soak.json` has it, and a line on each thing that is not well.
    """
    gathered = Gatherer(robot)
    seq_of: dict[str, dict[int, int]] = {leg: {} for leg in robot.leg_ids}
    for record in read_recording(take.recording):
        gathered.add_message(record)
        if record.key.endswith("/servo"):
            leg = leg_of_key(record.key)
            sample = decode(record.payload, ServoSample, record.encoding)
            if leg is not None and isinstance(sample, ServoSample):
                seq_of[leg][sample.t_ns] = sample.seq
    gathered.replace_events(event for _, event in take.heard.events)
    epoch_ns = min(min(times) for times in seq_of.values())
    end_ns = max(max(times) for times in seq_of.values()) + 1
    clock = SourceClock(take.heard.lags_ns)
    faults = [
        (one.kind, clock.of_wall(one.from_ns), clock.of_wall(one.to_ns)) for one in take.broken
    ]
    windows = windows_of(faults, plan.drifts, epoch_ns)
    streams = {leg: gathered.stream(leg) for leg in gathered.legs}
    outcomes = [match(stream, gathered.events(leg)) for leg, stream in streams.items()]
    releases = [
        judge_releases(stream, heard_of(gathered.events(leg), min(seq_of[leg])))
        for leg, stream in streams.items()
    ]
    sections = judge_sections(outcomes, releases, spans_between(windows, epoch_ns, end_ns))
    errors = [("false alarm", one.leg, one.alarms_ns) for one in outcomes]
    errors += [
        ("missed", one.leg, one.touches.onset_ns[one.touches.counted & ~one.touches.found])
        for one in outcomes
    ]
    errors += [("wrong release", one.leg, one.t_ns[one.wrong]) for one in releases]
    right = right_events(take, outcomes, {leg: one.truth for leg, one in streams.items()})
    back = [recovery_of(fault, right, outcomes, clock) for fault in take.broken]
    shaken = [(one.begin_ns, one.end_ns) for one in windows_of(faults, (), epoch_ns)]

    newest = {status.leg: status for _, status in take.heard.statuses}
    services = last_words([status for _, status in take.heard.services])
    latency = services[-1].event_latency if services else None
    kills = [fault for fault in take.broken if fault.kind == "service"]
    found: dict[str, Any] = {
        "minutes": plan.minutes,
        # Events that no sample bears out, or that came twice.
        "inconsistent": inconsistent(take, seq_of) + len(take.heard.unreadable),
        "settled": summed([one for one in sections if not one.ramp]),
        "errors": [
            (what, leg, round((int(at_ns) - epoch_ns) / NS_PER_S, 2))
            for what, leg, times_ns in errors
            for at_ns in times_ns
            if not any(window.begin_ns <= at_ns <= window.end_ns for window in windows)
        ],
        "arrivals": judge_arrivals(
            ((at_ns, event.t_ns) for at_ns, event in take.heard.events), clock, shaken
        ),
        "source_behind_s": clock.behind_s,
        "sections": sections,
        "samples": sum(map(len, seq_of.values())),
        "missed_samples": sum(status.missed for status in newest.values()),
        # Lost and not counted, or counted and not lost; the worst leg.
        "uncounted": max(uncounted(leg, seq_of[leg], take) for leg in robot.leg_ids),
        "rejects": sum((Counter(status.rejects) for status in newest.values()), Counter[str]()),
        "outage_s": [(fault.to_ns - fault.from_ns) / NS_PER_S for fault in take.broken],
        # Until every leg's first right event was heard here, and who was late.
        "recovery": back,
        "memory": grown(take.resident, plan.warm_up_s),
        "resident": take.resident,
        "left_behind": take.left_behind,
        # What a kill of the service cost, of the worst leg.
        "forgotten_s": [
            max(forgotten_s(leg, seq_of[leg], take, fault, robot) for leg in robot.leg_ids)
            for fault in kills
        ],
        "refits": {
            name: sum(getattr(status.refits, name) for status in newest.values())
            for name in ("promoted", "refused", "rolled_back")
        },
        "events": len(take.heard.events),
        "events_lost": sum(one.events_lost for one in services),
        "state": state_of(services),
        "p99_ms": None if latency is None else latency.p99,
    }
    return found, failures_of(found, robot, plan)


def failures_of(found: dict[str, Any], robot: Robot, plan: SoakPlan) -> list[str]:
    """A line on each thing that is not as it should be."""
    promoted, refused = (found["refits"][name] for name in ("promoted", "refused"))
    memory = found["memory"]
    lives = 1 + sum(fault.kind == "service" for fault in plan.faults)
    settled, arrivals, state = found["settled"], found["arrivals"], found["state"]
    wrong = [
        (not settled.touches, "not one touch was judged"),
        (settled.false_alarms, f"{settled.false_alarms} false alarms outside the windows"),
        (
            settled.wrong_releases,
            f"{settled.wrong_releases} releases of loaded legs outside the windows",
        ),
        (
            settled.missed > max(FORGIVEN, MISSED_SHARE * settled.touches),
            f"{settled.missed} of {settled.touches} touches missed",
        ),
        (
            len(memory) != lives,
            f"memory is known of {len(memory)} lives of the service, of {lives}",
        ),
        (
            found["left_behind"],
            f"{found['left_behind']} child processes outlived the service that was killed",
        ),
        (not state.get("saved"), "no state was saved"),
        (state.get("failed"), f"{state.get('failed')} states could not be saved"),
        (
            len(state.get("restored", [])) != len(robot.leg_ids),
            "not every leg was restored after the restart",
        ),
        (
            found["inconsistent"],
            f"{found['inconsistent']} events that no sample bears out, or twice",
        ),
        (found["uncounted"], f"{found['uncounted']} samples lost without being counted"),
        (found["events_lost"], f"{found['events_lost']} events lost"),
        (not arrivals["events"], "not one event was timed"),
        (
            arrivals["late"] > max(FORGIVEN, LATE_SHARE * arrivals["events"]),
            f"{arrivals['late']} of {arrivals['events']} events came more than 0.25 s late",
        ),
        (
            len(found["recovery"]) != len(plan.faults),
            f"{len(found['recovery'])} faults came about, of {len(plan.faults)} planned",
        ),
        (not promoted + refused, "no refit came to an end, be it promoted or refused"),
        (
            refused and not promoted and plan.minutes >= TEACHES_MINUTES,
            f"no refit was promoted in {plan.minutes:g} minutes",
        ),
        *((True, f"a state was refused: {line}") for line in state.get("refused", [])),
        *(
            (
                lost_s > FORGETS_S,
                f"a kill of the service cost {lost_s:.1f} s of what it had learned",
            )
            for lost_s in found["forgotten_s"]
        ),
        *(
            (late, f"a fault took {recovery_s:.2f} s to recover from: {' '.join(late)}")
            for recovery_s, late in found["recovery"]
        ),
    ]
    for one in found["sections"]:
        allowed = max(FORGIVEN, (RAMP_SHARE if one.ramp else MISSED_SHARE) * one.touches)
        where = f"{one.touches} touches {'during' if one.ramp else 'after'} {one.after}"
        wrong += [
            (one.missed > allowed, f"{one.missed} missed of {where}"),
            (
                one.ramp and one.false_alarms > allowed,
                f"{one.false_alarms} false alarms to {where}",
            ),
            (
                one.ramp and one.wrong_releases > allowed,
                f"{one.wrong_releases} releases of loaded legs to {where}",
            ),
        ]
    for life, one in enumerate(memory, start=1):
        slope = one.slope_mb_min
        wrong += [
            # Also where it is no number.
            (not one.growth_mb <= MEMORY_MB, f"life {life}: it grew by {one.growth_mb:.1f} MB"),
            (
                slope is not None and not slope <= SLOPE_MB_MIN,
                f"life {life}: it still grew by {slope} MB/min at the end",
            ),
        ]
    return [line for fails, line in wrong if fails]
