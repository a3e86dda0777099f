"""Matches events of one leg to its contacts: touches found and missed, false alarms.

The rules of ``docs/scoring.md``.  In short: an event belongs to the touch that it follows most
closely, so that a window ends where the next touch begins.  The first ``contact: true`` in the
window of a touch detects it.  A later one, while the foot still touches, is a late detection of a
touch that was missed.  What belongs to no touch is a false alarm wherever nothing touches; while
the foot is loaded, it is one in the swing of that touch only.
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
# A gait says "stance" when it plans to touch; for so many ticks the foot may be on its way.
AFTER_TICKS: Final = 16
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
    # The swing that a touch is judged in, -1 for none: where it began, or the one before where it
    # is the first after its turn.
    tick = _tick_of(contacts.onset_ns, t_ns)
    late = _at(swings.after_tick, tick)
    soon = tick - _at(swings.stop, late) < 10
    soon &= _at(_first_after(t_ns, swings, contacts), late) == np.arange(len(tick))
    judged_in = np.maximum(_at(swings.of_tick, tick), np.where(soon, late, -1))
    judged_in[~contacts.touch] = -1
    touches = _touches(contacts, judged_in, tick, swings, lift)

    event_ns, chosen = np.unique(events.t_ns[events.contact], return_index=True)
    event_tick = _tick_of(event_ns, t_ns)
    in_swing, in_stance = _at(swings.of_tick, event_tick), _at(swings.after_tick, event_tick)
    reported_in = np.maximum(in_swing, in_stance)
    # The contact that began last, at each time or before; -1 for none.
    contact = np.searchsorted(contacts.onset_ns, event_ns, side="right") - 1
    held = _holding(event_ns, contacts)
    own = (reported_in >= 0) & (_at(judged_in, contact) == reported_in)
    in_window = event_ns <= _at(contacts.onset_ns + _window_ns(contacts), contact)
    in_window &= _at(contacts.touch.astype(np.int64), contact) == 1
    found = _first_of_each(contact, own & in_window)
    late_found = own & ~in_window & (held == contact)
    late_found &= ~np.isin(contact, contact[found])
    late_found = _first_of_each(contact, late_found)
    touch = _at(np.cumsum(judged_in >= 0) - 1, contact)
    touches.found[touch[found]] = True
    for flags, into, since_ns in (
        (found, touches.latency_ns, event_ns),
        (found, touches.onset_error_ns, events.onset_ns[events.contact][chosen]),
        (late_found, touches.found_late_ns, event_ns),
    ):
        into[touch[flags]] = since_ns[flags] - touches.onset_ns[touch[flags]]
    neutral = (in_swing >= 0) & (held >= 0) & (_at(judged_in, held) != in_swing)
    # In stance, what a loaded foot reports is not judged, nor what belongs to a touch that is not.
    unjudged = (held >= 0) | (in_window & (_at(judged_in, contact) < 0))
    outside = (reported_in < 0) | ((in_swing < 0) & unjudged)
    outside &= ~(found | late_found)
    alarms = np.flatnonzero(~(found | late_found | neutral | outside))

    count = len(swings.start)
    tick_held = _holding(t_ns, contacts)
    free = (swings.of_tick >= 0) & ((tick_held < 0) | (_at(judged_in, tick_held) == swings.of_tick))
    after = (swings.after_tick >= 0) & (tick_held < 0)
    after &= np.arange(len(t_ns)) - _at(swings.stop, swings.after_tick) < AFTER_TICKS
    judged_after = np.bincount(swings.after_tick[after], minlength=count)
    alarm_after = in_swing[alarms] < 0
    counted = touches.counted
    return LegOutcome(
        leg=stream.leg,
        swings=SwingTable(
            start_ns=t_ns[swings.start],
            end_ns=t_ns[swings.stop - 1],
            ticks=swings.stop - swings.start,
            judged=np.bincount(swings.of_tick[free], minlength=count) + judged_after,
            touches=np.bincount(touches.swing[counted], minlength=count),
            hits=np.bincount(touches.swing[touches.found], minlength=count),
            misses=np.bincount(touches.swing[counted & ~touches.found], minlength=count),
            false_alarms=np.bincount(reported_in[alarms], minlength=count),
            neutral=np.bincount(in_swing[neutral], minlength=count),
            judged_after=judged_after,
        ),
        touches=touches,
        alarms_ns=event_ns[alarms],
        alarm_swing=reported_in[alarms],
        alarm_after=alarm_after,
        outside_ns=event_ns[outside],
        unjudged_ns=contacts.onset_ns[contacts.touch & (judged_in < 0)],
        span_ns=(int(t_ns[0]), int(t_ns[-1])) if len(t_ns) else (0, 0),
    )


def _tick_of(when_ns: Ints, t_ns: Ints) -> Ints:
    """Return each time's tick: its last sample so far; -1 before the first or in a hole."""
    tick = np.searchsorted(t_ns, when_ns, side="right") - 1
    if len(t_ns):
        tick[(tick >= 0) & (when_ns - t_ns[tick] > longest_gap(t_ns))] = -1
    return tick


