"""Hours of walking, in short: stages follow each other, and their figures are their own."""

from __future__ import annotations

import pytest

pytest.importorskip(
    "pybullet", reason="pybullet is not installed: it has wheels for Python 3.11 on x86-64 only"
)

from adaptive_contact_studies.hours import WALKS, Stage, Walk, followed, table
from adaptive_contact_studies.work import Work


@pytest.mark.parametrize(
    ("robot", "drift"), [("hexapod", "friction:value=2.5@0s"), ("bullet-hexapod", "friction")]
)
def test_a_walk_goes_on_over_its_stages(robot: str, drift: str) -> None:
    stages = (Stage(robot, "tripod", 20.0), Stage(robot, "ripple", 20.0, (drift,)))
    walk = Walk(robot, stages)
    first, second = parts = followed(Work(), walk)
    assert min(first.touches, second.touches) > 40
    assert second.found > 0.9 * second.touches  # as what was learned in the first stage is kept
    assert first.found < second.found * first.touches / second.touches
    assert table([walk], [parts]).splitlines()[-1].startswith(f"| {robot} | ")


def test_an_hour_is_told_by_sixths() -> None:
    walk = WALKS[0]._replace(stages=(WALKS[0].stages[0]._replace(seconds=30.0),))
    parts = followed(Work(), walk)
    assert len(parts) == 6
    assert all(part.found <= part.touches for part in parts)
