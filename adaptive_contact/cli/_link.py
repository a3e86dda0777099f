"""Opens the link of a command that runs until Ctrl-C, and gives the command priority."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import typer

from adaptive_contact.cli._output import print_note, print_waiting
from adaptive_contact.errors import LinkError
from adaptive_contact.priority import raise_priority
from adaptive_contact.service.settings import Finding, LinkSettings

if TYPE_CHECKING:
    from adaptive_contact.service.link import Link


def open_link(
    settings: LinkSettings,
    stop: threading.Event,
    *,
    on_wait: Callable[[Finding], None] = print_waiting,
    patience_s: float = math.inf,
) -> Link:
    """Join a router, or listen as one.

    Raises:
        LinkError: it cannot be.
        typer.Exit: ``stop`` was set while there was none to join.
    """
    from adaptive_contact.service.link import Link

    try:
        return Link.open(settings, on_wait=on_wait, stop=stop, patience_s=patience_s)
    except LinkError:
        if stop.is_set():
            raise typer.Exit from None
        raise


@contextlib.contextmanager
def unless_stopped(stop: threading.Event) -> Iterator[None]:
    """Wrap work on links: once ``stop`` is set, a router that is not there is no failure."""
    try:
        yield
    except LinkError:
        if not stop.is_set():
            raise


def enable_realtime(wanted: bool, below: int = 0) -> None:
    """Run before all ordinary processes where that is wanted; print why where it is not allowed.

    Args:
        wanted: by ``--realtime``.
        below: by how much to stand back behind others that call this.
    """
    refused = raise_priority(below) if wanted else None
    if refused is not None:
        print_note(refused)
