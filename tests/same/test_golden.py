"""What the learners make of golden recordings: events, statuses, and the score of every tick."""

from __future__ import annotations

import pytest

from .golden import RECORDINGS, compared


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_golden_recording_is_replayed_as_expected(name: str) -> None:
    of = compared(name)
    assert of.same, (
        f"'{name}', {of.first}; {of.flips} decisions and {len(of.differences)} values differ: "
        "if that is intended, run `make golden` in a commit of its own (docs/architecture.md)"
    )
