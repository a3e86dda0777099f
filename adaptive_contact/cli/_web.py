"""Adds the live page to a command: its options, its line of output, the browser."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from adaptive_contact.cli._link import open_link
from adaptive_contact.cli._options import option, stoppable
from adaptive_contact.cli._output import print_line, print_waiting
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.settings import Finding, LinkSettings

if TYPE_CHECKING:
    from adaptive_contact.web import LivePage, WebSettings

WEB_PANEL = "Live page"


@dataclasses.dataclass(frozen=True)
class Page:
    """Holds the options of the page; see :func:`~adaptive_contact.cli._options.flatten`."""

    port: Annotated[
        int | None,
        option(
            "--port",
            "Port of the page; by default a free one.",
            "N",
            min=0,
            max=65_535,
            panel=WEB_PANEL,
        ),
    ] = None
    host: Annotated[
        str | None,
        option(
            "--host",
            "Where the page listens (default 127.0.0.1). Beyond this computer, such as on "
            "0.0.0.0, the link has a token, without which nothing is shown.",
            "ADDRESS",
            panel=WEB_PANEL,
        ),
    ] = None
    no_browser: Annotated[
        bool, option("--no-browser", "Print the page's link, and open nothing.", panel=WEB_PANEL)
    ] = False
    record_to: Annotated[
        Path | None,
        option(
            "--record-to",
            "Let the page start and stop recordings, into this folder. The link has a token then.",
            "FOLDER",
            panel=WEB_PANEL,
        ),
    ] = None

    def settings(self, web: bool) -> WebSettings | None:
        """Return the settings of the page, None where none is asked for.

        Raises:
            ConfigurationError: options of the page without ``--web``.
        """
        if not web:
            if self != Page():
                raise ConfigurationError(
                    "--host, --port, --no-browser and --record-to are of the page; give --web"
                )
            return None
        from adaptive_contact.web import WebSettings

        return WebSettings(
            host=self.host or "127.0.0.1", port=self.port or 0, record_to=self.record_to
        )


@contextlib.contextmanager
def live_page(settings: WebSettings, *, browse: bool) -> Iterator[LivePage]:
    """Serve the page, say where it is, and open it."""
    from adaptive_contact.web import LivePage

    with LivePage(settings) as page:
        print_line(f"live page at {page.url}")
        if not settings.loopback:
            print_line(
                "adaptive-contact: the page goes over the network in the clear; where others "
                "listen, leave --host out and use ssh -L",
                err=True,
            )
        if browse:
            _open(page.url)
        yield page


def serve_page(settings: WebSettings, link_settings: LinkSettings, *, browse: bool) -> None:
    """Serve the page until Ctrl-C."""
    # No exception: one that strikes inside a library may be lost there.
    stop = stoppable()
    with ExitStack() as stack:
        page = stack.enter_context(live_page(settings, browse=browse))

        def waiting(finding: Finding) -> None:
            print_waiting(finding)
            page.waits_for(
                finding.line,
                "Start `adaptive-contact serve`, or give `watch` its --connect. This page goes on "
                "by itself.",
            )

        link = open_link(link_settings, stop, on_wait=waiting)
        stack.callback(link.close)
        page.show_service(link)
        stack.callback(page.close)  # before the link that it asks
        page.wait(stop)


def _open(url: str) -> None:
    """Open a browser where there is a screen; a browser in this terminal would take it over."""
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or os.environ.get("BROWSER"):
        threading.Thread(target=webbrowser.open, args=[url], daemon=True).start()
