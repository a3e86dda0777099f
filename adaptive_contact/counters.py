"""Counts what a learner reports in its status, and restores counts after a restart."""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

from adaptive_contact.wire import Reject

__all__ = ["Counters"]

FAULT_LINE: Final = 160  # characters


class Counters:
    """Counts for one leg.

    Attributes:
        counts: by name.
        rejects: samples and payloads that were not used, by reason.
        fault_note: one line for a person on faults in learning; None while there was none.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.rejects: Counter[Reject] = Counter()
        self.fault_note: str | None = None
        self._faults = 0

    def fault(self, fault: Exception) -> None:
        """Count a fault in learning, after which the leg was reset."""
        self._faults += 1
        last = " ".join(f"{type(fault).__name__}: {fault}".split())[:FAULT_LINE]
        self.fault_note = f"{self._faults} faults in learning, begun anew each time; last {last}"

    def snapshot(self) -> dict[str, Any]:
        """Return the counters as plain maps, for :meth:`restore`."""
        rejects = {str(reason): n for reason, n in self.rejects.items()}
        return {"counts": dict(self.counts), "rejects": rejects}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take over saved counters; what is not usable is left."""
        counts = saved.get("counts")
        if isinstance(counts, dict):
            for name, count in counts.items():
                if isinstance(name, str) and isinstance(count, int):
                    self.counts[name] = count
        rejects = saved.get("rejects")
        if isinstance(rejects, dict):
            known = {str(reason): reason for reason in Reject}
            for name, count in rejects.items():
                if name in known and isinstance(count, int):
                    self.rejects[known[name]] = count
