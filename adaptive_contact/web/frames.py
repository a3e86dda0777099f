"""Makes the data of the page: ten frames a second, and a table of legs when it changes.

A frame is JSON with what is new since the one before it:

* ``t``: time of the frame, ms since the start of the page's server;
* ``k``: by leg, ticks ``[t, swing, ratio, c, d…, m…, p…]``: ms; 1 in swing, 0 in stance, -1
  unknown; test ratio, and probability that the foot carries, in hundredths or null; command,
  reading and, where there is one, prediction of each joint in 0.1 mrad;
* ``f``: by leg, places of its joints and its foot on the body, ``[x, y, x, y, …]`` in mm;
* ``e``: contact events ``[leg, t, onset, contact, score, withheld]``;
* ``g``: changes of truth ``[leg, t, contact]``;
* ``v``: verdicts ``[leg, kind, t]``.

All times are of the server's clock.  A leg's source has a clock of its own, which may jump; the
first tick after a jump says how far the two are apart.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from adaptive_contact.checks.findings import Finding
from adaptive_contact.printable import printable
from adaptive_contact.service.attention import Attention
from adaptive_contact.service.watch import LegView, Verdict, View
from adaptive_contact.wire import ContactEvent, ContactTruth, LearnerStatus, LegTrace

# Text of the wire that is shown: notes are a line, and nothing stops a stranger's from being long.
_MOST_TEXT: Final = 600


class Frames:
    """Gathers what has arrived into frames.

    Args:
        start_ns: monotonic; times of frames count from there.
    """

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        # From each leg's own clock to the server's.
        self._offsets: dict[str, int] = {}
        self._last_ms: dict[str, int] = {}
        self._ticks: dict[str, list[list[Any]]] = {}
        self._places: dict[str, list[int]] = {}
        self._contacts: deque[tuple[str, ContactEvent | ContactTruth]] = deque(maxlen=1024)
        self._verdicts: list[tuple[str, Verdict]] = []

    def trace(self, trace: LegTrace, now_ns: int) -> None:
        """Take ticks of a leg in."""
        rows = list(
            zip(
                trace.t_ns,
                trace.swing,
                trace.test_ratio,
                trace.p or itertools.repeat(None),  # of a service that has no state
                trace.desired,
                trace.measured,
                trace.predicted,
                strict=False,
            )
        )
        if not rows:
            return
        self._update_offset(trace.leg, rows[-1][0], now_ns)
        outline = trace.places_m[:32]  # what is more, or 100 m off, is no leg
        places = [value for place in outline for value in place[:2]]
        if len(places) == 2 * len(outline) and all(abs(value) < 100.0 for value in places):
            self._places[trace.leg] = [round(value * 1e3) for value in places]
        ticks = self._ticks.setdefault(trace.leg, [])
        # A tick further ahead of its arrival, or longer ago, is none: nothing after it could be
        # drawn.
        newest_ms = (now_ns - self._start_ns) // 1_000_000 + 1000
        oldest_ms = newest_ms - 60_000
        for t_ns, swing, ratio, p, desired, measured, predicted in rows:
            at_ms = self._ms(trace.leg, t_ns)
            if at_ms is None or not self._last_ms.get(trace.leg, oldest_ms) < at_ms <= newest_ms:
                continue
            self._last_ms[trace.leg] = at_ms
            if len(measured) != len(desired):
                continue
            drawn = predicted if predicted and len(predicted) == len(measured) else ()
            angles = [*desired, *measured, *drawn]
            ticks.append(
                [
                    at_ms,
                    -1 if swing is None else int(swing),
                    _hundredths(ratio),
                    _hundredths(p),
                    *(_angle(value) for value in angles),
                ]
            )

    def contact(self, leg: str, message: ContactEvent | ContactTruth) -> None:
        """Take a contact event or a change of truth in."""
        self._contacts.append((leg, message))

    def verdicts(self, verdicts: Iterable[tuple[str, Verdict]]) -> None:
        """Take what became of touches and events in."""
        self._verdicts += verdicts

    def frame(self, now_ns: int) -> bytes:
        """Encode what is new since the last call."""
        events, truths = [], []
        for leg, message in self._contacts:
            at_ms = self._ms(leg, message.t_ns)
            if at_ms is None:  # before the first tick of its leg, which shows its clock
                continue
            if isinstance(message, ContactTruth):
                truths.append([leg, at_ms, int(message.contact)])
            else:
                onset_ms = self._ms(leg, message.onset_ns)
                score, withheld = _hundredths(message.score), int(message.withheld)
                events.append([leg, at_ms, onset_ms, int(message.contact), score, withheld])
        self._contacts.clear()
        verdicts = [
            [leg, verdict.kind, at_ms]
            for leg, verdict in self._verdicts
            if (at_ms := self._ms(leg, verdict.t_ns)) is not None
        ]
        self._verdicts = []
        found: dict[str, Any] = {"t": (now_ns - self._start_ns) // 1_000_000}
        placed = {leg: places for leg, places in self._places.items() if places}
        parts = {"k": self._ticks, "f": placed, "e": events, "g": truths, "v": verdicts}
        found |= {name: part for name, part in parts.items() if part}
        encoded = msgspec.json.encode(found)
        self._ticks, self._places = {}, {}
        return encoded

    def _update_offset(self, leg: str, newest_ns: int, now_ns: int) -> None:
        """Update a leg's clock offset by a tick that has just arrived."""
        known = self._offsets.get(leg)
        # A source's clock has jumped where a tick is this far from the time of its arrival: a
        # service that stands still for a second gives its ticks later, at their own times.
        if known is not None and abs(newest_ns + known - now_ns) < 2_000_000_000:
            return
        own = now_ns - newest_ns
        others = [other for name, other in self._offsets.items() if name != leg]
        # Legs of one source have one clock: what differs by less is the way here.
        alike = [other for other in others if abs(other - own) < 500_000_000]
        self._offsets[leg] = alike[0] if alike else own

    def _ms(self, leg: str, t_ns: int) -> int | None:
        """Convert a leg's time to the server's clock, ms; None before its first tick."""
        offset = self._offsets.get(leg)
        return None if offset is None else (t_ns + offset - self._start_ns) // 1_000_000


