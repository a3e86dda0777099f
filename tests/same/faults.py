"""Faults of one line that golden recordings must notice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class Fault:
    """A line of the decision code, and what it is made.

    Attributes:
        name: permanent.
        file: under ``adaptive_contact``.
        old: the line, or a part of it, that occurs once.
        new: instead.
    """

    name: str
    file: str
    old: str
    new: str


FAULTS: Final = (
    Fault(
        "threshold of a contact", "core/detect/contact.py",
        "if score <= 1.0:", "if score <= 1.02:",
    ),
    Fault(
        "calm ticks to rearm", "core/detect/contact.py",
        "REARM_TICKS: Final = 4", "REARM_TICKS: Final = 5",
    ),
    Fault(
        "sign of the onset's share", "core/detect/contact.py",
        "min(max(-along / power, 0.0)", "min(max(along / power, 0.0)",
    ),
    Fault(
        "a window that is not there yet", "core/detect/contact.py",
        "if width + 1 > leg.usable:", "if width > leg.usable:",
    ),
    Fault(
        "the first tick of a swing is not predicted", "core/detect/detector.py",
        "            if leg.ticks:", "            if leg.ticks > 4:",
    ),
    Fault(
        "ticks before an onset", "core/detect/contact.py",
        "GUARD_TICKS: Final = 3", "GUARD_TICKS: Final = 2",
    ),
    Fault(
        "ticks at the end of a swing", "core/detect/swing_labels.py",
        "LAST_TICKS: Final = 6", "LAST_TICKS: Final = 5",
    ),
    Fault(
        "ticks around a hole", "core/detect/swing_labels.py",
        "HOLE_TICKS: Final = 8", "HOLE_TICKS: Final = 0",
    ),
    Fault(
        "a push from the ground", "core/detect/swing_labels.py",
        "PUSHED_SIGMA: Final = 1.0", "PUSHED_SIGMA: Final = 1.2",
    ),
    Fault(
        "forgetting", "core/learn/rls.py",
        "(forgetting * (1.0 + weight * m))", "(1.0 + weight * m)",
    ),
    Fault(
        "lifts in doubt before a change", "core/learn/drift.py",
        "SUSPICIONS: Final = 2", "SUSPICIONS: Final = 3",
    ),
    Fault(
        "lifts until settled", "core/learn/drift.py",
        "SETTLED_SWINGS: Final = 3", "SETTLED_SWINGS: Final = 4",
    ),
    Fault(
        "lifts far off that are a hold", "core/learn/drift.py",
        "FAR_LEVEL: Final = 100.0", "FAR_LEVEL: Final = 120.0",
    ),
    Fault(
        "ticks until a refit takes effect", "core/learn/periodic_refit.py",
        "REFIT_DUE_TICKS: Final = 50", "REFIT_DUE_TICKS: Final = 51",
    ),
    Fault(
        "gain that a refit needs", "fit/refit_job.py",
        "LEAST_GAIN: Final = 40.0", "LEAST_GAIN: Final = 4000.0",
    ),
    Fault(
        "segment that a buffer gives up", "core/learn/replay_buffer.py",
        "cells[s.cell] == most", "cells[s.cell] <= most",
    ),
    Fault(
        "reason of a refusal", "core/detect/stream.py",
        "return self._refuse(sample, Reject.DUPLICATE_SEQ)",
        "return self._refuse(sample, Reject.TIME_BACKWARDS)",
    ),
    Fault(
        "samples until a publisher takes back", "core/detect/stream.py",
        "TAKE_BACK_SAMPLES: Final = 25", "TAKE_BACK_SAMPLES: Final = 24",
    ),
    Fault(
        "a rate that is off", "core/detect/source.py",
        "MOST_OFF: Final = 0.10", "MOST_OFF: Final = 0.30",
    ),
    Fault(
        "what a substitute is worth", "core/detect/history.py",
        "UNSURE_VARIANCE: Final = 2.5", "UNSURE_VARIANCE: Final = 2.4",
    ),
    Fault(
        "a foot that is held", "core/detect/swing.py",
        "LIFTED_M: Final = 0.006", "LIFTED_M: Final = 0.012",
    ),
    Fault(
        "seed of when legs refit", "core/learn/periodic_refit.py",
        "SPREAD * zlib.crc32(leg.encode())", "SPREAD * zlib.crc32(leg.encode()[:1])",
    ),
    Fault(
        "swings until a leg is known", "core/learn/active_model.py",
        "KNOWN_SWINGS: Final = 10", "KNOWN_SWINGS: Final = 11",
    ),
    Fault(
        "first lifts of an unfit baseline", "core/learn/drift.py",
        "UNFIT_LIFTS: Final = 3", "UNFIT_LIFTS: Final = 4",
    ),
    Fault(
        "counts over a restart", "core/leg_learner.py",
        'self._guard.restore(saved.get("stream"), saved.get("missed"))', "pass",
    ),
    Fault(
        "a foot that moved before it touched", "core/detect/contact.py",
        "leg.fits |= fit >= MIN_LIFT_ROWS and", "leg.fits |= fit > 99 and",
    ),
)  # fmt: skip
