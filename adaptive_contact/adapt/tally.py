"""What a learner counts, and how that outlives a restart."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

from adaptive_contact.wire import Reject

__all__ = ["Tally"]


@dataclasses.dataclass
class Tally:
    """Counters of one leg.

    Attributes:
        counts: by name.
        rejects: samples and payloads that were not used, by reason.
    """

    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    rejects: Counter[Reject] = dataclasses.field(default_factory=Counter)

    def snapshot(self) -> dict[str, Any]:
        """The counters as plain maps, for :meth:`restore`."""
        rejects = {str(reason): n for reason, n in self.rejects.items()}
        return {"counts": dict(self.counts), "rejects": rejects}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take over saved counters; what is none is left."""
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
