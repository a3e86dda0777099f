"""Hours of walking, in short: stages follow each other, and their figures are their own."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip(
    "pybullet", reason="pybullet is not installed: it has wheels for Python 3.11 on x86-64 only"
)

from adaptive_contact_studies.hours import WALKS, Stage, Walk, followed, table
from adaptive_contact_studies.work import Work


@pytest.mark.parametrize(
    ("robot", "drift"), [("hexapod", "friction:value=2.5@0s"), ("bullet-hexapod", "friction")]
)
def test_a_walk_goes_on_over_its_stages(robot: str, drift: str, tmp_path: Path) -> None:
    stages = (Stage(robot, "tripod", 20.0), Stage(robot, "ripple", 20.0, (drift,)))
    walk = Walk(robot, stages)
    first, second = parts = followed(Work(), walk).parts
    assert min(first.touches, second.touches) > 40
    assert second.found > 0.9 * second.touches  # as what was learned in the first stage is kept
    assert first.found < second.found * first.touches / second.touches
    kept = Work(tmp_path)
    kept.one(followed, walk._replace(stages=stages[:1]))  # and is interrupted
    again = kept.one(followed, walk).parts
    assert [part[:3] for part in again] == [part[:3] for part in parts]
    assert table([walk], [parts]).splitlines()[-1].startswith(f"| {robot} | ")


def test_an_hour_is_counted_by_sixths() -> None:
    walk = WALKS[0]._replace(stages=(WALKS[0].stages[0]._replace(seconds=30.0),))
    parts = followed(Work(), walk).parts
    assert len(parts) == 6
    assert all(part.found <= part.touches for part in parts)
