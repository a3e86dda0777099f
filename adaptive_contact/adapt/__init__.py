"""The learner: composes identification and detection, sample by sample."""

from __future__ import annotations

from adaptive_contact.adapt.bank import LearnerBank
from adaptive_contact.adapt.baseline import (
    Baseline,
    LegBaseline,
    load_baseline,
    save_baseline,
    shipped_baseline,
)
from adaptive_contact.adapt.learner import ContactLearner
from adaptive_contact.adapt.mode import LearnerMode, WhenAmbiguous
from adaptive_contact.adapt.snapshot import FORMAT as SNAPSHOT_FORMAT

__all__ = [
    "SNAPSHOT_FORMAT",
    "Baseline",
    "ContactLearner",
    "LearnerBank",
    "LearnerMode",
    "LegBaseline",
    "WhenAmbiguous",
    "load_baseline",
    "save_baseline",
    "shipped_baseline",
]
