"""What has changed with the servos, one line each, for the person at the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from adaptive_contact.bridge.health import ServoHealth
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.wake import remedy

__all__ = ["News"]

# Alarms of the servo; the others are of a packet, and counted.
_TOLD: Final = {"overload", "overheating", "voltage", "electrical_shock", "encoder"}


class News:
    """Remembers what was told of a port's servos.

    Args:
        plan: what is on the port.
    """

    def __init__(self, plan: PortPlan) -> None:
        self._plan = plan
        self._names = {j.servo: f"{leg.id} {j.name}" for leg in plan.legs for j in leg.joints}
        self._silent: set[int] = set()
        self._shut: set[int] = set()
        self._alarms: dict[int, frozenset[str]] = {}

    def lines(self, health: Mapping[int, ServoHealth]) -> list[str]:
        """What is new since the last call."""
        said: list[str] = []
        silent = {servo for servo, record in health.items() if record.silent}
        self._say(said, sorted(silent - self._silent), "no answer; check its cable and power")
        self._say(said, sorted(self._silent - silent), "answers again")
        self._silent = silent
        by_words: dict[str, list[int]] = {}
        for servo, record in health.items():
            now = frozenset(record.alarms & _TOLD)
            before = self._alarms.get(servo, frozenset())
            if now - before:
                by_words.setdefault(", ".join(sorted(now - before)), []).append(servo)
            elif before and not now:
                by_words.setdefault(f"{', '.join(sorted(before))} is over", []).append(servo)
            self._alarms[servo] = now
        for words, servos in by_words.items():
            self._say(said, servos, words)
        shut = {servo for servo, record in health.items() if record.shut}
        self._say(said, sorted(shut - self._shut), remedy(self._plan.joints[0].model))
        self._say(said, sorted(self._shut - shut), "no longer shut down")
        self._shut = shut
        return said

    def _say(self, said: list[str], servos: Sequence[int], words: str) -> None:
        if servos:
            told = ", ".join(f"{servo} ({self._names[servo]})" for servo in servos)
            said.append(f"port {self._plan.name}: servo {told}: {words}")
