"""From residuals to contact events: noise, statistic, tail, state machine."""

from __future__ import annotations

from adaptive_contact.detect.events import ContactState, Decision, onset_fraction
from adaptive_contact.detect.noise import NoiseModel, context, context_of, fit_noise, lagged
from adaptive_contact.detect.statistic import (
    Statistic,
    history_statistic,
    statistic,
    stream_statistic,
)
from adaptive_contact.detect.tail import Tail, fit_tail

__all__ = [
    "ContactState",
    "Decision",
    "NoiseModel",
    "Statistic",
    "Tail",
    "context",
    "context_of",
    "fit_noise",
    "fit_tail",
    "history_statistic",
    "lagged",
    "onset_fraction",
    "statistic",
    "stream_statistic",
]
