"""Numbers as text, of all studies: what a page, a figure or a terminal shows has these forms.

Templates have them as filters (:data:`FILTERS`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

# Stands where there is no number; a page may have its own.
NONE: Final = "-"


def number(value: float | str | None, digits: int = 2, none: str = NONE, form: str = "f") -> str:
    """A number, or a dash where there is none; a text, such as of an infinite one, as it is."""
    return (
        none if value is None else value if isinstance(value, str) else f"{value:.{digits}{form}}"
    )


def scientific(value: float | str | None, digits: int = 1) -> str:
    """A number as a power of ten."""
    return number(value, digits, form="e")


def general(value: float, digits: int = 6) -> str:
    """A number with as many digits as it needs, at most so many."""
    return f"{value:.{digits}g}"


def share(value: float | None, digits: int = 1, none: str = NONE) -> str:
    """A share in per cent, without the unit."""
    return number(None if value is None else 100 * value, digits, none)


def percent(value: float | None, digits: int = 1, none: str = NONE) -> str:
    """A share in per cent."""
    return none if value is None else f"{share(value, digits)} %"


def signed(value: float | None, digits: int = 1) -> str:
    """A change in per cent, with its sign."""
    return NONE if value is None else f"{100 * value:+.{digits}f} %"


def interval(ends: Sequence[float | None]) -> str:
    """Both ends of an interval of shares, in per cent."""
    return NONE if None in ends else "–".join(map(share, ends))


def per_joint(values: Sequence[float | str | None] | None, digits: int = 2, form: str = "f") -> str:
    """Values side by side."""
    return NONE if values is None else " ".join(number(v, digits, form=form) for v in values)


def thousands(value: int) -> str:
    """A count, its thousands apart."""
    return f"{value:,}"


FILTERS: Final[Mapping[str, Callable[..., Any]]] = {
    "general": general,
    "interval": interval,
    "number": number,
    "per_joint": per_joint,
    "percent": percent,
    "scientific": scientific,
    "share": share,
    "signed": signed,
    "thousands": thousands,
}
