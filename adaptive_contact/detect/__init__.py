"""From residuals to contact events: noise, statistic, tail, state machine."""

from __future__ import annotations

from adaptive_contact.detect.events import ContactState, Decision, onset_fraction
from adaptive_contact.detect.noise import (
    WINDOWS,
    NoiseModel,
    context,
    context_of,
    fit_noise,
    lagged,
)
from adaptive_contact.detect.statistic import Statistic, statistic, stream_statistic, whitened
from adaptive_contact.detect.tail import Tail, fit_tail

__all__ = [
    "WINDOWS",
    "ContactState",
    "Decision",
    "NoiseModel",
    "Statistic",
    "Tail",
    "context",
    "context_of",
    "fit_noise",
    "fit_tail",
    "lagged",
    "onset_fraction",
    "statistic",
    "stream_statistic",
    "whitened",
]
