"""What has changed with the servos, one line each, for the person at the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from adaptive_contact.bridge.handshake import BUSY, crowd
from adaptive_contact.bridge.health import ServoHealth
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.wake import remedy

__all__ = ["News"]

# Alarms of the servo; the others are of a packet, and counted.
_TOLD: Final = {"overload", "overheating", "voltage", "electrical_shock", "encoder"}
# A servo that was silent answers again when it has done so for this many looks, a second each: one
# that comes and goes is not a line a second.
_BACK_LOOKS: Final = 2
# Looks without a crowd of late servos after which a computer is no longer too busy.
_CALM_LOOKS: Final = 10
# Goals found changed since the last look, of one servo, that are another program's: a servo that
# has been switched off and on changes one.
_FOREIGN: Final = 3


class News:
    """Remembers what was told of a port's servos.

    Args:
        plan: what is on the port.
    """

    def __init__(self, plan: PortPlan) -> None:
        self._plan = plan
        self._names = {j.servo: f"{leg.id} {j.name}" for leg in plan.legs for j in leg.joints}
        self._silent: set[int] = set()
        self._answered: dict[int, int] = {}
        self._busy = False
        self._calm = 0
        self._late: dict[int, int] = {}
        self._foreign: dict[int, int] = {}
        self._shared = False
        self._shut: set[int] = set()
        self._alarms: dict[int, frozenset[str]] = {}

    def lines(
        self, health: Mapping[int, ServoHealth], late: Mapping[int, int] | None = None
    ) -> list[str]:
        """What is new since the last call.

        Args:
            health: by servo.
            late: answers that came too late since the start, by servo.
        """
        said: list[str] = []
        silent = {servo for servo, record in health.items() if record.silent}
        if not self._crowded(said, silent, dict(late or {})):
            self._silences(said, silent)
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
        self._strangers(said, health)
        return said

    def _crowded(self, said: list[str], silent: set[int], late: dict[int, int]) -> bool:
        """Whether so many answers come late that no servo is to be blamed; said once."""
        now_late = {servo for servo, count in late.items() if count > self._late.get(servo, 0)}
        self._late = late
        many = crowd(len(self._names))
        if len(now_late) >= many:
            self._calm = 0
            if not self._busy:
                self._busy = True
                said.append(
                    f"port {self._plan.name}: answers of {len(now_late)} servos come too late: "
                    f"{BUSY}"
                )
        elif self._busy:
            self._calm += 1
            if self._calm >= _CALM_LOOKS:
                self._busy = False
                said.append(f"port {self._plan.name}: answers come in time again")
        return self._busy

    def _silences(self, said: list[str], silent: set[int]) -> None:
        self._say(said, sorted(silent - self._silent), "no answer; check its cable and power")
        back = []
        for servo in sorted(self._silent - silent):
            self._answered[servo] = self._answered.get(servo, 0) + 1
            if self._answered[servo] >= _BACK_LOOKS:
                back.append(servo)
        for servo in [*self._answered]:
            if servo in silent or servo in back:
                del self._answered[servo]
        self._say(said, back, "answers again")
        self._silent = (self._silent | silent) - set(back)

    def _strangers(self, said: list[str], health: Mapping[int, ServoHealth]) -> None:
        """Say once that another program writes goals, which this one writes too."""
        found = [
            servo
            for servo, record in health.items()
            if record.faults["foreign_goal"] - self._foreign.get(servo, 0) >= _FOREIGN
        ]
        self._foreign = {servo: record.faults["foreign_goal"] for servo, record in health.items()}
        if found and not self._shared:
            self._shared = True
            self._say(
                said,
                found,
                "its goals are changed by another program; end that one, see 'Two masters on one "
                "bus' in docs/bridge.md",
            )

    def _say(self, said: list[str], servos: Sequence[int], words: str) -> None:
        if servos:
            told = ", ".join(f"{servo} ({self._names[servo]})" for servo in servos)
            said.append(f"port {self._plan.name}: servo {told}: {words}")
