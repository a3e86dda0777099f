"""What the learners make of golden recordings: events, statuses, and the score of every tick."""

from __future__ import annotations

import pytest

from .golden import RECORDINGS, compared
from .mutants import constants, faults


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_golden_recording_is_replayed_as_expected(name: str) -> None:
    of = compared(name)
    assert of.same, (
        f"'{name}', {of.first}; {of.flips} decisions and {len(of.differences)} values differ: "
        "if that is intended, run `make golden` in a commit of its own (docs/architecture.md)"
    )


def test_faults_and_constants_can_be_changed_in_this_tree() -> None:
    """What notices them takes an hour: ``make same-faults``, ``make golden-constants``."""
    pairs = [mutant for pair in constants() for mutant in pair]
    for mutant in [*faults(), *pairs]:
        compile(mutant.text, mutant.file, "exec")
    assert len(faults()) >= 20
    assert len(pairs) > 300
