"""Compares what two revisions made of the same recording: pure functions of two outcomes."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

# Names of fields, by kind of message.
Fields = dict[str, set[str]]
# Differences that are shown of a recording.
MOST_SHOWN: Final = 12
# Maps of a snapshot whose keys are data, such as the reasons that occurred.
_DATA_MAPS: Final = frozenset({"counts", "rejects"})
_ABSENT: Final = "(absent)"


class Difference(NamedTuple):
    """A value that is not the same; of a decision that only one revision made, its score.

    Attributes:
        round: of the recording, at which it was noted; infinite for its end.
        leg: whose.
        field: kind of message, and path of the value.
        before, after: in the first and in the second revision.
    """

    round: float
    leg: str
    field: str
    before: Any
    after: Any


@dataclass
class Comparison:
    """Of one recording.

    Attributes:
        events: how many, in the first and the second revision.
        flips: how many decisions only one revision made.
        differences: beyond the tolerance.
        largest: size of the largest difference of numbers, within the tolerance or beyond.
        notes: what only one revision has (``-`` the first, ``+`` the second), or is not compared.
    """

    events: tuple[int, int] = (0, 0)
    flips: int = 0
    differences: list[Difference] = field(default_factory=list)
    largest: float = 0.0
    notes: set[str] = field(default_factory=set)

    def __str__(self) -> str:
        verdict = "same" if self.same else f"DIFFERENT, {len(self.differences)} values"
        return (
            f"{verdict}; events {self.events[0]}, {self.events[1]}, {self.flips} in one only; "
            f"largest {self.largest:.0e}"
        )

    @property
    def lines(self) -> list[str]:
        """A line per difference, in order of time."""
        ordered = sorted(self.differences, key=lambda of: of[:2])
        return [
            f"leg {of.leg}, tick {of.round}, {of.field}: expected {of.before!r:.70}, "
            f"found {of.after!r:.70}"
            for of in ordered
        ]

    @property
    def first(self) -> str:
        """The first tick that differs: of which leg, what was expected, what was found."""
        return next(iter(self.lines), "none")

    @property
    def same(self) -> bool:
        """Whether nothing differs by more than the tolerance."""
        return not self.differences


def compare(
    before: dict[str, Any],
    after: dict[str, Any],
    *,
    fields: tuple[Fields, Fields] | None = None,
    tolerance: float = 0.0,
    ignore: frozenset[str] = frozenset(),
) -> Comparison:
    """Compare two outcomes of one recording.

    Args:
        before, after: as ``play.py`` writes them.
        fields: that each revision has, as :func:`known_fields` tells them; those of the two
            outcomes where left out.
        tolerance: of numbers with a fraction, relative beyond 1; 0 for bit by bit.
        ignore: fields that may differ, such as ``status.note``.
    """
    found = Comparison(events=(len(before["events"]), len(after["events"])))
    fields = fields or (known_fields([before]), known_fields([after]))
    of = _Pairs(found, fields, tolerance, ignore)
    if before.get("fault") != after.get("fault"):
        of.differ("fault", "", math.inf, "fault", before.get("fault"), after.get("fault"))
    _compare_events(of, before["events"], after["events"])
    looks = [{(n, leg): rest for n, leg, *rest in side["looks"]} for side in (before, after)]
    for at in dict.fromkeys([*looks[0], *looks[1]]):
        number, leg = at
        one, other = looks[0].get(at), looks[1].get(at)
        if one is None or other is None:  # a revision that faulted has no more of them
            continue
        of.values("status", leg, number, one[0], other[0])
        if one[1] != other[1]:
            of.differ("confirmed", leg, number, "confirmed", one[1], other[1])
    judged = [{(n, leg): of for n, leg, of in side["judged"]} for side in (before, after)]
    for number, leg in judged[0].keys() & judged[1].keys():
        of.values("judged", leg, number, *(side[number, leg] for side in judged))
    for leg in before["end"].keys() & after["end"].keys():
        one, other = before["end"][leg], after["end"][leg]
        of.values("report", leg, math.inf, one["report"], other["report"])
        formats = [_formats(side["snapshot"]) for side in (one, other)]
        if formats[0] == formats[1]:
            of.values("snapshot", leg, math.inf, one["snapshot"], other["snapshot"])
        else:
            found.notes.add(
                f"snapshots have formats {formats[0] or 'none'} and {formats[1] or 'none'}: "
                "not compared"
            )
    return found


def known_fields(outcomes: Iterable[dict[str, Any]]) -> Fields:
    """Fields of a revision's messages and snapshots, over all its outcomes, by kind."""
    fields: Fields = {}
    for outcome in outcomes:
        for kind, names in outcome["fields"].items():
            fields.setdefault(kind, set()).update(names)
        for end in outcome["end"].values():
            for path, _ in flat(end["snapshot"]):
                names = _names(path)
                stems = (".".join(names[:depth]) for depth in range(1, len(names) + 1))
                fields.setdefault("snapshot", set()).update(stems)
    return fields


def flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a tree with its path; arrays of snapshots as arrays."""
    if isinstance(value, dict):
        if set(value) == {"shape", "data"} and isinstance(value["data"], bytes):
            array = np.frombuffer(value["data"], dtype="<f8").reshape(value["shape"])
            yield path, array
            return
        for key in sorted(value, key=str):
            yield from flat(value[key], f"{path}.{key}" if path else str(key))
        if not value:
            yield path, {}
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from flat(item, f"{path}[{number}]")
        yield f"{path}.length", len(value)
    else:
        yield path, value


class _Pairs:
    """Pairs of values of two revisions, compared into one comparison."""

    def __init__(
        self,
        found: Comparison,
        fields: tuple[Fields, Fields],
        tolerance: float,
        ignore: frozenset[str],
    ) -> None:
        self.found = found
        self._fields = fields
        self._tolerance = tolerance
        self._ignore = ignore

    def values(self, kind: str, leg: str, number: float, before: Any, after: Any) -> None:
        """Compare two trees."""
        sides = (dict(flat(before)), dict(flat(after)))
        for path in dict.fromkeys([*sides[0], *sides[1]]):
            present = [path in side for side in sides]
            if not all(present) and self._is_new(kind, path, present[1]):
                continue
            one, other = (side.get(path, _ABSENT) for side in sides)
            size = _off(one, other)
            if size is not None and not math.isinf(size):
                self.found.largest = max(self.found.largest, size)
            if _equal(one, other):
                continue
            if self._tolerance and size is not None and size <= self._tolerance:
                continue
            self.differ(kind, leg, number, path, _short(one), _short(other))

    def differ(
        self, kind: str, leg: str, number: float, path: str, before: Any, after: Any
    ) -> None:
        """Note a difference, unless its field may differ."""
        if not {kind, f"{kind}.{path}"} & self._ignore:
            of = Difference(number, leg, f"{kind}.{path}", before, after)
            self.found.differences.append(of)

    def _is_new(self, kind: str, path: str, in_second: bool) -> bool:
        """Whether a value that one side lacks is of a field that its revision does not have."""
        here, there = (self._fields[side].get(kind) for side in (in_second, not in_second))
        names = _names(path)
        if here is None or there is None or _DATA_MAPS & set(names):
            return False
        for depth in range(1, len(names) + 1):
            stem = ".".join(names[:depth])
            if stem in here and stem not in there:
                self.found.notes.add(f"{'+' if in_second else '-'} {kind}.{stem}")
                return True
        return False


def _compare_events(of: _Pairs, before: list[Any], after: list[Any]) -> None:
    sides: list[dict[tuple[int, str, bool], Any]] = []
    for events in (before, after):
        sides.append({(n, leg, e["contact"]): e for n, leg, e in events})
    for at in sorted({*sides[0], *sides[1]}):
        number, leg, contact = at
        one, other = sides[0].get(at), sides[1].get(at)
        if one is not None and other is not None:
            of.values("event", leg, number, one, other)
            continue
        scores = (None if side is None else side["score"] for side in (one, other))
        of.found.flips += 1
        of.differ("decision", leg, number, f"contact {contact}, score", *scores)


def _formats(snapshot: Any) -> str:
    return ", ".join(f"{v}" for p, v in flat(snapshot) if p.split(".")[-1] == "format")


def _names(path: str) -> list[str]:
    """Names of a path without its numbers."""
    plain = "".join(part.split("]")[-1] for part in path.split("["))
    return plain.split(".")


def _equal(one: Any, other: Any) -> bool:
    """Bit by bit; a NaN equals itself, 1 is not 1.0."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.shape == other.shape and one.tobytes() == other.tobytes()
    if type(one) is not type(other):
        return False
    if isinstance(one, float):
        return struct.pack("<d", one) == struct.pack("<d", other)
    return bool(one == other)


def _off(one: Any, other: Any) -> float | None:
    """How far two numbers with a fraction are apart; None for all else."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        if one.shape != other.shape:
            return None
        if not one.size:
            return 0.0
        with np.errstate(invalid="ignore"):
            apart = np.abs(one - other) / np.maximum(1.0, np.maximum(abs(one), abs(other)))
        alike = (one == other) | (np.isnan(one) & np.isnan(other))
        return float(np.nan_to_num(np.where(alike, 0.0, apart), nan=math.inf).max())
    if not (isinstance(one, float) and isinstance(other, float)):
        return None
    if one == other or (math.isnan(one) and math.isnan(other)):
        return 0.0
    apart_by = abs(one - other) / max(1.0, abs(one), abs(other))
    return math.inf if math.isnan(apart_by) else apart_by


def _short(value: Any) -> Any:
    """For a report; of an array its form and a sum by which two can be told apart."""
    if isinstance(value, np.ndarray):
        return f"array {list(value.shape)} of sum {float(value.sum())!r}"
    return value.hex() if isinstance(value, bytes) else value
