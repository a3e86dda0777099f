"""Holds input and outcome of a score, per leg: tables of touches and swings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Final, Literal, NamedTuple, get_args

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.score.contacts import TruthChanges
from adaptive_contact.wire import ContactEvent

# The table row that a touch belongs to; each touch is in exactly one.
Row = Literal["headline", "mid", "slow", "creep", "soft", "grazing", "lift", "late", "unknown"]


# Codes in the tables are positions in this tuple.
ROWS: Final[tuple[Row, ...]] = get_args(Row)
# Rows whose misses are errors of a swing.  The others are separate because they may be beyond
# any detector: too slow to be felt, along the surface, in the lift.
COUNTED: Final = frozenset({"headline", "mid", "slow", "soft", "unknown", "late"})
_COUNTED_CODES: Final = np.array([row in COUNTED for row in ROWS])


class Events(NamedTuple):
    """Holds one leg's contact events, (e,) each, in any order."""

    t_ns: Ints  # of the deciding sample
    contact: Mask  # the reported state
    onset_ns: Ints  # the estimated first touch

    @classmethod
    def from_messages(cls, messages: Iterable[ContactEvent]) -> Events:
        """Make events from messages, in their order."""
        rows = [(event.t_ns, event.contact, event.onset_ns) for event in messages]
        t_ns, contact, onset_ns = zip(*rows, strict=True) if rows else ((), (), ())
        return cls(
            np.array(t_ns, dtype=np.int64),
            np.array(contact, dtype=np.bool_),
            np.array(onset_ns, dtype=np.int64),
        )


@dataclasses.dataclass(frozen=True, slots=True)
class LegStream:
    """Holds what happened to one leg; every detector's events are scored against the same one."""

    leg: str
    t_ns: Ints  # (n,) strictly increasing sample times
    swing: Mask  # (n,) whether the tick is commanded swing
    truth: TruthChanges  # changes of the true state
    # (n,) which swing ticks are lift; None takes the first half of every swing
    lift: Mask | None = None


class TouchTable(NamedTuple):
    """Holds touches in swings and soon after them, in order of time, (c,) each."""

    onset_ns: Ints  # true onset
    swing: Ints  # which swing it lies in, or follows
    row: Ints  # position in `ROWS`
    window_ns: Ints  # how long a detection may take, at most until the next touch
    found: Mask  # whether it was detected
    latency_ns: Ints  # deciding sample minus onset, -1 where it was not detected
    onset_error_ns: Ints  # estimated minus true onset, 0 where it was not detected
    # speed_m_s, force_n: as the truth gave them
    speed_m_s: Array
    force_n: Array
    after_turn: Mask  # whether the swing had turned to stance before
    late: Mask  # whether it comes after the turn, or in the last samples before
    # deciding sample minus onset of a detection after the window, while the foot still touches; -1
    # where there was none
    found_late_ns: Ints

    @property
    def counted(self) -> Mask:
        """Return whether a miss is an error, (c,); other rows may be beyond any detector."""
        flags: Mask = _COUNTED_CODES[self.row]
        return flags


class SwingTable(NamedTuple):
    """Holds swings in order of time, (s,) each."""

    # start_ns, end_ns: first and last swing sample
    start_ns: Ints
    end_ns: Ints
    ticks: Ints  # swing samples
    judged: Ints  # those of them on which the foot was not still loaded from before, and the next
    judged_after: Ints  # ticks after the turn to stance, up to 16, on which nothing touched
    touches: Ints  # touches of counted rows, those soon after the turn to stance included
    hits: Ints  # touches of any row that were detected
    misses: Ints  # touches of counted rows that were not
    false_alarms: Ints  # `contact: true` in the swing, or after it, that belong to no touch
    neutral: Ints  # `contact: true` while the foot was still loaded from before

    @property
    def errors(self) -> Ints:
        """Count misses and false alarms of each swing, (s,)."""
        return self.misses + self.false_alarms


@dataclasses.dataclass(frozen=True, slots=True)
class LegOutcome:
    """Holds the judged swings and touches of one leg."""

    leg: str
    swings: SwingTable
    touches: TouchTable
    alarms_ns: Ints  # (a,) deciding samples of the false alarms
    alarm_swing: Ints  # (a,) the swings that they lie in or follow
    alarm_after: Mask  # (a,) whether they come after the turn to stance
    outside_ns: Ints  # deciding samples of each `contact: true` that is not judged: in stance
    unjudged_ns: Ints  # onsets of touches that are not judged: in stance
    span_ns: tuple[int, int]  # first and last sample

    def between(self, from_ns: int, to_ns: int) -> LegOutcome:
        """Select the swings that begin in [``from_ns``, ``to_ns``), and what lies in them.

        What lies outside swings is taken by its own time.
        """

        def within(when_ns: Ints) -> Mask:
            return (when_ns >= from_ns) & (when_ns < to_ns)

        keep = within(self.swings.start_ns)
        renumbered = np.cumsum(keep) - 1
        of_touch, of_alarm = keep[self.touches.swing], keep[self.alarm_swing]
        touches = TouchTable._make(column[of_touch] for column in self.touches)
        return dataclasses.replace(
            self,
            swings=SwingTable._make(column[keep] for column in self.swings),
            touches=touches._replace(swing=renumbered[touches.swing]),
            alarms_ns=self.alarms_ns[of_alarm],
            alarm_swing=renumbered[self.alarm_swing[of_alarm]],
            alarm_after=self.alarm_after[of_alarm],
            outside_ns=self.outside_ns[within(self.outside_ns)],
            unjudged_ns=self.unjudged_ns[within(self.unjudged_ns)],
            span_ns=(max(self.span_ns[0], from_ns), min(self.span_ns[1], to_ns)),
        )
