"""A soak cut into sections: what was shaken when, and what came of the time after it.

Events may be wrong for two seconds after the end of a fault's cause and after the begin of a drift;
those are the windows.  What lies between two windows is a section, judged by itself, so that a leg
that stays blind after one of them cannot hide among thousands of touches.  While a drift is still
under way (a ramp), the cause has not ended: such a section is told apart and may err a little.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.score import LegOutcome

from .plan import RECOVERY_S, Drifting
from .releases import Releases

__all__ = ["Section", "Span", "Window", "judge_sections", "spans_between", "windows_of"]

_NS: Final = 1_000_000_000
_AFTER_NS: Final = int(RECOVERY_S * _NS)
_NONE: Final = np.zeros(0, dtype=bool)


class Window(NamedTuple):
    """When events may be wrong, ns of the samples' clock, and why.

    ``ramp_ns`` is when what began in it has reached its end, its begin where it is a step.
    """

    begin_ns: int
    end_ns: int
    why: str
    ramp_ns: int


class Span(NamedTuple):
    """Time between two windows, [begin, end)."""

    begin_ns: int
    end_ns: int
    after: str
    ramp: bool


@dataclasses.dataclass(frozen=True)
class Section:
    """A span, judged.

    Attributes:
        after: what was shaken before it.
        ramp: a drift is under way in it.
        ticks: swing leg-ticks judged.
        touches, missed: of all legs, and of rows that count (docs/scoring.md).
        others, others_missed: of the rows that do not.
        false_alarms: of all legs.
        releases, wrong_releases: told, and told of a leg that stood loaded.
    """

    after: str
    ramp: bool
    ticks: int
    touches: int
    missed: int
    others: int
    others_missed: int
    false_alarms: int
    releases: int
    wrong_releases: int


def windows_of(
    faults: Sequence[tuple[str, int, int]], drifts: Sequence[Drifting], epoch_ns: int
) -> list[Window]:
    """The windows, in order of time.

    Args:
        faults: what was killed, from when to when, ns.
        drifts: of the plan.
        epoch_ns: when the walk began.
    """
    found = [
        Window(from_ns, to_ns + _AFTER_NS, f"{kind} restarted", from_ns)
        for kind, from_ns, to_ns in faults
    ]
    for drift in drifts:
        begin_ns = epoch_ns + int(drift.at_s * _NS)
        ramp_ns = begin_ns + int(drift.duration_s * _NS)
        found.append(Window(begin_ns, begin_ns + _AFTER_NS, drift.option, ramp_ns))
    return sorted(found)


def spans_between(windows: Sequence[Window], epoch_ns: int, end_ns: int) -> list[Span]:
    """What lies outside the windows, from the begin of the walk to its end."""
    found = []
    begin_ns, after, ramp_ns = epoch_ns, "begin", epoch_ns
    last = Window(end_ns, end_ns, "end", end_ns)
    for window in (*windows, last):
        # A ramp's own errors may come two seconds after its end.
        settled_ns = ramp_ns + _AFTER_NS if ramp_ns > epoch_ns else begin_ns
        middle_ns = min(max(begin_ns, settled_ns), window.begin_ns)
        if middle_ns > begin_ns:
            found.append(Span(begin_ns, middle_ns, after, ramp=True))
        if window.begin_ns > middle_ns:
            found.append(Span(max(begin_ns, middle_ns), window.begin_ns, after, ramp=False))
        begin_ns, after = max(begin_ns, window.end_ns), window.why
        ramp_ns = max(ramp_ns, window.ramp_ns)
    return found


def judge_sections(
    outcomes: Sequence[LegOutcome], releases: Sequence[Releases], spans: Sequence[Span]
) -> list[Section]:
    """Count what happened in each span."""
    found = []
    for span in spans:

        def inside(times_ns: Any, span: Span = span) -> Any:
            return (times_ns >= span.begin_ns) & (times_ns < span.end_ns)

        here = [(o.touches, inside(o.touches.onset_ns)) for o in outcomes]
        counted = np.concatenate([_NONE, *(touches.counted[within] for touches, within in here)])
        hit = np.concatenate([_NONE, *(touches.found[within] for touches, within in here)])
        found.append(
            Section(
                after=span.after,
                ramp=span.ramp,
                ticks=sum(int(o.swings.judged[inside(o.swings.start_ns)].sum()) for o in outcomes),
                touches=int(np.sum(counted)),
                missed=int(np.sum(counted & ~hit)),
                others=int(np.sum(~counted)),
                others_missed=int(np.sum(~counted & ~hit)),
                false_alarms=sum(int(np.sum(inside(o.alarms_ns))) for o in outcomes),
                releases=sum(int(np.sum(inside(one.t_ns))) for one in releases),
                wrong_releases=sum(int(np.sum(inside(one.t_ns[one.wrong]))) for one in releases),
            )
        )
    return found
