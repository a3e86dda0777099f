"""What a learner counts and remembers for its status, and how counts outlive a restart."""

from __future__ import annotations

import dataclasses
from collections import Counter, deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.wire import Reject

__all__ = ["Tally"]

Array = NDArray[np.float64]

# Free residuals remembered for the status, about the swings of the last ten seconds.
STATUS_TICKS: Final = 256
_NO_PREVIEW: Final = "the model needs a preview that the samples do not carry: no predictions"


@dataclasses.dataclass
class Tally:
    """Counters of one leg.

    Attributes:
        counts: by name.
        rejects: samples and payloads that were not used, by reason.
        residuals: (J,) rad each, of the newest free ticks.
        fault_note: one line for a person on faults in learning; None while there was none.
    """

    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    rejects: Counter[Reject] = dataclasses.field(default_factory=Counter)
    residuals: deque[Array] = dataclasses.field(default_factory=lambda: deque(maxlen=STATUS_TICKS))
    fault_note: str | None = None
    _faults: int = 0

    def fault(self, fault: Exception) -> None:
        """A fault in learning, after which it began anew."""
        self._faults += 1
        last = f"{type(fault).__name__}: {fault}"
        self.fault_note = f"{self._faults} faults in learning, begun anew each time; last {last}"

    @property
    def preview_note(self) -> str | None:
        """One line for a person when samples carry too little for a prediction."""
        return _NO_PREVIEW if self.counts["no_preview"] else None

    def residual_rms(self, joints: int) -> list[float]:
        """(J,) rad, root mean square of the newest free residuals; zeros without any."""
        if not self.residuals:
            return [0.0] * joints
        rms: list[float] = np.sqrt(np.square(np.array(self.residuals)).mean(axis=0)).tolist()
        return rms

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
