"""The shortest soak that breaks everything, through real processes."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from adaptive_contact.robot import shipped_robot

from . import SoakPlan, conduct, judge
from .memory import CURVE_S


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_minute_is_broken_three_times_and_accounted_for(tmp_path: Path) -> None:
    """What depends on how busy the machine is (missed touches, lateness) is not asked for."""
    robot, plan, said = shipped_robot(), SoakPlan(tmp_path, minutes=1.0), []
    take = conduct(plan, said.append, threading.Event())

    assert [one.kind for one in take.broken] == ["router", "service", "router"]
    assert all(one.from_ns < one.to_ns for one in take.broken)
    assert len({status.instance for _, status in take.heard.services}) == 2
    assert {one.life for one in take.resident} == {0, 1}
    assert len(said) >= 4
    assert take.simulator

    found = judge(take, plan, robot)
    assert found.samples == 60 * 50 * len(robot.leg_ids)
    assert (found.uncounted, found.inconsistent) == (0, 0)
    assert set(found.rejects) <= {"overflow"}, "a machine too busy to keep up says so, no more"
    assert found.missed_samples > 0, "two routers were gone"
    # The service was killed without a word: what it goes on with is a save from before.
    assert sorted(found.state["restored"]) == sorted(robot.leg_ids)
    assert (found.state["refused"], found.state["failed"]) == ([], 0)
    assert found.state["saved"] >= len(robot.leg_ids)
    (lost_s,) = found.forgotten_s
    assert lost_s < 13.0
    assert found.left_behind == 0
    assert (found.events_lost, found.cut_off) == (0, 0)
    assert found.releases > 100
    assert found.arrivals.events > 200
    assert len(found.memory_curve) == 2
    assert all(len(curve) >= 10.0 / CURVE_S for curve in found.memory_curve)
