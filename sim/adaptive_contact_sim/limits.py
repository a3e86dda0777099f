"""Checks of settings: one of several words, a number within bounds; what is not is one line."""

from __future__ import annotations

from collections.abc import Iterable

from adaptive_contact.errors import ConfigurationError


def check_word(what: str, word: str, known: Iterable[str]) -> None:
    """Refuse a word that is none of those known.

    Raises:
        ConfigurationError: with those that are.
    """
    words = list(known)
    if word not in words:
        raise ConfigurationError(f"no {what} '{word}'; expected one of {', '.join(words)}")


def check_number(what: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Refuse a number that lies outside of its bounds; NaN lies outside of any.

    Raises:
        ConfigurationError: with the bounds.
    """
    if not low <= value <= high:
        of = f" {unit}" if unit else ""
        raise ConfigurationError(f"{what} is {value:g}{of}; expected {low:g} to {high:g}{of}")
