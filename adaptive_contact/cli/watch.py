"""Defines ``adaptive-contact watch``: a live table of a running service."""

from __future__ import annotations

import math
import sys
import time
from contextlib import nullcontext
from typing import Annotated, Final

from rich.live import Live

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._link import open_link
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import print_json
from adaptive_contact.cli._web import WEB_PANEL, Page, serve_page
from adaptive_contact.errors import ConfigurationError

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
    from adaptive_contact.service.watch_table import table

    # A script that looks once is not to stand still where there is no router.
    patience_s = wait if once else math.inf
    # A table in a terminal is drawn again and again; lines are printed when they are due.
    drawn = not once and not json and sys.stdout.isatty()
    console = table_console(pipe_width=160)
    with (
        open_link(settings, stop, patience_s=patience_s) as link,
        Live(console=console, auto_refresh=False) if drawn else nullcontext() as live,
    ):
        feed, due_s = Feed(link, states=True), time.monotonic() + seconds
        while not stop.wait(min(_REFRESH_S, seconds)):
            view = feed.view(time.monotonic_ns())
            if live is not None:
                live.update(table(view, console.width), refresh=True)
            elif time.monotonic() >= due_s:
                due_s += seconds
                if json:
                    print_json(view)
                else:
                    console.print(table(view, console.width))
                if once:
                    break
