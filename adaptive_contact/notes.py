"""Defines the words by which programs recognise what a learner's note is about."""

from __future__ import annotations

from typing import Final

# Of findings on how angles are counted.
WRONG_WAY: Final = "grow the wrong way"
IN_ORDER: Final = "do not come in the order of robot.toml"
ZEROS: Final = "zeros are not where robot.toml says"
SWAPPED: Final = "the samples are those of leg"


def speaks_of_angles(note: str) -> bool:
    """Return whether a leg's note is the message of a finding on its angles."""
    return any(words in note for words in (WRONG_WAY, IN_ORDER, ZEROS))
