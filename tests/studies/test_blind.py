"""Blind walking: what contact events are worth to a gait, after a drift."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from adaptive_contact.cli import _sim_compare as shown
from adaptive_contact_sim import SimulationSettings, parse_drift
from adaptive_contact_studies.blind import (
    POLICIES,
    Comparison,
    Trace,
    Walk,
    compare,
    figures,
    walked,
)
from adaptive_contact_studies.work import Work

DRIFT_S: Final = 16.0
SECONDS: Final = 48.0
SETTINGS: Final = replace(
    SimulationSettings.from_robot("hexapod", "walk"),
    drift=(parse_drift(f"friction:value=4@{DRIFT_S:g}s"),),
    seed=21,
)


def walk(policy: str, settings: SimulationSettings = SETTINGS, seconds: float = SECONDS) -> Trace:
    return walked(Work(), Walk(policy, settings, seconds))


@pytest.fixture(scope="module")
def service() -> Trace:
    return walk("service")


def test_after_a_drift_the_learned_model_keeps_the_body_level(service: Trace) -> None:
    frozen = walk("frozen")
    before = [figures(trace, 0.0, DRIFT_S) for trace in (service, frozen)]
    after = [figures(trace, DRIFT_S, SECONDS) for trace in (service, frozen)]
    assert before[0].tilt_rms_deg == pytest.approx(before[1].tilt_rms_deg, rel=0.1)
    assert after[0].tilt_rms_deg < 0.6 * after[1].tilt_rms_deg
    # Why: the model that never learns takes friction for contacts.
    assert after[0].in_air < 0.1 * after[0].swings
    assert after[1].in_air > 0.5 * after[1].swings


def test_all_ways_walk_the_same_ground_from_the_same_stand() -> None:
    found = compare(Work(), SETTINGS, 3.0, [21, 22])
    assert found.drift_s == DRIFT_S
    for seed in (0, 1):
        starts = [found.traces[policy][seed] for policy in POLICIES]
        for trace in starts[1:]:
            assert trace.position_m[0] == pytest.approx(starts[0].position_m[0], abs=1e-3)
    for policy in ("fixed", "none"):
        assert all(trace.stops.size == 0 for trace in found.traces[policy])


def test_figures_of_a_stretch() -> None:
    n, legs = 400, 2
    force = np.zeros((n, legs))
    force[103, 0], force[250, 1] = 40.0, 70.0
    trace = Trace(
        period_s=0.02,
        tilt_deg=np.where(np.arange(n) < 200, 3.0, 4.0),
        position_m=np.column_stack([np.arange(n) * 0.002, np.zeros(n)]),
        work_j=np.full(n, 0.1),
        force_n=force,
        swings=np.array([90, 240]),
        stops=np.array([104, 251]),
        in_air=np.array([251]),
        touches=np.array([[101, 0], [250, 1]]),
    )
    first, second = figures(trace, 0.0, 4.0), figures(trace, 4.0, 8.0)
    assert (first.tilt_rms_deg, second.tilt_rms_deg) == (3.0, 4.0)
    assert (first.force_median_n, second.force_median_n) == (40.0, 70.0)
    assert (first.swings, first.stopped, first.in_air, second.in_air) == (1, 1, 0, 1)
    assert first.distance_m == pytest.approx(0.3)  # of places at 0, 1, 2, 3 s
    assert first.work_j_per_m == pytest.approx(20.0 / 0.3)
    found = Comparison(4.0, 8.0, {policy: [trace, trace] for policy in POLICIES})
    assert shown.table(found).row_count == 2 * len(POLICIES)
    assert shown.picture(found).startswith(b"\x89PNG")
    rows = shown.tree(found)["policies"]["service"]["after"]
    assert rows == [second._asdict()] * 2