def _at(values: Ints, tick: Ints) -> Ints:
    """Return ``values[tick]``; -1 where the tick is -1."""
    if len(values) == 0:
        return np.full(len(tick), -1)
    return np.where(tick >= 0, values[tick], -1)


def _holding(when_ns: Ints, contacts: Contacts) -> Ints:
    """Return the contact that holds at each time; -1 for none."""
    which = np.searchsorted(contacts.onset_ns, when_ns, side="right") - 1
    return np.where(when_ns < _at(contacts.release_ns, which), which, -1)


def _first_of_each(contact: Ints, chosen: Mask) -> Mask:
    """Return the first chosen event of each contact."""
    first = np.zeros(len(contact), dtype=bool)
    at = np.flatnonzero(chosen)
    first[at[np.unique(contact[at], return_index=True)[1]]] = True
    return first


def _window_ns(contacts: Contacts) -> Ints:
    """Return how long a detection of each touch may take, (c,) ns."""
    slow = contacts.soft | (contacts.speed_m_s <= SLOW_M_S)
    return np.where(slow, LONG_WINDOW_NS, WINDOW_NS)


def _first_after(t_ns: Ints, swings: Swings, contacts: Contacts) -> Ints:
    """Return the first contact, (s,), that holds at the turn of each swing or begins after it."""
    if len(t_ns) == 0:
        return np.zeros(0, np.int64)
    turn_ns = t_ns[np.minimum(swings.stop, len(t_ns) - 1)]
    return np.searchsorted(contacts.release_ns, turn_ns, side="right")


def _touches(
    contacts: Contacts, judged_in: Ints, tick: Ints, swings: Swings, lift: Mask
) -> TouchTable:
    """Make the table of touches to be found, in their rows; none found yet.

    ``judged_in`` (c,) is the swing in which or soon after which each contact began, -1 for none.
    """
    inside = np.flatnonzero(judged_in >= 0)
    at, swing = tick[inside], judged_in[inside]
    speed, soft = contacts.speed_m_s[inside], contacts.soft[inside]
    grazing = contacts.grazing[inside]
    # Samples at or before the onset cannot know of it; ``at`` is the last of those.
    left = swings.stop[swing] - 1 - at
    # A touch with fewer swing samples left than this is late; so is one soon after the turn to
    # stance.
    late = left < 3  # after the turn it is negative
    unknown = np.isnan(speed) & ~soft & ~grazing
    rows: list[tuple[Mask, Row]] = [
        (late & ~unknown, "late"),
        (lift[at] & (left >= 0), "lift"),
        (grazing, "grazing"),
        (soft, "soft"),
        (unknown, "unknown"),
        (speed >= HEADLINE_M_S, "headline"),
        (speed > SLOW_M_S, "mid"),
        (speed >= CREEP_M_S, "slow"),
    ]
    row = np.select(
        [flags for flags, _ in rows],
        [ROWS.index(name) for _, name in rows],
        default=ROWS.index("creep"),
    )
    onset_ns = contacts.onset_ns
    until_next = np.append(np.diff(onset_ns), FOREVER_NS)
    return TouchTable(
        onset_ns=onset_ns[inside],
        swing=swing,
        row=row,
        window_ns=np.minimum(_window_ns(contacts), until_next)[inside],
        found=np.zeros(len(inside), dtype=bool),
        latency_ns=np.full(len(inside), -1),
        onset_error_ns=np.zeros(len(inside), dtype=np.int64),
        speed_m_s=speed,
        force_n=contacts.force_n[inside],
        after_turn=left < 0,
        late=late,
        found_late_ns=np.full(len(inside), -1),
    )
