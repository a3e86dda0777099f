from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptive_contact_sim.elements import N_SERVOS
from adaptive_contact_sim.servo import (
    FULL_SCALE_STEPS,
    QUANTUM_RAD,
    duty,
    manufactured,
)

from .bench import every, make_bench


def scalar_duty(error: int, margin: float, slope: float, punch: float, limit: float) -> float:
    """The control law as the e-manual draws it, one number at a time."""
    if abs(error) <= margin:
        return 0.0
    rise = (abs(error) - margin) / slope
    size = punch + rise * (1.0 - punch)
    if size > limit:
        size = limit
    return size if error > 0 else -size


@given(
    st.integers(-FULL_SCALE_STEPS, FULL_SCALE_STEPS),
    st.integers(0, 5),
    st.floats(2.0, 254.0),
    st.floats(0.0, 0.2),
    st.floats(0.3, 1.0),
)
def test_duty_is_the_e_manuals(
    error: int, margin: int, slope: float, punch: float, limit: float
) -> None:
    got = duty(
        np.array([float(error)]),
        margin=np.array([float(margin)]),
        slope=np.array([slope]),
        punch=np.array([punch]),
        limit=np.array([limit]),
    )
    assert got[0] == pytest.approx(scalar_duty(error, margin, slope, punch, limit), abs=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_torque_of_the_bank_is_the_scalar_laws(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parameters = manufactured(seed % 7)
    bench = make_bench(parameters)
    servos = bench.servos
    servos.supply_v[:] = rng.uniform(9.0, 12.0, N_SERVOS)
    servos.winding_factor[:] = rng.uniform(1.0, 1.2, N_SERVOS)
    servos.compliance_factor[:] = rng.uniform(0.5, 4.0, N_SERVOS)
    servos.offset_rad[:] = rng.uniform(-0.02, 0.02, N_SERVOS)
    servos.refresh()
    bench.data.qpos[:] = rng.uniform(-1.5, 1.5, N_SERVOS)
    goal = servos.write_goal(rng.uniform(-1.5, 1.5, N_SERVOS))
    servos.drive()
    for i in range(N_SERVOS):
        position = round((bench.data.qpos[i] + servos.offset_rad[i]) / QUANTUM_RAD)
        u = scalar_duty(
            round(goal[i] / QUANTUM_RAD) - position,
            1.0,
            32.0 * servos.compliance_factor[i],
            32.0 / 1023.0,
            1.0,
        )
        expected = (
            parameters.stall_torque_nm[i]
            * (servos.supply_v[i] / 12.0)
            / servos.winding_factor[i]
            * u
        )
        assert bench.data.ctrl[i] == pytest.approx(expected, abs=1e-12)


def test_step_response_is_an_ax12s() -> None:
    bench = make_bench()
    bench.servos.write_goal(every(2.0))
    speed, angle = [], []
    for _ in range(900):
        bench.step()
        speed.append(bench.data.qvel[0])
        angle.append(bench.data.qpos[0])
    top = max(speed)
    # 59 rpm without load; friction takes some of it.
    assert 52.0 < top * 60.0 / (2.0 * math.pi) < 59.0
    assert 10 < int(np.argmax(np.array(speed) > 0.63 * top)) < 40  # ms
    assert max(angle) < 2.0 + 8 * QUANTUM_RAD
    # It comes to rest inside the margin, or where the punch does not overcome friction.
    assert abs(angle[-1] - 2.0) < 3 * QUANTUM_RAD
    assert abs(speed[-1]) < 1e-3


def test_standing_under_load_sags_by_the_compliance_and_then_sticks() -> None:
    bench = make_bench(load_nm=0.8)
    bench.servos.write_goal(every(0.0))
    for _ in range(1000):
        bench.step()
    sag = -bench.data.qpos[0]
    stiffness = 1.5 / (32 * QUANTUM_RAD)  # 9.2 N*m/rad
    # Friction carries part of the load, up to its own bound.
    assert 0.5 * 0.8 / stiffness < sag < 1.1 * 0.8 / stiffness
    before = bench.data.qpos[0]
    for _ in range(1000):
        bench.step()
    assert abs(math.degrees(bench.data.qpos[0] - before)) < 0.02
