"""Compiles the tick before a command needs it, and says so where it takes time."""

from __future__ import annotations

import sys

__all__ = ["compile_tick"]


def compile_tick() -> None:
    """Load the compiled tick; the first start after an installation compiles it, and says so."""
    from adaptive_contact.compiled import cache_folder, is_cached
    from adaptive_contact.detect.batch import compile_ahead

    if not is_cached():
        kept = (
            "once" if cache_folder() else "at each start, as no folder could be had to keep it in"
        )
        print(
            f"adaptive-contact: compiling the arithmetic of a tick for this computer, {kept} "
            "(10 to 20 s)",
            file=sys.stderr,
            flush=True,
        )
    compile_ahead()
