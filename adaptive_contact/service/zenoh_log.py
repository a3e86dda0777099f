"""What Zenoh logs: faults in our callbacks are counted, passwords and keys are kept out."""

from __future__ import annotations

import logging
import os

import zenoh

__all__ = ["callback_faults"]


class _CallbackFaults(logging.Handler):
    """Counts exceptions in callbacks; Zenoh logs them and goes on."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.count = 0

    def emit(self, record: logging.LogRecord) -> None:
        self.count += 1


def callback_faults() -> int:
    """Exceptions raised in callbacks of any session, since this process began."""
    return _faults.count


_faults = _CallbackFaults()
logging.getLogger("zenoh.handlers").addHandler(_faults)
if "RUST_LOG" in os.environ:
    # At debug the one part of Zenoh writes the whole configuration, passwords and all; the other
    # writes whole endpoints, in which a key may stand, with every connection that fails.
    os.environ["RUST_LOG"] += ",zenoh::api::session=info,zenoh::net::runtime::orchestrator=off"
    zenoh.try_init_log_from_env()
