"""Follows each servo's health: counts faults, asks silent servos less often, finds stale readings.

A servo that does not answer costs its timeout.  After a few such cycles it is asked once in a
while only, so that the others keep their rate; with its first answer it is back.
What has changed is one line each for the person at the terminal.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Final, Generic, TypeVar

from adaptive_contact.bridge.bus import Reading
from adaptive_contact.bridge.drive import remedy
from adaptive_contact.bridge.handshake import BUSY, crowd
from adaptive_contact.bridge.packets import FEETECH_BITS
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.wire import ServoCounts

K = TypeVar("K", int, str, tuple[str, int])

# Cycles without an answer in a row before a servo is called silent.
SILENT_AFTER: Final = 3
# A silent servo is asked every so many cycles, 0.2 s at 50 Hz.
ASK_EVERY: Final = 10


@dataclasses.dataclass
class ServoHealth:
    """Records the answers, faults and alarms of one servo."""

    misses: int = 0  # cycles in a row without a reading
    shut: bool = False  # it has shut itself down, and does not drive
    faults: Counter[str] = dataclasses.field(default_factory=Counter)  # by kind, since the start
    _alarms: dict[str, int] = dataclasses.field(default_factory=dict)

    @property
    def silent(self) -> bool:
        """Return whether the servo is asked less often."""
        return self.misses >= SILENT_AFTER

    def record_reading(self, reading: Reading) -> None:
        """Record what came of a read."""
        for name in [*self._alarms]:
            self._alarms[name] -= 1
            if self._alarms[name] <= 0:
                del self._alarms[name]
        for name in reading.alarms:
            if name not in self._alarms:
                self.faults[name] += 1
            self._alarms[name] = 50
        if reading.fault is not None:
            self.faults[reading.fault] += 1
        if reading.data is not None:
            self.misses = 0
        elif reading.fault in ("no_answer", "corrupt"):
            self.misses += 1

    def alarm(self, names: Iterable[str]) -> None:
        """Note what is behind an alert."""
        self.record_reading(Reading(b"", tuple(names)))

    @property
    def alarms(self) -> set[str]:
        """Return the alarms that the servo reports now."""
        return set(self._alarms)

    @property
    def endangered(self) -> bool:
        """Return whether it reports an alarm that may make it shut itself down."""
        # Alarms are shown for this many readings after they were last seen.
        return not {
            "overload",
            "overheating",
            "overcurrent",
            "electrical_shock",
            "voltage",
            "hardware",
        }.isdisjoint(self._alarms)

    @property
    def counts(self) -> ServoCounts | None:
        """Return what there is to report, or None."""
        if not self.faults and not self.shut:
            return None
        alarms = sorted(self._alarms) + ["shutdown"] * self.shut
        return ServoCounts(
            silent=self.silent, alarms=alarms, faults=dict(sorted(self.faults.items()))
        )


def due(health: dict[int, ServoHealth], cycle: int, *, hurry: bool = False) -> list[int]:
    """Return the servos to ask in this cycle: all that answer, and at most one silent one, last.

    Args:
        health: by id, in the order they are asked.
        cycle: number of the cycle.
        hurry: ask a silent one in every cycle: another has just come back.
    """
    silent = [servo for servo, record in health.items() if record.silent]
    # Silent ones take turns, so that many of them cost no more time than one.
    every = 1 if hurry else ASK_EVERY
    turn = [silent[(cycle // every) % len(silent)]] if silent and cycle % every == 0 else []
    # Last, so that waiting for it puts no other off its usual moment.
    return [servo for servo, record in health.items() if not record.silent] + turn


def is_stale(
    steps: int, before: int, speed_rad_s: float, speed_before_rad_s: float, tick_step_rad: float
) -> bool:
    """Return whether a position is an earlier one again.

    Args:
        steps: position now.
        before: position a tick ago.
        speed_rad_s: what the servo says of its speed now.
        speed_before_rad_s: what it said a tick ago.
        tick_step_rad: speed, rad/s, of one position step a tick.
    """
    # Of one sign: a joint that has turned round meanwhile may well be where it was.
    if steps != before or speed_rad_s * speed_before_rad_s <= 0.0:
        return False
    # A position that stays to the step while the servo says it moves this many steps a tick is
    # stale: half a step of noise alone makes it change.
    return min(abs(speed_rad_s), abs(speed_before_rad_s)) > 3.0 * tick_step_rad


@dataclasses.dataclass
class Punctuality:
    """Checks whether a servo is read at its usual moment of the tick.

    A model predicts from tick to tick: a joint at 4 rad/s read 5 ms late is 20 mrad, four steps of
    an AX-12A, beside where it belongs.  On a computer with other work that happens.  A servo looks
    at some moment between question and answer: where both came late alike, its own speed carries
    the reading back; where only one did, the moment is unknown.
    """

    _recent_s: deque[tuple[float, float]] = dataclasses.field(
        # Readings of which a servo's usual place in the cycle is the median.
        default_factory=lambda: deque(maxlen=5)
    )

    def correction(
        self, asked_s: float, answered_s: float, speed_rad_s: float, step_rad: float
    ) -> float | None:
        """Take in a reading.

        Args:
            asked_s: when the servo was asked, after the moment the tick was due.
            answered_s: when it had answered, the same.
            speed_rad_s: how fast it moves.
            step_rad: one position step.

        Returns:
            What to add to the position so that it stands for its tick, rad; None if it cannot.
        """
        self._recent_s.append((asked_s, answered_s))
        # The median: one late reading moves it little, a bus that has become slower does so within
        # three ticks, after which readings are a period apart again.
        asked_off, answered_off = (
            now - statistics.median(times)
            for now, times in zip(
                (asked_s, answered_s), zip(*self._recent_s, strict=True), strict=True
            )
        )
        off_s, unknown_s = (asked_off + answered_off) / 2.0, abs(answered_off - asked_off) / 2.0
        # What is less than this much of a step off is left as it was read.
        if abs(off_s) * abs(speed_rad_s) <= 0.5 * step_rad:
            correction = 0.0
        # One read this far off its moment is not carried back: at 100 rad/s² a joint's own speed
        # gives where it was 5 ms ago to a quarter of an AX-12A's step, and 10 ms ago to one.
        elif abs(off_s) <= 0.005:
            # In whole steps: readings stay on the encoder's grid, which checks read off them.
            correction = step_rad * round(-off_s * speed_rad_s / step_rad)
        else:
            return None
        # A reading whose moment is not known to a position step, as the joint moves, cannot stand
        # for its tick: half of it is the noise of a reading anyway.
        return None if unknown_s * abs(speed_rad_s) > step_rad else correction


class Conditions(Generic[K]):
    """Remembers of whom a condition was reported, and for how many looks it differs."""

    def __init__(self) -> None:
        self.reported: set[K] = set()
        self._looks: Counter[K] = Counter()

    def update(self, now: set[K], *, begins: int = 1, ends: int = 1) -> tuple[list[K], list[K]]:
        """Return for whom it has begun, and ended, for so many looks in a row."""
        differ = now ^ self.reported
        self._looks = Counter({key: self._looks[key] + 1 for key in differ})
        begun = {key for key in differ & now if self._looks[key] >= begins}
        ended = {key for key in differ - now if self._looks[key] >= ends}
        self.reported = (self.reported | begun) - ended
        return sorted(begun), sorted(ended)


class News:
    """Says what has changed on a port, one line each; a look is a second."""

    def __init__(self, plan: PortPlan) -> None:
        self._plan = plan
        self._names = {j.servo: f"{leg.id} {j.name}" for leg in plan.legs for j in leg.joints}
        self._busy, self._silent = Conditions[str](), Conditions[int]()
        self._slow, self._shut, self._shared = (Conditions[int]() for _ in range(3))
        self._alarms = Conditions[tuple[str, int]]()
        self._late: dict[int, int] = {}
        self._foreign: dict[int, int] = {}

    def lines(
        self, health: Mapping[int, ServoHealth], late: Mapping[int, int] | None = None
    ) -> list[str]:
        """Return what is new since the last call; ``late`` counts late answers since the start."""
        said: list[str] = []
        silent = {servo for servo, record in health.items() if record.silent}
        answering = {servo for servo, record in health.items() if not record.misses}
        late = dict(late or {})
        now_late = {servo for servo, count in late.items() if count > self._late.get(servo, 0)}
        self._late = late
        self._silences(said, silent, answering, now_late)
        # Alarms of the servo; the others are of a packet, and counted.
        alarms = {
            (name, servo)
            for servo, record in health.items()
            for name in record.alarms & {*FEETECH_BITS.values(), "electrical_shock"}
        }
        for found, over in zip(self._alarms.update(alarms), ("", " is over"), strict=True):
            for name in sorted({name for name, _ in found}):
                self._add_line(said, [servo for of, servo in found if of == name], name + over)
        shut, woken = self._shut.update({s for s, record in health.items() if record.shut})
        self._add_line(said, shut, remedy(self._plan.joints[0].model))
        self._add_line(said, woken, "no longer shut down")
        self._strangers(said, health)
        return said

    def _silences(
        self, said: list[str], silent: set[int], answering: set[int], now_late: set[int]
    ) -> None:
        """Report who has fallen silent, and who answers again.

        A servo whose answers come too late is neither broken nor unplugged: it is not named while
        the computer is too busy.  One of which nothing comes is, however busy the computer.
        """
        port = f"port {self._plan.name}: answers"
        crowded = {port} if len(now_late) >= crowd(len(self._names)) else set()
        begun, calm = self._busy.update(crowded, ends=10)
        said += [f"{of} of {len(now_late)} servos come too late: {BUSY}" for of in begun]
        said += [f"{of} come in time again" for of in calm]
        busy = self._busy.reported
        # On a computer that is too busy, a servo is named after so many looks without any answer of
        # it, not even a late one; else after one.  It is asked five times a look at the least, at
        # 50 Hz.  One that comes and goes is not a line a second.
        dead = (silent - now_late) | (self._silent.reported - answering - now_late)
        gone, back = self._silent.update(dead, begins=3 if busy else 1, ends=2)
        self._add_line(said, gone, "no answer; check its cable and power")
        # A servo whose answers keep coming too late, where few do, is named after so many looks,
        # once.
        slow = set() if busy else silent & now_late
        self._add_line(
            said,
            self._slow.update(slow | self._slow.reported, begins=3)[0],
            f"its answers come too late; set timeout_ms higher in [port.{self._plan.name}], and "
            "see 'Timing' in docs/bridge.md",
        )
        self._add_line(said, back, "answers again")

    def _strangers(self, said: list[str], health: Mapping[int, ServoHealth]) -> None:
        """Report once that another program writes goals, which this one writes too."""
        goals = {servo: record.faults["foreign_goal"] for servo, record in health.items()}
        # Goals found changed since the last look, of one servo, that are another program's: a
        # servo that has been switched off and on changes one.
        found = {s for s, count in goals.items() if count - self._foreign.get(s, 0) >= 3}
        self._foreign = goals
        if not self._shared.reported:
            self._add_line(
                said,
                self._shared.update(found)[0],
                "its goals are changed by another program; end that one, see 'Two masters on one "
                "bus' in docs/bridge.md",
            )

    def _add_line(self, said: list[str], servos: Sequence[int], words: str) -> None:
        if servos:
            names = ", ".join(f"{servo} ({self._names[servo]})" for servo in servos)
            said.append(f"port {self._plan.name}: servo {names}: {words}")
