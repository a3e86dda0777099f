r"""Makes text from the wire or from files safe to show.

A key, a note or an encoding may hold any character.  Terminals obey C0 and C1 control characters,
and readers are misled by marks that change the direction of writing.  All of them are shown as
``\uXXXX``, which is also their form inside JSON.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Iterable
from typing import Final

# C0, DEL and C1; the soft hyphen and characters of no width, which hide text; marks of direction
# (Unicode TR36); line and paragraph separators; halves of surrogate pairs.
_OTHER: Final = (
    "\x7f-\x9f\xad\u061c\u180e\u200b-\u200f\u2028-\u202e"
    "\u2060-\u2069\ufeff\ufff9-\ufffb\ud800-\udfff"
)
_COMPARED: Final = 100  # characters of names, and names, that are compared with a misspelt one
_UNSAFE: Final = re.compile(f"[\x00-\x1f{_OTHER}]")
_UNSAFE_BUT_LINES: Final = re.compile(f"[\x00-\x09\x0b-\x1f{_OTHER}]")


def printable(value: object) -> str:
    r"""Return a value's text on one line, each control character as ``\uXXXX``."""
    return _UNSAFE.sub(_escaped, str(value))


def printable_lines(text: str) -> str:
    r"""Return text with its line feeds kept, each other control character as ``\uXXXX``.

    For text whose lines this program made; a value of the wire goes through :func:`printable`.
    """
    return _UNSAFE_BUT_LINES.sub(_escaped, text)


def did_you_mean(name: str, known: Iterable[str], otherwise: str, cutoff: float = 0.6) -> str:
    """Hint at the known name nearest to one that is none of them.

    Args:
        name: that was given.
        known: those that there are.
        otherwise: what to say where none is near.
        cutoff: least likeness, 0 to 1.
    """
    # The comparison takes the product of both lengths.
    short = (one for one in known if len(one) <= _COMPARED)
    plain = {one.casefold(): one for one in itertools.islice(short, _COMPARED)}
    near = difflib.get_close_matches(name[:_COMPARED].casefold(), plain, n=1, cutoff=cutoff)
    return f"did you mean '{plain[near[0]]}'?" if near else otherwise


def printable_json(text: bytes | str) -> str:
    """Return JSON of the same value that a terminal can show: it has no raw control character."""
    return printable_lines(text if isinstance(text, str) else text.decode())


def _escaped(match: re.Match[str]) -> str:
    return f"\\u{ord(match.group()):04x}"
