"""Compares what two revisions made of the same recording: pure functions of two outcomes."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

# Kinds of messages, and names of their fields after them.
Fields = set[str]
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
    known = fields or (known_fields([before]), known_fields([after]))
    trees = (_trees(before), _trees(after))
    for number, leg, kind, contact in dict.fromkeys([*trees[0], *trees[1]]):
        one, other = (side.get((number, leg, kind, contact), _ABSENT) for side in trees)
        if kind == "snapshot" and _formats(one) != _formats(other):
            found.notes.add("snapshots have other formats: not compared")
        elif one is not _ABSENT and other is not _ABSENT:
            for path, *values in _unlike(dict(flat(one, kind)), dict(flat(other, kind))):
                lacking = [value is _ABSENT for value in values]
                here, there = known[::-1] if lacking[0] else known
                new = any(lacking) and _new_field(path, here, there)
                off = _off(*values)
                found.largest = max(found.largest, 0.0 if math.isinf(off) else off)
                if new:
                    found.notes.add(f"{'-+'[lacking[0]]} {new}")
                elif off > tolerance or not tolerance:
                    of = Difference(number, leg, path, *map(_short, values))
                    found.differences += [] if {kind, path} & ignore else [of]
        elif kind == "event":  # of all else, a revision that faulted has no more
            scores = (None if side is _ABSENT else side["score"] for side in (one, other))
            found.flips += 1
            found.differences.append(
                Difference(number, leg, f"decision.contact {contact}, score", *scores)
            )
    return found


def _trees(outcome: dict[str, Any]) -> dict[tuple[float, str, str, bool], Any]:
    """What was said at which round of which leg, by kind; of decisions, by whether it touches."""
    trees: dict[tuple[float, str, str, bool], Any] = {
        (math.inf, "", "fault", False): outcome.get("fault"),
        **{(n, leg, "event", event["contact"]): event for n, leg, event in outcome["events"]},
        **{(n, leg, "judged", False): of for n, leg, of in outcome["judged"]},
    }
    for number, leg, status, confirmed in outcome["looks"]:
        trees[number, leg, "status", False] = status
        trees[number, leg, "confirmed", False] = confirmed
    for leg, end in outcome["end"].items():
        trees |= {(math.inf, leg, kind, False): of for kind, of in end.items()}
    return trees


def known_fields(outcomes: Iterable[dict[str, Any]]) -> Fields:
    """Fields of a revision's messages and snapshots, over all its outcomes, after their kind."""
    fields: Fields = set()
    for outcome in outcomes:
        for kind, names in outcome["fields"].items():
            fields |= {kind, *(f"{kind}.{name}" for name in names)}
        for end in outcome["end"].values():
            for path, _ in flat(end["snapshot"]):
                fields.update(_stems(f"snapshot.{path}"))
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


def _unlike(one: dict[str, Any], other: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Values that are not the same bit by bit; a NaN equals itself, 1 is not 1.0."""
    for path in dict.fromkeys([*one, *other]):
        values = one.get(path, _ABSENT), other.get(path, _ABSENT)
        bits = [
            (value.shape, value.tobytes())
            if isinstance(value, np.ndarray)
            else msgspec.msgpack.encode(value)
            for value in values
        ]
        if bits[0] != bits[1]:
            yield path, *values


def _new_field(path: str, here: Fields, there: Fields) -> str | None:
    """The field of a value that one revision does not have at all."""
    stems = _stems(path)
    if not {stems[0]} <= here & there or _DATA_MAPS & set(stems[-1].split(".")):
        return None
    return next((stem for stem in stems if stem in here and stem not in there), None)


def _formats(snapshot: Any) -> list[Any]:
    return [value for path, value in flat(snapshot) if path.split(".")[-1] == "format"]


def _stems(path: str) -> list[str]:
    """A path without its numbers, and all that it goes through."""
    names = re.sub(r"\[\d+\]", "", path).split(".")
    return [".".join(names[:depth]) for depth in range(1, len(names) + 1)]


def _off(one: Any, other: Any) -> float:
    """How far two numbers with a fraction are apart, or arrays; infinite for all else."""
    if isinstance(one, float) and isinstance(other, float) and math.isfinite(one - other):
        return abs(one - other) / max(1.0, abs(one), abs(other))
    numbers = type(one) is type(other) and isinstance(one, np.ndarray | float)
    if not numbers or np.shape(one) != np.shape(other):
        return math.inf
    with np.errstate(invalid="ignore"):
        apart = np.abs(one - other) / np.maximum(1.0, np.maximum(abs(one), abs(other)))
    apart = np.where(np.isnan(apart), math.inf, apart)
    alike = (one == other) | (np.isnan(one) & np.isnan(other))
    return float(np.where(alike, 0.0, apart).max(initial=0.0))


def _short(value: Any) -> Any:
    """For a report; of an array its form and a sum by which two can be told apart."""
    if isinstance(value, np.ndarray):
        return f"array {list(value.shape)} of sum {float(value.sum())!r}"
    return value.hex() if isinstance(value, bytes) else value
