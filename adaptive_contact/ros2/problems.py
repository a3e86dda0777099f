"""Counts messages of ROS 2 that were not used, by topic and reason, and reports them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final, Literal

_SHOWN: Final = 4  # names in a line


# Why a message, or what one leg has of it, was not used.
Reason = Literal[
    "wrong_type",
    "wrong_hash",
    "unreadable",
    "too_large",
    "no_positions",
    "not_finite",
    "joints_missing",
    "unmapped",
    "named_twice",
    "no_command",
    "trajectory",
    "repeated",
    "overflow",
]


# Called with the topic, the reason, and a line: what was found, what was expected, what to do.
OnProblem = Callable[[str, Reason, str], None]


class CdrError(Exception):
    """Reports a payload that is no message of its type."""


class UnknownHashError(Exception):
    """Reports a type's hash that matches no known definition; the text names those known."""


class Complaints:
    """Counts problems, and lets one line of each kind through now and then.

    Args:
        every_s: between two lines of one kind, s.

    Attributes:
        counts: of each topic and reason.
        first: detail of each kind's first problem.
    """

    def __init__(self, every_s: float = 10.0) -> None:
        self.counts: Counter[tuple[str, Reason]] = Counter()
        self.first: dict[tuple[str, Reason], str] = {}
        self._every_s = every_s
        self._said: dict[tuple[str, Reason], tuple[float, int]] = {}

    def count(self, topic: str, reason: Reason, detail: str, now_s: float) -> str | None:
        """Count a problem.

        Args:
            topic: where the message came.
            reason: why it was not used.
            detail: what was found, what was expected, what to do.
            now_s: on any clock that does not go back, s.

        Returns:
            The line to say now, None while one of its kind was said a short time ago.
        """
        kind = (topic, reason)
        self.counts[kind] += 1
        self.first.setdefault(kind, detail)
        before_s, before = self._said.get(kind, (-math.inf, 0))
        if now_s - before_s < self._every_s:
            return None
        times = self.counts[kind] - before
        self._said[kind] = (now_s, self.counts[kind])
        return f"{topic}: {detail}" + (f" ({times} times)" if times > 1 else "")

    def lines(self) -> list[str]:
        """Return one line of every kind, with its count."""
        return [
            f"{topic}: {self.first[topic, reason]}" + (f" ({times} times)" if times > 1 else "")
            for (topic, reason), times in self.counts.items()
        ]


def some(names: Sequence[str]) -> str:
    """Names for a line: a few, and how many more."""
    more = len(names) - _SHOWN
    # Letters of each; a stranger's may have thousands.
    shown = [name[:60] or "''" for name in names[:_SHOWN]]
    return ", ".join(shown or ["none"]) + (f" and {more} more" if more > 0 else "")
