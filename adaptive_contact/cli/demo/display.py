"""What is seen while the demo runs: a live table, or plain lines where there is no terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, Self

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from adaptive_contact.cli.demo.settings import DemoSettings, drift_words
from adaptive_contact.service.watch_table import table

if TYPE_CHECKING:
    from adaptive_contact.service.watch import LegView, View

# Between two plain lines, s of simulated time.
_LINE_EVERY_S: Final = 5.0


class Display(Protocol):
    """Shows a run; a context manager."""

    def __enter__(self) -> Self:
        """Begin."""

    def __exit__(self, *_: object) -> None:
        """Leave the last picture standing."""

    def show(self, view: View, walked_s: float, *, drifted: bool) -> None:
        """Show what is known after so many seconds of walking."""

    def say(self, line: str) -> None:
        """Print a line that stays."""


def display(console: Console, settings: DemoSettings) -> Display:
    """The display for a console."""
    if console.is_terminal:
        return _LiveTable(console, settings)
    return _PlainLines(console, settings)


class _LiveTable:
    """The table of ``adaptive-contact watch``, with a line on what is going on."""

    def __init__(self, console: Console, settings: DemoSettings) -> None:
        self._settings = settings
        self._live = Live(console=console, auto_refresh=False)

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def show(self, view: View, walked_s: float, *, drifted: bool) -> None:
        """Redraw."""
        words = _headline(self._settings, walked_s, drifted=drifted)
        line = Text(words, style="bold yellow" if drifted else "bold")
        size = self._live.console.size
        below = table(view, size.width, size.height - 3)
        self._live.update(Group(line, Text(), below), refresh=True)

    def say(self, line: str) -> None:
        """Print above the table."""
        self._live.console.print(line, markup=False, highlight=False)


class _PlainLines:
    """A line every few seconds."""

    def __init__(self, console: Console, settings: DemoSettings) -> None:
        self._console = console
        self._settings = settings
        self._next_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return

    def show(self, view: View, walked_s: float, *, drifted: bool) -> None:
        """Print a line, if one is due."""
        if walked_s < self._next_s or not view.legs:
            return
        self._next_s += _LINE_EVERY_S
        drifting = self._settings.leg
        others = [leg for leg in view.legs if leg.leg != drifting]
        own = [leg for leg in view.legs if leg.leg == drifting]
        name = f"{drifting} (drifted)" if drifted else drifting
        self.say(f"{walked_s:4.0f} s   {name}: {_tally(own)}   others: {_tally(others)}")

    def say(self, line: str) -> None:
        """Print a line."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        self._console.file.flush()


def _headline(settings: DemoSettings, walked_s: float, *, drifted: bool) -> str:
    words = f"{walked_s:4.0f} of {settings.seconds:.0f} s   "
    what = f"leg {settings.leg}: {drift_words(settings)}"
    if drifted:
        return f"{words}{what}, since {settings.drift_at_s:.0f} s"
    return f"{words}walking on rough ground; at {settings.drift_at_s:.0f} s {what}"


def _tally(legs: list[LegView]) -> str:
    """Touches, false alarms and models of some legs."""
    seen, touches = sum(leg.seen or 0 for leg in legs), sum(leg.touches or 0 for leg in legs)
    latencies = [leg.latency_ms for leg in legs if leg.latency_ms is not None]
    last = f" (the last after {latencies[-1]:.0f} ms)" if latencies else ""
    alarms = sum(leg.false_alarms or 0 for leg in legs)
    versions = sorted({leg.model_version for leg in legs if leg.model_version is not None})
    statuses = sorted({leg.status for leg in legs if leg.status is not None})
    model = "/".join(f"v{version}" for version in versions) or "-"
    return (
        f"{seen} of {touches} touches seen{last}, {alarms} false, "
        f"model {model} {'/'.join(statuses)}"
    )
