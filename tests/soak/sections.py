"""A soak cut into sections: what was shaken when, and what came of the time after it.

Events may be wrong for two seconds after the end of a fault's cause and after the begin of a drift;
those are the windows.  What lies between two windows is a section, judged by itself, so that a leg
that stays blind after one of them cannot hide among thousands of touches.  While a drift is still
under way (a ramp), the cause has not ended: such a section is told apart and may err a little.

A leg that is said to be free must not stand loaded: a gait controller that believes a wrong release
lifts the wrong foot.  A release may come late without being wrong: a leg in stance is let go of at
its next lift-off, and only once it has been calm for some ticks.  So what is held against the truth
is what it says of the present.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.score import Events, LegOutcome, LegStream, contacts_of
from adaptive_contact.wire import NS_PER_S

from .conduct import RECOVERY_S, Drifting

_AFTER_NS: Final = int(RECOVERY_S * NS_PER_S)
_NONE: Final = np.zeros(0, dtype=bool)
# A foot that comes off so soon after the word was just leaving: the calm ticks that decide may
# be those in which its load goes, and truth is told by the last tenth of a newton.
_HOLDS_NS: Final = 250_000_000


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
        false_alarms: of all legs.
        releases, wrong_releases: told, and told of a leg that stood loaded.
    """

    after: str
    ramp: bool
    ticks: int
    touches: int
    missed: int
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
        begin_ns = epoch_ns + int(drift.at_s * NS_PER_S)
        ramp_ns = begin_ns + int(drift.duration_s * NS_PER_S)
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


def summed(sections: Sequence[Section]) -> Section:
    """Some sections as one."""
    counts = [field.name for field in dataclasses.fields(Section)[2:]]
    sums = {name: sum(getattr(one, name) for one in sections) for name in counts}
    return Section(after="all", ramp=False, **sums)


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
                false_alarms=sum(int(np.sum(inside(o.alarms_ns))) for o in outcomes),
                releases=sum(int(np.sum(inside(one.t_ns))) for one in releases),
                wrong_releases=sum(int(np.sum(inside(one.t_ns[one.wrong]))) for one in releases),
            )
        )
    return found


class Releases(NamedTuple):
    """One leg's releases.

    Attributes:
        leg: its id.
        t_ns: (r,) of the deciding samples.
        wrong: (r,) whether the leg touched all along, and went on for more than 0.25 s.
    """

    leg: str
    t_ns: NDArray[np.int64]
    wrong: NDArray[np.bool_]


def judge_releases(stream: LegStream, events: Events) -> Releases:
    """Hold the releases of a leg against the truth.

    A leg that was free at the release's onset and touches again at its deciding sample was truly
    released; the touch is another matter, and is found or missed.

    Args:
        stream: samples and truth.
        events: of the leg; those that tell a contact are passed over.
    """
    t_ns = events.t_ns[~events.contact]
    onset_ns = np.minimum(events.onset_ns[~events.contact], t_ns)
    contacts = contacts_of(stream.truth, int(stream.t_ns[0]) if len(stream.t_ns) else 0)
    if len(contacts.onset_ns) == 0:
        return Releases(stream.leg, t_ns, np.zeros(len(t_ns), dtype=bool))
    which = np.searchsorted(contacts.onset_ns, onset_ns, side="right") - 1
    # A contact that holds when the stream ends is not known to have held on.
    ends_ns = np.minimum(contacts.release_ns, stream.t_ns[-1])
    wrong = (which >= 0) & (ends_ns[which] > t_ns + _HOLDS_NS)
    return Releases(stream.leg, t_ns, wrong)
