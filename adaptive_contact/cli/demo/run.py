"""The demo from beginning to end."""

from __future__ import annotations

import threading
import time

from rich.console import Console

from adaptive_contact.cli._compiling import compile_tick
from adaptive_contact.cli.demo.conduct import Display, StoppedError, conduct
from adaptive_contact.cli.demo.settings import DemoSettings
from adaptive_contact.cli.demo.summary import as_table, figures, write_summary
from adaptive_contact.cli.demo.verdict import Verdict, judge
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.web import LivePage
from adaptive_contact_studies.show.figures import needs_matplotlib


def run_demo(
    settings: DemoSettings, console: Console, stop: threading.Event, page: LivePage | None = None
) -> Verdict:
    """Walk, drift, judge, report.

    Raises:
        StoppedError: ``stop`` was set.
        MissingExtraError: matplotlib is not installed; said before anything is started.
        AdaptiveContactError: in one line, what went wrong.
    """
    needs_matplotlib("the demo's report", "plot")
    from adaptive_contact.cli.demo.report import draw

    _make(settings)
    began_s = time.monotonic()
    # Here and not in the service, whose start has a time limit: it takes minutes on a busy machine.
    compile_tick(stop)
    if stop.is_set():
        raise StoppedError
    robot = settings.simulated.description
    take = conduct(settings, robot, Display(console, settings), stop, page)
    verdict = judge(settings.recording, robot, take.drift_ns, settings.leg)
    if stop.is_set():
        raise StoppedError
    write_summary(settings.summary, figures(settings, take, verdict))
    draw(settings.report, settings, verdict)
    console.print()
    console.print(as_table(settings, verdict))
    for path in (settings.report, settings.summary, settings.recording):
        console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"{time.monotonic() - began_s:.0f} s in all", highlight=False)
    return verdict


def _make(settings: DemoSettings) -> None:
    """The folder, without what an earlier run left there."""
    try:
        settings.out.mkdir(parents=True, exist_ok=True)
        for path in (settings.recording, settings.summary, settings.report):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{settings.out}: cannot be used ({error.strerror}); give --out a folder that can be "
            "written"
        ) from error
