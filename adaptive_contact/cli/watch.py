"""``adaptive-contact watch``: a live table of a running service."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Annotated, Final

import typer

from adaptive_contact.cli._options import (
    ConnectOption,
    JsonOption,
    NamespaceOption,
    ZenohConfigOption,
    client,
    seconds_option,
)
from adaptive_contact.cli._output import say_json, say_waiting
from adaptive_contact.cli._web import (
    WEB_PANEL,
    HostOption,
    NoBrowserOption,
    PortOption,
    serve_page,
    web_settings,
)
from adaptive_contact.errors import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Group

    from adaptive_contact.service.link import Link
    from adaptive_contact.service.settings import LinkSettings
    from adaptive_contact.service.watch import View

    Look = Callable[[], View]

__all__ = ["watch"]

_REFRESH_S: Final = 0.25
_PIPE_WIDTH: Final = 160


def watch(
    connect: ConnectOption = None,
    namespace: NamespaceOption = None,
    zenoh_config: ZenohConfigOption = None,
    once: Annotated[
        bool, typer.Option("--once", help="Look for a while, print one table and end.")
    ] = False,
    seconds: Annotated[
        float,
        seconds_option(
            "--seconds",
            least=0.1,
            most=3600.0,
            help="How long --once looks; otherwise how often --json, or a pipe, gets its lines.",
        ),
    ] = 2.0,
    wait: Annotated[
        float,
        seconds_option(
            "--wait", most=3600.0, help="How long --once waits for a router before it gives up."
        ),
    ] = 10.0,
    json: JsonOption = False,
    web: Annotated[
        bool,
        typer.Option("--web", help="Show it as a page in the browser.", rich_help_panel=WEB_PANEL),
    ] = False,
    port: PortOption = None,
    host: HostOption = None,
    no_browser: NoBrowserOption = False,
) -> None:
    """Show every leg of a running service: contact, model, latency, losses, and what is wrong."""
    page_settings = web_settings(web, host, port, no_browser)
    if page_settings is not None and (once or json):
        raise ConfigurationError("--web shows a page; leave --once and --json out")
    # As Ctrl-C, so that the terminal gets its cursor back.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    from adaptive_contact.service.feed import Feed

    settings = client(connect, namespace, zenoh_config)
    if page_settings is not None:
        serve_page(page_settings, settings, browse=not no_browser)
        return
    patience_s = wait if once else None
    with contextlib.suppress(KeyboardInterrupt), _join(settings, patience_s) as link:
        feed = Feed(link)

        def look() -> View:
            return feed.view(time.monotonic_ns())

        if not once and not json and sys.stdout.isatty():
            _live(look)
        while True:
            _look_for(seconds, look)
            _print(look(), json)
            if once:
                break


def _look_for(seconds: float, look: Look) -> None:
    """Take in what arrives until the next output is due."""
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        time.sleep(min(left, _REFRESH_S))
        look()


def _join(settings: LinkSettings, patience_s: float | None) -> Link:
    """Join a router; a script that looks once is not to stand still where there is none."""
    from adaptive_contact.service.link import Link, NoRouterError

    if patience_s is None:
        return Link.open(settings, on_wait=say_waiting)
    stop = threading.Event()
    timer = threading.Timer(patience_s, stop.set)
    timer.start()
    try:
        return Link.open(settings, on_wait=say_waiting, stop=stop)
    except NoRouterError as error:
        raise NoRouterError(error.finding, f"no router within {patience_s:g} s: ") from error
    finally:
        timer.cancel()


def _live(look: Look) -> None:
    """Redraw until Ctrl-C."""
    from rich.live import Live

    from adaptive_contact.cli._console import table_console
    from adaptive_contact.service.watch_table import table

    console = table_console()
    try:

        def drawn() -> Group:  # the terminal may change its size
            return table(look(), console.width, console.height)

        with Live(drawn(), console=console, auto_refresh=False) as live:
            while True:
                live.update(drawn(), refresh=True)
                time.sleep(_REFRESH_S)  # the period of the picture
    finally:
        console.show_cursor()  # of a stop while it begins, too


def _print(view: View, json: bool) -> None:
    if json:
        import msgspec

        say_json(msgspec.json.encode(view))
        return
    from adaptive_contact.cli._console import table_console
    from adaptive_contact.service.watch_table import table

    console = table_console(pipe_width=_PIPE_WIDTH)
    console.print(table(view, console.width))
