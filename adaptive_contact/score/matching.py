"""Events of one leg against its contacts: touches found and missed, false alarms.

The rules of ``docs/scoring.md``.  In short: swings are judged, and up to 16 ticks after their turn
to stance while the foot has not touched; a detection is the first unmatched ``contact: true``
within the window of a touch; events while the foot is still loaded after a stance are neither;
every other one is a false alarm.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from adaptive_contact.arrays import Ints, Mask
from adaptive_contact.score.contacts import (
    FOREVER_NS,
    Contacts,
    Swings,
    contacts_of,
    find_swings,
    lift_by_halves,
    longest_gap,
)
from adaptive_contact.score.outcome import (
    ROWS,
    Events,
    LegOutcome,
    LegStream,
    Row,
    SwingTable,
    TouchTable,
)

# After a touch on hard ground at speed, and after a slow approach or on soft ground.
WINDOW_NS: Final = 120_000_000
LONG_WINDOW_NS: Final = 500_000_000
# A touch with fewer swing samples left than this is late; so is one soon after the turn to stance.
LATE_SAMPLES: Final = 3
LATE_TICKS: Final = 10
# Speed at touch, m/s.
HEADLINE_M_S: Final = 0.2
SLOW_M_S: Final = 0.1
CREEP_M_S: Final = 0.02


def match(stream: LegStream, events: Events) -> LegOutcome:
    """Judge the events of one leg.

    Args:
        stream: samples and truth.
        events: of one detector; repeats of a ``contact: true`` at one sample count once.
    """
    t_ns = stream.t_ns
    swings = find_swings(t_ns, stream.swing)
    lift = lift_by_halves(swings) if stream.lift is None else stream.lift
    contacts = contacts_of(stream.truth, int(t_ns[0]) if len(t_ns) else 0)
    # The swing a contact began in, -1 where it was loaded already, or began in stance.
    tick = _tick_of(contacts.onset_ns, t_ns)
    contact_swing = np.where(contacts.touch, _at(swings.of_tick, tick), -1)
    first = _first_after(t_ns, swings, contacts)
    # The swing after which it began, where its foot had not touched before.
    late = _at(swings.after_tick, tick)
    soon = tick - _at(swings.stop, late) < LATE_TICKS
    late[~(contacts.touch & soon & (_at(first, late) == np.arange(len(tick))))] = -1
    touches = _touches(contacts, np.maximum(contact_swing, late), tick, swings, lift)

    event_ns, chosen = np.unique(events.t_ns[events.contact], return_index=True)
    estimate_ns = events.onset_ns[events.contact][chosen]
    event_tick = _tick_of(event_ns, t_ns)
    event_swing, event_after = _at(swings.of_tick, event_tick), _at(swings.after_tick, event_tick)
    loaded = (event_swing >= 0) & _loaded(event_ns, event_swing, contacts, contact_swing)
    told_of = np.maximum(event_swing, event_after)
    free = np.flatnonzero((told_of >= 0) & ~loaded)
    touches, taken = _assign(touches, event_ns[free], told_of[free], estimate_ns[free])
    left = np.zeros(len(event_ns), dtype=bool)
    left[free[~taken]] = True
    alarms = np.flatnonzero(left & (event_swing >= 0))
    # Once the foot has touched, nothing is judged until the next swing.
    closed_ns = np.append(contacts.onset_ns, FOREVER_NS)[first]
    open_still = event_ns < _at(closed_ns, event_after)
    after = np.flatnonzero(left & open_still)
    outside = (told_of < 0) | (left & (event_after >= 0) & ~open_still)

    count = len(swings.start)
    in_swing = swings.of_tick >= 0
    tick_swing = swings.of_tick[in_swing]
    tick_loaded = _loaded(t_ns[in_swing], tick_swing, contacts, contact_swing)
    follows = np.flatnonzero(swings.after_tick >= 0)
    follows = follows[t_ns[follows] < closed_ns[swings.after_tick[follows]]]
    counted = touches.counted
    return LegOutcome(
        leg=stream.leg,
        swings=SwingTable(
            start_ns=t_ns[swings.start],
            end_ns=t_ns[swings.stop - 1],
            ticks=swings.stop - swings.start,
            judged=np.bincount(tick_swing[~tick_loaded], minlength=count),
            touches=np.bincount(touches.swing[counted], minlength=count),
            hits=np.bincount(touches.swing[touches.found], minlength=count),
            misses=np.bincount(touches.swing[counted & ~touches.found], minlength=count),
            false_alarms=np.bincount(event_swing[alarms], minlength=count),
            neutral=np.bincount(event_swing[loaded], minlength=count),
            judged_after=np.bincount(swings.after_tick[follows], minlength=count),
            alarms_after=np.bincount(event_after[after], minlength=count),
        ),
        touches=touches,
        alarms_ns=event_ns[alarms],
        alarm_swing=event_swing[alarms],
        after_ns=event_ns[after],
        after_swing=event_after[after],
        outside_ns=event_ns[outside],
        unjudged_ns=contacts.onset_ns[contacts.touch & (contact_swing < 0) & (late < 0)],
        span_ns=(int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, 0),
    )


def _tick_of(when_ns: Ints, t_ns: Ints) -> Ints:
    """The tick each time lies in: its last sample so far, -1 before the first or in a hole."""
    tick = np.searchsorted(t_ns, when_ns, side="right") - 1
    if len(t_ns):
        tick[(tick >= 0) & (when_ns - t_ns[tick] > longest_gap(t_ns))] = -1
    return tick


def _at(values: Ints, tick: Ints) -> Ints:
    """``values[tick]``, -1 where the tick is."""
    if len(values) == 0:
        return np.full(len(tick), -1)
    return np.where(tick >= 0, values[tick], -1)


def _loaded(when_ns: Ints, swing: Ints, contacts: Contacts, contact_swing: Ints) -> Mask:
    """Whether, at times inside the given swings, a contact held that did not begin in them."""
    if len(contacts.onset_ns) == 0:
        return np.zeros(len(when_ns), dtype=bool)
    which = np.searchsorted(contacts.onset_ns, when_ns, side="right") - 1
    loaded: Mask = (which >= 0) & (when_ns < contacts.release_ns[which])
    loaded &= contact_swing[which] != swing
    return loaded


def _first_after(t_ns: Ints, swings: Swings, contacts: Contacts) -> Ints:
    """(s,) the first contact that holds at the turn of each swing, or begins after it."""
    if len(t_ns) == 0:
        return np.zeros(0, np.int64)
    turn_ns = t_ns[np.minimum(swings.stop, len(t_ns) - 1)]
    return np.searchsorted(contacts.release_ns, turn_ns, side="right")


def _touches(
    contacts: Contacts, touched: Ints, tick: Ints, swings: Swings, lift: Mask
) -> TouchTable:
    """The touches to be found, in their rows; none found yet.

    ``touched`` (c,) is the swing in which or soon after which each contact began, -1 for none.
    """
    inside = np.flatnonzero(touched >= 0)
    at, swing = tick[inside], touched[inside]
    speed, soft = contacts.speed_m_s[inside], contacts.soft[inside]
    # Samples at or before the onset cannot know of it; ``at`` is the last of those.
    left = swings.stop[swing] - 1 - at
    rows: list[tuple[Mask, Row]] = [
        (left < LATE_SAMPLES, Row.LATE),  # after the turn it is negative
        (lift[at], Row.LIFT),
        (contacts.grazing[inside], Row.GRAZING),
        (soft, Row.SOFT),
        (np.isnan(speed), Row.UNKNOWN),
        (speed >= HEADLINE_M_S, Row.HEADLINE),
        (speed > SLOW_M_S, Row.MID),
        (speed >= CREEP_M_S, Row.SLOW),
    ]
    row = np.select(
        [flags for flags, _ in rows],
        [ROWS.index(name) for _, name in rows],
        default=ROWS.index(Row.CREEP),
    )
    slow = soft | (speed <= SLOW_M_S)
    return TouchTable(
        onset_ns=contacts.onset_ns[inside],
        swing=swing,
        row=row,
        window_ns=np.where(slow, LONG_WINDOW_NS, WINDOW_NS),
        found=np.zeros(len(inside), dtype=bool),
        latency_ns=np.full(len(inside), -1),
        onset_error_ns=np.zeros(len(inside), dtype=np.int64),
        speed_m_s=speed,
        force_n=contacts.force_n[inside],
        after_turn=left < 0,
    )


def _assign(
    touches: TouchTable, event_ns: Ints, event_swing: Ints, estimate_ns: Ints
) -> tuple[TouchTable, Mask]:
    """Give each touch, in order, the first event in its window and swing that no other has."""
    found, latency = touches.found.copy(), touches.latency_ns.copy()
    error = touches.onset_error_ns.copy()
    taken = np.zeros(len(event_ns), dtype=bool)
    first = np.searchsorted(event_ns, touches.onset_ns, side="right")
    last = np.searchsorted(event_ns, touches.onset_ns + touches.window_ns, side="right")
    for touch in np.flatnonzero(first < last):
        for event in range(first[touch], last[touch]):
            if not taken[event] and event_swing[event] == touches.swing[touch]:
                taken[event] = found[touch] = True
                latency[touch] = event_ns[event] - touches.onset_ns[touch]
                error[touch] = estimate_ns[event] - touches.onset_ns[touch]
                break
    return touches._replace(found=found, latency_ns=latency, onset_error_ns=error), taken
