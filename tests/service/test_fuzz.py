"""A little of `make fuzz`, and that it gets where it is meant to."""

from __future__ import annotations

import fuzz


def test_ten_thousand_broken_payloads_are_all_handled() -> None:
    found = fuzz.fuzz(10_000, 1, lambda line: None)
    # Of eight seeds, 132 to 930: a made-up run or number shuts out what comes after it.
    assert found["accepted"] > 100, "a good share gets through all checks"
    for reason in ("malformed", "wrong_type", "missing_field", "version"):
        assert found[reason] > 0
    for reason in ("out_of_range", "not_finite", "wrong_joints", "duplicate_seq", "time_backwards"):
        assert found[f"sample {reason}"] > 0
