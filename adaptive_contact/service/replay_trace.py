"""What a replay decided and why: per leg the test ratio of every tick, events, and truth.

The test ratio of a tick is the statistic over its threshold, the largest of its windows; above 1 is
a contact.  A touch that was missed is judged by the largest ratio while it could have been found:
0.6 is 40 % below the threshold.
"""

from __future__ import annotations

import dataclasses
from array import array
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.bank import LearnerBank
from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import Robot
from adaptive_contact.score import ROWS, Contacts, Gatherer, LegOutcome, contacts_of, match
from adaptive_contact.service.recording import Record
from adaptive_contact.wire import ContactEvent, ServoSample

_NS_PER_S: Final = 1_000_000_000

Floats = NDArray[np.float64]
Spans = list[tuple[float, float]]


@dataclasses.dataclass(frozen=True, slots=True)
class Touch:
    """A touch that the truth has, or a contact that is reported without one.

    Attributes:
        at_s: its onset, or the deciding sample of a false one.
        kind: ``hit``, ``miss``, ``beyond`` (missed, but of a row that may be beyond any detector)
            or ``false``.
        why: one line for a person.
    """

    at_s: float
    kind: str
    why: str


@dataclasses.dataclass(frozen=True, slots=True)
class LegTrace:
    """One leg over a recording, times in s since its first sample.

    Attributes:
        t_s: (n,) of its samples.
        ratio: (n,) test ratio, NaN where the tick could not be judged.
        stance: spans of commanded stance.
        contact: spans of reported contact.
        truth: spans of true contact; None where the recording has no truth.
        touches: what is to be looked at, in order of time.
        note: why touches were not judged, where they were not.
    """

    leg: str
    t_s: Floats
    ratio: Floats
    stance: Spans
    contact: Spans
    truth: Spans | None
    touches: tuple[Touch, ...]
    note: str | None = None


class TraceBank:
    """Learners whose test ratio is kept for each tick; a drop-in for the bank of a replay.

    Args:
        bank: the learners; they are advanced.
    """

    def __init__(self, bank: LearnerBank) -> None:
        self._bank = bank
        self._t_ns: dict[str, array[int]] = {}
        self._ratio: dict[str, array[float]] = {}
        self._events: list[ContactEvent] = []

    def learner(self, leg: str, joints: int | None = None, /) -> object | None:
        """As of the bank."""
        return self._bank.learner(leg, joints)

    def update(self, samples: Mapping[str, ServoSample], /) -> list[ContactEvent]:
        """As of the bank."""
        before = {leg: self._judged_ns(leg) for leg in samples}
        events = self._bank.judge(samples)
        for leg, sample in samples.items():
            learner = self._bank.learner(leg)
            if learner is None:
                continue
            judged = learner.judged() if self._judged_ns(leg) != before[leg] else None
            ratio = np.nan
            if judged is not None and np.any(np.isfinite(judged.scores)):
                ratio = float(np.nanmax(judged.scores))
            self._t_ns.setdefault(leg, array("q")).append(sample.t_ns)
            self._ratio.setdefault(leg, array("d")).append(ratio)
        self._bank.finish()
        self._events += events
        return events

    def _judged_ns(self, leg: str) -> int:
        """Time of the leg's newest accepted sample."""
        learner = self._bank.learner(leg)
        return -1 if learner is None else int(learner.place.leg["t_ns"])

    def traces(self, recorded: TracedRecords) -> list[LegTrace]:
        """Put together what was decided with what the recording says.

        Args:
            recorded: the same replay's records, gone through.
        """
        gathered = recorded.gathered
        gathered.replace_events(self._events)
        legs = [leg for leg in gathered.legs if leg in self._t_ns]
        start_ns = min((self._t_ns[leg][0] for leg in legs), default=0)
        return [self._trace(leg, gathered, start_ns) for leg in legs]

    def _trace(self, leg: str, gathered: Gatherer, start_ns: int) -> LegTrace:
        t_ns = np.array(self._t_ns[leg], dtype=np.int64)
        ratio = np.array(self._ratio[leg], dtype=np.float64)
        events = [event for event in self._events if event.leg == leg]
        end_ns = int(t_ns.max(initial=start_ns))
        told = _spans([(event.t_ns, event.contact) for event in events], start_ns, end_ns)
        stance: Spans = []
        truth: Spans | None = None
        touches: list[Touch] = []
        note = None
        try:
            stream = gathered.stream(leg)
        except (ConfigurationError, RecordingError) as error:
            note = str(error)
        else:
            changes = [(int(t), not s) for t, s in zip(stream.t_ns, stream.swing, strict=True)]
            stance = _spans(changes, start_ns, end_ns)
            if leg in gathered.legs_with_truth:
                contacts = contacts_of(stream.truth, int(stream.t_ns[0]))
                truth = [
                    ((begin - start_ns) / _NS_PER_S, (min(end, end_ns) - start_ns) / _NS_PER_S)
                    for begin, end in zip(
                        contacts.onset_ns.tolist(), contacts.release_ns.tolist(), strict=True
                    )
                ]
                touches = _touches(
                    match(stream, gathered.events(leg)), contacts, t_ns, ratio, events, start_ns
                )
        return LegTrace(
            leg=leg,
            t_s=(t_ns - start_ns) / _NS_PER_S,
            ratio=ratio,
            stance=stance,
            contact=told,
            truth=truth,
            touches=tuple(touches),
            note=note,
        )


