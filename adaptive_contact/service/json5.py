"""Which settings a configuration file holds: a reader of JSON5 as far as keys go.

Zenoh reads such a file itself but fills in its own defaults, and then nobody can tell what the
file says from what it does not say.  This reader follows https://spec.json5.org: comments, trailing
commas, names without quotes, single quotes, hexadecimal and signed numbers.  Zenoh has checked the
file before, so errors here are not for a person: what cannot be read has no keys.
"""

from __future__ import annotations

import re
from typing import Final

__all__ = ["keys_of"]

_DEEPEST: Final = 64
_SPACE = re.compile(r"(?:\s|\ufeff|//[^\n\r\u2028\u2029]*|/\*.*?\*/)*", re.DOTALL)
_STRING = re.compile(r"\"(?:\\.|[^\"\\])*\"|'(?:\\.|[^'\\])*'", re.DOTALL)
# Names of keys, and numbers and words as values: all that stands without quotes.
_WORD = re.compile(r"[^\s\"'{}\[\],:/]+")
_ESCAPE = re.compile(r"\\(?:u([0-9A-Fa-f]{4})|x([0-9A-Fa-f]{2})|(.))", re.DOTALL)

_SHORT: Final = {
    "b": "\b",
    "f": "\f",
    "n": "\n",
    "r": "\r",
    "t": "\t",
    "v": "\v",
    "0": "\0",
    "\n": "",  # a line that goes on
}


class _UnreadableError(ValueError):
    """The text is no JSON5."""


def keys_of(text: str) -> frozenset[str]:
    """Paths of all settings in a JSON5 text.

    Args:
        text: whose outermost value is an object.

    Returns:
        Paths as ``scouting/multicast/enabled``, those of objects included; empty for what is no
        JSON5 object.
    """
    found: set[str] = set()
    try:
        _Reader(text, found).read()
    except _UnreadableError:
        return frozenset()
    return frozenset(found)


class _Reader:
    def __init__(self, text: str, found: set[str]) -> None:
        self._text = text
        self._at = 0
        self._found = found

    def read(self) -> None:
        self._value((), 0)
        self._peek()
        if self._at != len(self._text):
            raise _UnreadableError

    def _peek(self) -> str:
        """The next character that counts, empty at the end."""
        space = _SPACE.match(self._text, self._at)
        self._at = self._at if space is None else space.end()
        return self._text[self._at : self._at + 1]

    def _take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if match is None:
            raise _UnreadableError
        self._at = match.end()
        return match.group()

    def _value(self, path: tuple[str, ...] | None, depth: int) -> None:
        if depth > _DEEPEST:
            raise _UnreadableError
        first = self._peek()
        if first == "{":
            self._members("}", path, depth)
        elif first == "[":
            self._members("]", None, depth)
        elif first in ('"', "'"):
            self._take(_STRING)
        else:
            self._take(_WORD)

    def _members(self, end: str, path: tuple[str, ...] | None, depth: int) -> None:
        """Members of an object, or of an array, whose objects have no path."""
        self._at += 1
        while (first := self._peek()) != end:
            inner: tuple[str, ...] | None = None
            if end == "}":
                key = self._key(first)
                if path is not None:
                    inner = (*path, key)
                    self._found.add("/".join(inner))
                if self._peek() != ":":
                    raise _UnreadableError
                self._at += 1
            self._value(inner, depth + 1)
            if self._peek() == ",":
                self._at += 1
            elif self._peek() != end:
                raise _UnreadableError
        self._at += 1

    def _key(self, first: str) -> str:
        if first not in ('"', "'"):
            return self._take(_WORD)
        return _ESCAPE.sub(_unescape, self._take(_STRING)[1:-1])


def _unescape(match: re.Match[str]) -> str:
    code = match[1] or match[2]
    return chr(int(code, 16)) if code else _SHORT.get(match[3], match[3])
