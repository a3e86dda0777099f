"""Reads and writes durations: ``600``, ``90s``, ``10m``, ``1h30m``, ``500ms``."""

from __future__ import annotations

import math
import re
from typing import Final

# What an error says was expected.
DURATIONS: Final = "seconds, or a duration such as 90s, 10m or 1h30m"

_SECONDS: Final = {
    "ms": 1e-3,
    **dict.fromkeys(("", "s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("m", "min", "mins", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours"), 3600.0),
    **dict.fromkeys(("d", "day", "days"), 86400.0),
}
_NUMBER: Final = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
_PART: Final = re.compile(rf"\s*({_NUMBER})\s*([a-z]*)", re.ASCII)


def seconds_of(text: str) -> float | None:
    """Return a duration in seconds, None where the text is none.

    A number without a unit is in seconds.  Several parts are added, the larger units first.
    """
    rest, total, last = text.strip().lower(), 0.0, math.inf
    several = False
    while True:
        part = _PART.match(rest)
        size = None if part is None else _SECONDS.get(part[2])
        if part is None or size is None or size >= last or (several and part[1][0] in "+-"):
            return None
        rest = rest[part.end() :].strip()
        if not part[2] and (rest or several):
            return None  # 1h30: of what unit?
        total, last, several = total + float(part[1]) * size, size, True
        if not rest:
            return total if math.isfinite(total) else None


def duration(seconds: float) -> str:
    """Write a duration in one unit, such as ``1.5 min``."""
    for size, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"
