"""Pages in Markdown from templates, and numbers as text: what all studies show has these forms."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import cannot_write, write_file
from adaptive_contact.score.summary import AlarmFigures, clopper_pearson

# Stands where there is no number.
NONE: Final = "–"


def number(value: float | str | None, digits: int = 2, form: str = "f") -> str:
    """A number, or a dash where there is none; a text, such as of an infinite one, as it is."""
    if value is None or isinstance(value, str):
        return value or NONE
    return f"{value:.{digits}{form}}"


def share(value: float | None, digits: int = 1) -> str:
    """A share in per cent, without the unit."""
    return number(None if value is None else 100 * value, digits)


def percent(value: float | None, digits: int = 1) -> str:
    """A share in per cent."""
    return NONE if value is None else f"{share(value, digits)} %"


def interval(ends: Sequence[float | None]) -> str:
    """Both ends of an interval of shares, in per cent."""
    return NONE if None in ends else "–".join(map(share, ends))


def found_of(found: int, of: int) -> str:
    """A share of touches with its interval, such as ``97.2 % (95.1 to 98.4)``."""
    if not of:
        return NONE
    low, high = clopper_pearson(found, of)
    return f"{percent(found / of)} ({share(low)} to {share(high)})"


def per_hour(alarms: int, ticks: int) -> str:
    """False alarms per robot-hour with their interval, such as ``32 (20 to 47)``."""
    rate = AlarmFigures.from_counts(alarms, max(ticks, 1))
    return f"{rate.per_hour:.0f} ({rate.interval.low:.0f} to {rate.interval.high:.0f})"


def row(*cells: str) -> str:
    """A row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def per_joint(values: Sequence[float | str | None] | None, digits: int = 2, form: str = "f") -> str:
    """Values side by side."""
    return NONE if values is None else " ".join(number(v, digits, form) for v in values)


def render(template: str, filters: Mapping[str, Callable[..., Any]] = {}, **given: Any) -> str:
    """Fill a template; what it has no value for is a mistake of its own.

    Args:
        template: its file, such as ``adaptation.md``.
        filters: functions that it may use besides jinja's own and those of this module.
        given: its values.
    """
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    own = (number, share, percent, interval, per_joint)
    environment.filters |= {f.__name__: f for f in own} | {"one_line": _one_line} | dict(filters)
    return environment.get_template(template).render(given)


def unwrapped(text: str) -> str:
    """Markdown with every paragraph, and every row of a table, in a line of its own."""
    blocks = []
    for block in filter(None, map(str.strip, re.split(r"\n\s*\n", text))):
        lines = "\n".join(map(str.strip, block.splitlines()))
        blocks.append(re.sub(r"(?<!\|)\n", " ", lines))
    return "\n\n".join(blocks)


def write_page(path: Path, text: str) -> None:
    """Write a page, whole or not at all, into a folder that is made if need be.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    advice = "give another folder"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(cannot_write(path, error, advice)) from error
    write_file(path, text.rstrip() + "\n", advice=advice)


def _one_line(text: str) -> str:
    """Without the breaks that keep a template readable."""
    return " ".join(filter(None, map(str.strip, text.splitlines())))
