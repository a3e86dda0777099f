"""The study of the state: its table, from a few ticks."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet", reason="extra 'bullet' is not installed")

from adaptive_contact_studies.state import Leg, table


def leg(walk: str, seed: int, *, known: bool = True) -> Leg:
    """Ticks of which the state knows a part, half of them in touch."""
    rng = np.random.default_rng(seed)
    n = 200
    truth = np.arange(n) % 40 < 20
    sums = np.where(truth, 3.0, 0.0) + rng.normal(0.0, 1.0, n)
    features = np.column_stack([np.ones(n), sums, np.abs(rng.normal(0.0, 1.0, n))])
    p = np.where(truth, 0.9, 0.1) if known else np.full(n, np.nan)
    return Leg(walk, 0.02, features, np.zeros(n), p, truth, truth, truth)


def test_each_walk_has_a_row_and_each_robot_that_hangs() -> None:
    walks = [leg("hexapod tripod rough", 1), leg("leg5 pose obstacles", 2)]
    hung = [leg("leg5 pose none", 3, known=False)]
    text = table(walks, hung)
    assert "| hexapod tripod rough | 100 % | 100.0 % |" in text
    assert "| leg5 pose none | 0.00 % | 0.0 % |" in text
