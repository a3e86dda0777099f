"""Faults of a leg's learning, for developers: the status has a line, the log the stack."""

from __future__ import annotations

import time

import structlog

from adaptive_contact.service.meters import Brake

__all__ = ["FaultLog"]

_log = structlog.get_logger()
_PERIOD_S = 60.0


class FaultLog:
    """Logs a fault of each leg a minute, and how many came since the last one logged."""

    def __init__(self) -> None:
        self._brake = Brake(_PERIOD_S)

    def __call__(self, leg: str, fault: Exception) -> None:
        """A leg was restarted."""
        times = self._brake.passes(leg, time.monotonic_ns())
        if times is not None:
            _log.error("fault in learning, leg restarted", leg=leg, times=times, exc_info=fault)
