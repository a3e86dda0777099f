"""Numbers the control ticks of each leg from the messages of a publisher.

A publisher's sequence numbers count, so that a lost message is a gap in ``seq``.  Bags keep no
sequence numbers: there a gap is two periods or more in both the header's and the recorder's time.
"""

from __future__ import annotations

from collections import Counter
from typing import Final, NamedTuple

from adaptive_contact.ros2.problems import OnProblem

# Numbers of a publisher that jump further are no loss: it counts again.
_MOST_LOST: Final = 10_000_000


class Origin(NamedTuple):
    """Identifies where a message comes from."""

    publisher: bytes  # its id; empty where it is not known
    seq: int | None  # the message's number, None where it has none
    time_ns: int  # when it was published or recorded, ns since 1970


class Publisher:
    """Holds a publisher's numbers on one topic."""

    def __init__(self, run: int) -> None:
        self.run = run
        self.seq: int | None = None
        self.lost = 0
        self.ticks: Counter[str] = Counter()
        self.times: dict[str, tuple[int, int]] = {}


class TickCounter:
    """Follows all publishers.

    Args:
        run: of the first publisher; those of later ones are larger.
        period_ns: of the control loop, ns.
        on_problem: called with messages that come twice.
    """

    def __init__(self, run: int, period_ns: float, on_problem: OnProblem) -> None:
        self._publishers: dict[tuple[str, bytes], Publisher] = {}
        self._run = run
        self._period_ns = period_ns
        self._refuse = on_problem

    def publisher(self, topic: str, origin: Origin) -> Publisher | None:
        """Return who sent a message, its number taken in; None for one that was there already."""
        key = (topic, origin.publisher)
        publisher = self._publishers.get(key)
        back = False
        if publisher is not None and origin.seq is not None and publisher.seq is not None:
            ahead = origin.seq - publisher.seq
            # Numbers that go back by up to 50 are a message sent twice; by more, a restarted count.
            if -50 < ahead <= 0:
                self._refuse(
                    topic,
                    "repeated",
                    f"message {origin.seq} came after {publisher.seq} of the same publisher; "
                    "not used: look for a topic that is relayed twice",
                )
                return None
            if ahead <= 0 or ahead > _MOST_LOST:
                publisher, back = None, True
            else:
                publisher.lost += ahead - 1
        if publisher is None:
            if not back and len(self._publishers) >= 64:
                self._publishers.pop(next(iter(self._publishers)))
            publisher = self._publishers[key] = Publisher(self._run)
            self._run += 1
        publisher.seq = origin.seq
        return publisher

    def tick(self, publisher: Publisher, leg: str, t_ns: int, origin: Origin) -> int:
        """Return the number of a leg's tick, whose reading is of ``t_ns``, and count it."""
        if origin.seq is None:
            before = publisher.times.get(leg)
            if before is not None:
                apart = min(t_ns - before[0], origin.time_ns - before[1])
                if 1.5 * self._period_ns < apart < _MOST_LOST * self._period_ns:
                    publisher.ticks[leg] += round(apart / self._period_ns) - 1
            publisher.times[leg] = (t_ns, origin.time_ns)
        seq = publisher.ticks[leg] + publisher.lost
        publisher.ticks[leg] += 1
        return seq
