"""Defines ``adaptive-contact watch``: a live table of a running service."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Final

from rich.console import Group
from rich.live import Live

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._link import open_link
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import say_json
from adaptive_contact.cli._web import WEB_PANEL, Page, serve_page
from adaptive_contact.errors import ConfigurationError

if TYPE_CHECKING:
    from adaptive_contact.service.watch import View

    Look = Callable[[], View]

_REFRESH_S: Final = 0.15  # a leg that is not known shows as such within 0.7 s


@opt.flatten
def watch(
    *,
    network: opt.Network,
    once: Annotated[bool, option("--once", "Look for a while, print one table and end.")] = False,
    seconds: Annotated[
        float,
        seconds_option(
            "--seconds",
            "How long --once looks; otherwise how often --json, or a pipe, gets its lines.",
            least=0.1,
            most=3600.0,
        ),
    ] = 2.0,
    wait: Annotated[
        float,
        seconds_option(
            "--wait", "How long --once waits for a router before it gives up.", most=3600.0
        ),
    ] = 10.0,
    json: opt.JsonOption = False,
    web: Annotated[
        bool, option("--web", "Show it as a page in the browser.", panel=WEB_PANEL)
    ] = False,
    page: Page,
) -> None:
    """Show every leg of a running service: contact, model, latency, losses, and what is wrong."""
    page_settings = page.settings(web)
    if page_settings is not None and (once or json):
        raise ConfigurationError("--web shows a page; leave --once and --json out")
    settings = network.client()
    if page_settings is not None:
        serve_page(page_settings, settings, browse=not page.no_browser)
        return
    stop = opt.stoppable()
    from adaptive_contact.service.watch import Feed

    # A script that looks once is not to stand still where there is no router.
    patience_s = wait if once else math.inf
    link = open_link(settings, stop, patience_s=patience_s)
    if link is None:
        return
    with link:
        feed = Feed(link, states=True)

        def look() -> View:
            return feed.view(time.monotonic_ns())

        if not once and not json and sys.stdout.isatty():
            _live(look, stop)
            return
        while not _look_for(seconds, look, stop):
            _print(look(), json)
            if once:
                break


def _look_for(seconds: float, look: Look, stop: threading.Event) -> bool:
    """Take in what arrives until the next output is due; True if stopped before."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        if stop.wait(min(left, _REFRESH_S)):
            return True
        look()
    return False


def _live(look: Look, stop: threading.Event) -> None:

    from adaptive_contact.service.watch_table import table

    console = table_console()

    def drawn() -> Group:  # the terminal may change its size
        return table(look(), console.width)

    with Live(drawn(), console=console, auto_refresh=False) as live:
        while not stop.wait(_REFRESH_S):
            live.update(drawn(), refresh=True)


def _print(view: View, json: bool) -> None:
    if json:
        say_json(view)
        return
    from adaptive_contact.service.watch_table import table

    console = table_console(pipe_width=160)
    console.print(table(view, console.width))
