"""Progress of long work: a bar on a terminal, now and then a line elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

# Between two lines where there is no terminal.
_LINE_S: Final = 20.0


class Advance(Protocol):
    """Takes how much more was done, and perhaps what of it is worth a word."""

    def __call__(self, amount: float, note: str = "") -> None:
        """Move the bar on."""


@contextmanager
def progress(console: Console, what: str, total: float) -> Iterator[Advance]:
    """Show how far some work is, and in the end how long it took."""
    start = last = time.monotonic()
    done = 0.0
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} % {task.fields[note]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )
    with bar:
        task = bar.add_task(what, total=total, note="")

        def advance(amount: float, note: str = "") -> None:
            nonlocal done, last
            done += amount
            bar.update(task, advance=amount, note=note)
            now = time.monotonic()
            if bar.disable and done > 0.0 and now - last > _LINE_S:
                last, minutes = now, (now - start) / 60
                left = minutes * (total / done - 1.0)
                share = f"{100 * done / total:.0f} % in {minutes:.0f} min"
                console.print(f"{what}: {share}, about {left:.0f} to go", highlight=False)

        yield advance
    console.print(f"{what}: {time.monotonic() - start:.0f} s", highlight=False)
