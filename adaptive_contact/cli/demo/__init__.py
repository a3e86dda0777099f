"""``adaptive-contact demo``: the whole thing in a minute.

:func:`~adaptive_contact.cli.demo.run.run_demo` starts ``adaptive-contact serve`` and
``adaptive-contact sim walk`` as processes, injects the drift with a third, and judges what was
recorded: a walk watched by the service, a drift in the middle, a report at the end.
"""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Annotated, Final

import typer

from adaptive_contact.cli._options import (
    ForceOption,
    flatten,
    option,
    refuse_to_replace,
    seconds_option,
)
from adaptive_contact.cli._output import say_note
from adaptive_contact.cli._sim_options import given, needs_simulator
from adaptive_contact.cli._web import WEB_PANEL, Page, live_page
from adaptive_contact.errors import AdaptiveContactError

__all__ = ["demo"]

_STOPPED = 130  # what a shell calls "ended by Ctrl-C"
_OUT: Final = Path("out/demo")


@flatten
def demo(
    *,
    out: Annotated[Path, option("--out", "Where report and figures go.", "FOLDER")] = _OUT,
    seconds: Annotated[
        float | None, seconds_option("--seconds", "Of walking, in real time. [60]")
    ] = None,
    seed: Annotated[int | None, option("--seed", "Of the walk. [0]", min=0)] = None,
    robot: Annotated[
        str | None, option("--robot", "Which walks: hexapod, quadruped12. [hexapod]", "NAME")
    ] = None,
    web: Annotated[
        bool, option("--web", "Show it as a page in the browser, too.", panel=WEB_PANEL)
    ] = False,
    force: ForceOption = False,
    page: Page,
) -> None:
    """Watch a simulated robot walk, one leg drift, and what becomes of its contacts.

    Starts `serve` and `sim walk` as two processes, injects the drift with a third, and writes a
    picture, the figures and a recording.  Those in out/demo are replaced; in another folder only
    with --force.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: _on_signal(stop))
    with needs_simulator():
        from adaptive_contact.cli.demo.conduct import StoppedError
        from adaptive_contact.cli.demo.run import run_demo
        from adaptive_contact.cli.demo.settings import DemoSettings
    from adaptive_contact.cli._console import table_console

    console = table_console()
    settings = DemoSettings(out=out, **given(seconds=seconds, seed=seed, robot=robot))
    made = (settings.report, settings.summary, settings.recording)
    refuse_to_replace(made, "--out", force=force or out == _OUT)
    page_settings = page.settings(web)
    try:
        if page_settings is None:
            run_demo(settings, console, stop)
            return
        with live_page(page_settings, browse=not page.no_browser) as live:
            live.waits_for(
                "service and simulator are starting",
                "The first start on a computer compiles the arithmetic, and takes up to a minute.",
                "note",
            )
            run_demo(settings, console, stop, live)
            live.close(f"The demo is over; {settings.report} has what was found.")
    except (StoppedError, KeyboardInterrupt, AdaptiveContactError) as ended:
        # Ctrl-C in a terminal reaches every process at once; who ends first is chance.
        if isinstance(ended, AdaptiveContactError) and not stop.is_set():
            raise
        say_note("stopped; nothing was judged")
        raise typer.Exit(_STOPPED) from None


def _on_signal(stop: threading.Event) -> None:
    """The first signal asks for an orderly end; the second breaks in, and still ends the others."""
    if stop.is_set():
        raise KeyboardInterrupt
    stop.set()
