from __future__ import annotations

import numpy as np
import pytest

from .bench import every, make_bench, set_const


def _play(backlash_rad: float, load_nm: float = 0.0):
    bench = make_bench(load_nm=load_nm)
    if bench.gears.set_backlash(every(backlash_rad)):
        set_const(bench.model)
    return bench


@pytest.mark.parametrize("backlash", [0.004, 0.017, 0.05])
def test_lost_motion_is_the_play(backlash: float) -> None:
    """Hysteresis: turned forth and back quasi-statically, the link lags the rotor by the play."""
    bench = _play(backlash, load_nm=0.0)
    gap = {}
    for name, rate in (("forth", 1.0), ("back", -1.0)):
        # A steady slow ramp, long after the reversal: teeth rest on one flank.
        for k in range(1500):
            bench.servos.write_goal(every(0.3 * rate * k / 1500.0 + (0.3 if rate < 0 else 0.0)))
            bench.step()
        gap[name] = bench.gears.rotor_angle[0] - bench.data.qpos[0]
    lost = gap["forth"] - gap["back"]
    # On top of the play, the teeth bend a little under the link's own friction.
    assert backlash < lost < backlash + 0.003


@pytest.mark.parametrize("backlash", [0.001, 0.01, 0.07])
@pytest.mark.parametrize("inertia", [3e-4, 3e-3])
def test_stable_when_driven_hard(backlash: float, inertia: float) -> None:
    rng = np.random.default_rng(0)
    bench = make_bench(inertia_kgm2=inertia)
    bench.gears.set_backlash(every(backlash))
    set_const(bench.model)
    for _ in range(100):
        bench.servos.write_goal(rng.uniform(-1.0, 1.0, 18))
        for _ in range(20):
            bench.step()
        assert np.abs(bench.data.qvel).max() < 15.0
        gap = np.abs(bench.gears.rotor_angle - bench.data.qpos)
        assert gap.max() < backlash / 2 + 0.05


def test_play_comes_and_goes_without_a_jump() -> None:
    bench = make_bench()
    armature = bench.model.dof_armature.copy()
    damping = bench.model.dof_damping.copy()
    bench.servos.write_goal(every(0.8))
    for k in range(600):
        if k == 50:
            some = every(0.0)
            some[[3, 7]] = 0.02
            assert bench.gears.set_backlash(some)
            set_const(bench.model)
            assert np.flatnonzero(bench.model.dof_armature < 1e-3).tolist() == [3, 7]
        if k == 300:
            assert bench.gears.set_backlash(every(0.0))
            set_const(bench.model)
        bench.step()
        assert np.abs(bench.data.qvel).max() < 8.0
    assert np.array_equal(bench.model.dof_armature, armature)
    assert np.array_equal(bench.model.dof_damping, damping)
    assert np.abs(bench.data.qpos - 0.8).max() < 0.02
