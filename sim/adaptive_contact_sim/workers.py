"""Processes that work for another one."""

from __future__ import annotations

import os
import threading
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess

__all__ = ["leave_with_parent"]


def leave_with_parent() -> None:
    """In a worker: end when the parent does, however it ends; a killed one would leave it behind.

    What is being written is written under another name first, so that nothing half is left.
    """
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()


def _leave_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)
