"""Free motion of a real arm: what is fast, or moves only now and then, is no touch."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.robot import parse_robot
from real_logs import DATA, load_logs

REAL = DATA / "so101"
MOTIONS = 8
QUANTUM = 0.001534
ARM = """
[robot]
name = "arm"
period_s = 0.02
quantum_rad = 0.001534
[[leg]]
id = "arm"
joints = ["pan", "lift", "elbow"]
"""


@pytest.mark.skipif(
    not REAL.is_dir(),
    reason="no ../shared/data/so101: recordings of github.com/isaac-sim2real/sage, not part of "
    "the project",
)
def test_most_of_a_real_arms_free_ticks_are_learned() -> None:
    """A noise read off those that stand still had left out all that moved."""
    stretches = []
    moving = 0
    for motion in load_logs(REAL)[:MOTIONS]:
        measured, desired = motion.measured[:, :3], motion.desired[:, :3]
        swing = np.arange(len(measured)) % 30 < 25
        sound = np.ones(len(measured), dtype=bool)
        stretches.append(Stretch(measured, desired, swing, swing, sound, certain=False))
        steps = np.abs(np.diff(measured, axis=0)).max(axis=1) / QUANTUM
        moving += int(np.count_nonzero(steps[swing[1:]] > 2.0))
    figures = learn(parse_robot(ARM, source="arm"), {"arm": stretches}, origin="test").figures[
        "arm"
    ]
    total = figures.rows + figures.outliers
    assert moving > 0.5 * total
    assert figures.outliers < 0.2 * total
    assert figures.touched < 0.05 * figures.swings
    # Of no motion: the model is one of the moving ticks, too.
    assert (np.array(figures.held_out_rms) < 0.4 * np.array(figures.naive_rms)).all()
