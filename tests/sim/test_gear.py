from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact_sim.elements import N_SERVOS

from .bench import Bench, every, make_bench, set_const


def with_play(backlash_rad: float | list[float], **more: float) -> Bench:
    bench = make_bench(**more)
    bench.gears.set_backlash(np.broadcast_to(backlash_rad, N_SERVOS).copy())
    set_const(bench.model)
    return bench


@pytest.mark.parametrize("backlash", [0.004, 0.017, 0.05])
def test_lost_motion_is_the_play(backlash: float) -> None:
    """Hysteresis: turned forth and back quasi-statically, the link lags the rotor by the play."""
    bench, gap = with_play(backlash), []
    for goals in (np.linspace(0.0, 0.3, 1500), np.linspace(0.3, 0.0, 1500)):
        # A steady slow ramp, long after the reversal: teeth rest on one flank.
        for goal in goals:
            bench.servos.write_goal(every(goal))
            bench.step()
        gap.append(bench.gears.rotor_angle[0] - bench.data.qpos[0])
    # On top of the play, the teeth bend a little under the link's own friction.
    assert backlash < gap[0] - gap[1] < backlash + 0.003


@pytest.mark.parametrize("backlash", [0.001, 0.01, 0.07])
@pytest.mark.parametrize("inertia", [3e-4, 3e-3])
def test_stable_when_driven_hard(backlash: float, inertia: float) -> None:
    rng = np.random.default_rng(0)
    bench = with_play(backlash, inertia_kgm2=inertia)
    for _ in range(100):
        bench.servos.write_goal(rng.uniform(-1.0, 1.0, 18))
        for _ in range(20):
            bench.step()
        assert np.abs(bench.data.qvel).max() < 15.0
        gap = np.abs(bench.gears.rotor_angle - bench.data.qpos)
        assert gap.max() < backlash / 2 + 0.05


def test_play_comes_and_goes_without_a_jump() -> None:
    bench = make_bench()
    before = bench.model.dof_armature.copy(), bench.model.dof_damping.copy()
    bench.servos.write_goal(every(0.8))
    for joints, steps in (([], 50), ([3, 7], 250), ([], 300)):
        play = every(0.0)
        play[joints] = 0.02
        assert bench.gears.set_backlash(play) is (steps > 50)
        set_const(bench.model)
        assert np.flatnonzero(bench.model.dof_armature < 1e-3).tolist() == joints
        for _ in range(steps):
            bench.step()
            assert np.abs(bench.data.qvel).max() < 8.0
    np.testing.assert_array_equal((bench.model.dof_armature, bench.model.dof_damping), before)
    assert np.abs(bench.data.qpos - 0.8).max() < 0.02
