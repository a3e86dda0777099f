"""The demo: a walk watched by the service, a drift in the middle, a report at the end.

:func:`run_demo` starts ``adaptive-contact serve`` and ``adaptive-contact sim walk`` as processes,
injects the drift with a third, and judges what was recorded.
"""

from __future__ import annotations

from adaptive_contact_sim.demo.conduct import StoppedError
from adaptive_contact_sim.demo.run import run_demo
from adaptive_contact_sim.demo.settings import DemoSettings

__all__ = ["DemoSettings", "StoppedError", "run_demo"]
