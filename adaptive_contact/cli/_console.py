"""Prints tables; text of the wire and of files is shown, never interpreted."""

from __future__ import annotations

import os
from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markdown import Markdown
from rich.segment import Segment

from adaptive_contact.printable import printable_lines


class _Shown(Console):
    """Shows control characters of whatever is printed; rich's own are no text."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(printable_lines(segment.text), segment.style)


def table_console(*, stderr: bool = False, pipe_width: int = 120) -> Console:
    """Return the console that a command prints its tables on.

    Args:
        stderr: instead of stdout.
        pipe_width: columns where the output is no terminal and ``COLUMNS`` is not set; rich would
            take 80 and cut a table to pieces.
    """
    console = _Shown(stderr=stderr, markup=False, highlight=False)
    if not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit():
        console = _Shown(stderr=stderr, markup=False, highlight=False, width=pipe_width)
    return console


def print_markdown(text: str) -> None:
    """Print Markdown with its tables; as it is where the output is no terminal."""
    console = table_console()
    console.print(Markdown(text) if console.is_terminal else text, soft_wrap=True)
