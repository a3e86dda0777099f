"""Tables and numbers as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

__all__ = ["Section", "Table", "interval", "number", "per_joint", "percent", "skipped"]


class Table(NamedTuple):
    """A table of texts."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


class Section(NamedTuple):
    """A section: title, text (with ``**`` and backticks), tables, names of pictures."""

    title: str
    text: str
    tables: Sequence[Table]
    pictures: Sequence[str]


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share in per cent."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"


def interval(ends: Sequence[float | None]) -> str:
    """Both ends of an interval of shares."""
    return "-" if None in ends else f"{100 * (ends[0] or 0):.1f}–{100 * (ends[1] or 0):.1f}"


def per_joint(
    values: Sequence[float | str | None] | None, digits: int = 2, *, scientific: bool = False
) -> str:
    """Values side by side; a text, such as that of an infinite one, stands as it is."""
    form = f".{digits}e" if scientific else f".{digits}f"
    if values is None:
        return "-"
    return " ".join(
        "-" if v is None else v if isinstance(v, str) else format(v, form) for v in values
    )


def skipped(rows: Sequence[Mapping[str, Any]]) -> str:
    """What was left out, as a sentence."""
    if not rows:
        return ""
    shown = "; ".join(f"{row['file']}: {row['reason']}" for row in rows[:8])
    more = f"; and {len(rows) - 8} more" if len(rows) > 8 else ""
    return f" Left out: {shown}{more}."