class TracedRecords:
    """Passes records on, and keeps of them what the score needs.

    Args:
        records: with the keys of the contract.
        robot: whose geometry tells swings.
    """

    def __init__(self, records: Iterable[Record], robot: Robot) -> None:
        self.gathered = Gatherer(robot)
        self._records = records

    def __iter__(self) -> Iterator[Record]:
        for record in self._records:
            self.gathered.take(record)
            yield record


def _spans(changes: list[tuple[int, bool]], start_ns: int, end_ns: int) -> Spans:
    """Spans in which a state holds, from its changes (or repeats) in order of time."""
    spans: Spans = []
    since: int | None = None
    for at_ns, holds in [*changes, (end_ns, False)]:
        if holds and since is None:
            since = at_ns
        elif not holds and since is not None:
            spans.append(((since - start_ns) / _NS_PER_S, (at_ns - start_ns) / _NS_PER_S))
            since = None
    return spans


def _touches(
    outcome: LegOutcome,
    contacts: Contacts,
    t_ns: NDArray[np.int64],
    ratio: Floats,
    events: list[ContactEvent],
    start_ns: int,
) -> list[Touch]:
    scores = {event.t_ns: event.score for event in events if event.contact}
    releases = dict(zip(contacts.onset_ns.tolist(), contacts.release_ns.tolist(), strict=True))
    withheld = [event.t_ns for event in events if event.withheld]
    found = []
    table = outcome.touches
    for i, onset in enumerate(table.onset_ns.tolist()):
        row = ROWS[int(table.row[i])].value
        speed = table.speed_m_s[i]
        of = row if np.isnan(speed) else f"{row}, {speed:.3f} m/s"
        at_s = (onset - start_ns) / _NS_PER_S
        if table.found[i]:
            latency = int(table.latency_ns[i])
            score = scores.get(onset + latency)
            peak = "" if score is None else f" at {score:.2f} times the threshold"
            why = f"found after {latency / 1e6:.0f} ms{peak} ({of})"
            found.append(Touch(at_s, "hit", why))
            continue
        end = min(onset + int(table.window_ns[i]), releases[onset])
        earlier = [at_ns for at_ns in scores if onset < at_ns <= end]
        if earlier:
            ms = (earlier[0] - onset) / 1e6
            why = f"missed: the contact after {ms:.0f} ms counts for a touch before it ({of})"
            found.append(Touch(at_s, "miss" if table.counted[i] else "beyond", why))
            continue
        kind = "miss" if table.counted[i] else "beyond"
        found.append(Touch(at_s, kind, f"{_why_missed(t_ns, ratio, onset, end, withheld)} ({of})"))
    for alarms, where in ((outcome.alarms_ns, "swing"), (outcome.after_ns, "turn to stance")):
        for at_ns in alarms.tolist():
            score = scores.get(at_ns, np.nan)
            why = f"false, {score:.2f} times the threshold, in or after the {where}"
            if where == "swing":
                why = f"false, {score:.2f} times the threshold, in the swing"
            found.append(Touch((at_ns - start_ns) / _NS_PER_S, "false", why))
    return sorted(found, key=lambda touch: touch.at_s)


def _why_missed(
    t_ns: NDArray[np.int64], ratio: Floats, onset: int, end: int, withheld: list[int]
) -> str:
    """The largest test ratio while a touch could be found, and what that says."""
    if any(onset < at_ns <= end for at_ns in withheld):
        return "missed: withheld, the leg was ambiguous"
    inside = (t_ns > onset) & (t_ns <= end)
    judged = ratio[inside & np.isfinite(ratio)]
    if not np.any(inside):
        return "missed: no sample while it lasted"
    if not len(judged):
        return "missed: no tick could be judged while it lasted"
    peak = float(judged.max())
    if peak <= 1.0:
        return f"missed: at most {peak:.2f} times the threshold, {1 - peak:.0%} below it"
    return (
        f"missed: reached {peak:.2f} times the threshold, but was not reported: the leg was still "
        "held to touch, in its lift, or beyond what its model has seen"
    )