class Table:
    """Encodes the table of legs as JSON, when it has changed.

    Args:
        clock_ms: wall clock at time 0 of the frames.
    """

    def __init__(self, clock_ms: int) -> None:
        self._clock_ms = clock_ms
        self._shown = b""
        self._attention = Attention()

    def encode(
        self,
        view: View | None,
        statuses: Mapping[str, LearnerStatus],
        now_ns: int,
        *,
        waiting: Finding | None = None,
        recording: dict[str, Any] | None = None,
    ) -> bytes | None:
        """Encode the table; None where it has not changed.

        Args:
            view: what is known; None before a router is joined.
            statuses: last one of each leg.
            now_ns: monotonic.
            waiting: what stands in the way of that.
            recording: state of the newest recording; None where the page may make none.
        """
        if view is None:
            found = [] if waiting is None else [waiting]
            table: dict[str, Any] = {"legs": [], "banner": _banner(found)}
        else:
            found = self._attention.list_findings(view, statuses, now_ns)
            legs = [_leg(leg, statuses.get(leg.leg), view) for leg in view.legs]
            table = {"legs": legs, "banner": _banner(found), "service": _service(view)}
        table |= {"clock_ms": self._clock_ms, "recording": recording}
        encoded = msgspec.json.encode(table)
        if encoded == self._shown:
            return None
        self._shown = encoded
        return encoded


def _banner(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    return [
        {
            "level": finding.level,
            "legs": [_text(leg) for leg in finding.legs],
            "what": _text(finding.what),
            "do": _text(finding.remedy),
        }
        for finding in findings
    ]


def _service(view: View) -> dict[str, Any]:
    service = view.service
    facts: dict[str, Any] = {"connected": view.connected, "alive": view.alive}
    if service is None:
        return facts
    delay = service.event_latency
    return facts | {
        "robot": _text(service.robot),
        "version": _text(service.version),
        "period_ms": service.period_s * 1e3,
        "baseline": None if service.baseline is None else _text(service.baseline),
        "events": service.events,
        "events_lost": service.events_lost,
        "p50_ms": None if delay is None else round(delay.p50, 2),
        "p99_ms": None if delay is None else round(delay.p99, 2),
    }


def _leg(leg: LegView, status: LearnerStatus | None, view: View) -> dict[str, Any]:
    facts = None if view.service is None else view.service.legs.get(leg.leg)
    row: dict[str, Any] = {
        "leg": leg.leg,
        "joints": [] if facts is None else [_text(joint) for joint in facts.joints],
        "contact": leg.contact,
        "status": leg.status,
        "stale": leg.stale,
        "unheard": leg.unheard,
        "touches": leg.touches,
        "seen": leg.seen,
        "false": leg.false_alarms,
        "latency_ms": _rounded(leg.median_latency_ms, 0),
        "hz": _rounded(leg.rate_hz, 0),
    }
    if status is None:
        return row
    ratios = [
        rms / floor
        for rms, floor in zip(status.residual_rms, status.noise_floor, strict=False)
        if floor > 0.0
    ]
    return row | {
        "contacts": status.contacts,
        "model": status.model_version,
        "drift": _rounded(status.drift.level, 2),
        "kind": None if status.drift.kind is None else _text(status.drift.kind),
        "changed_s": _rounded(leg.changed_s, 0),
        "floor": _rounded(max(ratios), 2) if ratios else None,
        "rms": [_rounded(value, 5) for value in status.residual_rms],
        "noise": [_rounded(value, 5) for value in status.noise_floor],
        "missed": status.missed,
        "restarts": status.restarts,
        "rejects": {_text(reason): times for reason, times in status.rejects.items() if times},
        "withheld": status.withheld,
        "doubt": status.doubt,
        "note": None if status.note is None else _text(status.note),
        "promoted": status.refits.promoted,
        "refused": status.refits.refused,
        "rolled_back": status.refits.rolled_back,
        "reason": None if status.refits.last_reason is None else _text(status.refits.last_reason),
        "swings": status.buffer.swings,
    }


def _text(text: str) -> str:
    """Make a text safe to show: no control characters, and no more than a screen of it."""
    shown = printable(text)
    return shown if len(shown) <= _MOST_TEXT else f"{shown[:_MOST_TEXT]}…"


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _angle(value: float) -> int | None:
    """Convert an angle to 0.1 mrad; None for what is no angle."""
    return round(value * 1e4) if abs(value) <= 1e3 else None


def _hundredths(ratio: float | None) -> int | None:
    if ratio is None or not math.isfinite(ratio):
        return None
    return round(min(ratio, 1e4) * 100)
