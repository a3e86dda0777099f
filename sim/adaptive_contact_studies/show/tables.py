"""Numbers as text."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["interval", "number", "per_joint", "percent", "signed"]


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(share: float | None, digits: int = 1) -> str:
    """A share in per cent."""
    return "-" if share is None else f"{100 * share:.{digits}f} %"


def signed(share: float | None, digits: int = 1) -> str:
    """A change in per cent, with its sign."""
    return "-" if share is None else f"{100 * share:+.{digits}f} %"


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
