from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import MSGPACK, Drift, ServoSample, decode, encode
from adaptive_contact_sim import (
    EncoderSettings,
    Injection,
    ObstacleSettings,
    PoseSettings,
    Simulation,
    SimulationSettings,
    TerrainSettings,
    WalkSettings,
)
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.servo import QUANTUM_RAD

EVERYTHING = {
    "pose": SimulationSettings(
        motion=PoseSettings(
            legs=LEGS, trials_per_turn=2, obstacles=ObstacleSettings(0.7, soft=0.5)
        ),
        seed=5,
        encoder=EncoderSettings(dropped=0.01, repeated=0.01, bogus=0.01),
        drift=(
            Injection(Drift(kind="backlash", value=0.02, leg="rf"), 1.0),
            Injection(Drift(kind="mass", value=0.05, shape="ramp", duration_s=2.0), 1.0),
        ),
    ),
    "walk": SimulationSettings(
        motion=WalkSettings(gait="tripod"),
        terrain=TerrainSettings(kind="rough"),
        seed=5,
        drift=(
            Injection(Drift(kind="supply", value=9.4, shape="walk", duration_s=3.0, seed=2), 1.0),
        ),
    ),
}


@pytest.mark.parametrize("name", EVERYTHING)
def test_same_settings_same_trajectory_to_the_bit(name: str) -> None:
    first, again = Simulation(EVERYTHING[name]), Simulation(EVERYTHING[name])
    for _ in range(300):
        assert first.tick() == again.tick()
        assert np.array_equal(first.plant.data.qpos, again.plant.data.qpos)
    assert np.array_equal(first.plant.data.qvel, again.plant.data.qvel)


def test_samples_are_what_the_wire_promises() -> None:
    sim = Simulation(dataclasses.replace(EVERYTHING["walk"], epoch_ns=10**18, run=7))
    for k, tick in enumerate(sim.run(2.0)):
        assert list(tick.samples) == list(LEGS)
        for sample in tick.samples.values():
            assert decode(encode(sample), ServoSample, MSGPACK) == sample
            assert (sample.run, sample.seq, sample.t_ns) == (7, k, 10**18 + k * 20_000_000)
            assert sample.phase in ("swing", "stance")
            assert sample.valid is None
            steps = np.array(sample.desired) / QUANTUM_RAD
            assert np.allclose(steps, np.rint(steps))
    assert sim.ticks == 100


def test_dropped_readings_are_marked() -> None:
    sim = Simulation(SimulationSettings(encoder=EncoderSettings(dropped=0.2)))
    marked = 0
    for before, tick in itertools.pairwise(sim.run(1.0)):
        for leg, sample in tick.samples.items():
            rows = zip(sample.measured, before.samples[leg].measured, strict=True)
            stale = [now == last for now, last in rows]
            lost = [not ok for ok in sample.valid or [True] * 3]
            assert all(itertools.compress(stale, lost))
            marked += sum(lost)
    assert marked > 50


def test_truth_tells_what_was_touched() -> None:
    settings = SimulationSettings(
        motion=PoseSettings(obstacles=ObstacleSettings(1.0, soft=1.0)), seed=3
    )
    touches = [
        truth.message
        for tick in Simulation(settings).run(20.0)
        for truth in tick.truth
        if truth.leg == "rf" and truth.message.contact and tick.samples["rf"].seq > 50
    ]
    assert len(touches) > 20
    for touch in touches:
        assert touch.surface == "soft"
        assert touch.part in ("foot", "tibia", "femur", "coxa")
        assert 0.05 < touch.speed_m_s < 2.0
        assert touch.force > 0.5


def test_truth_is_told_in_order_and_soon() -> None:
    last: dict[str, int] = {}
    state: dict[str, bool] = {}
    for tick in Simulation(EVERYTHING["walk"]).run(10.0):
        now = tick.samples["rf"].t_ns + 20_000_000
        for truth in tick.truth:
            message = truth.message
            assert message.t_ns > last.get(truth.leg, -1)
            assert message.contact != state.get(truth.leg)
            delay = now - message.t_ns
            assert delay <= (41_000_000 if message.contact else 101_000_000)
            last[truth.leg], state[truth.leg] = message.t_ns, message.contact


@pytest.mark.parametrize(
    ("kind", "settings", "words"),
    [
        (TerrainSettings, {"kind": "sand"}, "expected one of flat, steps, rough, soft, holes"),
        (TerrainSettings, {"relief_m": 0.5}, "expected 0 to 0.08 m"),
        (TerrainSettings, {"holes": 0.9}, "expected 0 to 0.5"),
        (TerrainSettings, {"stiffness_n_m": 1.0}, "expected 100 to 100000 N/m"),
        (WalkSettings, {"gait": "gallop"}, "expected one of tripod, ripple, wave, trot, walk"),
        (WalkSettings, {"stop_on": "luck"}, "truth, service, never"),
        (WalkSettings, {"stride_m": 0.5}, "stride is 0.5 m; expected 0 to 0.09 m"),
        (WalkSettings, {"swing_s": 0.01}, "expected 0.15 to 3 s"),
        (WalkSettings, {"depth_m": (0.005, 0.03)}, "expected 0.01 to 0.06 m"),
        (WalkSettings, {"phase": "guessed"}, "expected one of touch, planned"),
        (WalkSettings, {"phase": "planned", "stop_on": "service"}, "stopped by nothing"),
        (WalkSettings, {"phase": "planned", "raise_m": 0.03}, "nothing reports strikes"),
        (WalkSettings, {"stop_on": "never", "raise_m": 0.03}, "nothing reports strikes"),
        (WalkSettings, {"react_ms": -1.0}, "expected 0 to 1000 ms"),
        (WalkSettings, {"variability": float("nan")}, "expected 0 to 0.4"),
        (ObstacleSettings, {"probability": 1.5}, "expected 0 to 1"),
        (ObstacleSettings, {"soft": -1.0}, "expected 0 to 1"),
        (ObstacleSettings, {"shapes": ("cone",)}, "plate, sphere, edge"),
        (ObstacleSettings, {"where": (0.9, 0.1)}, "rising"),
        (PoseSettings, {"legs": ()}, "no leg to move"),
        (PoseSettings, {"workspace": "big"}, "expected one of paper, whole"),
        (PoseSettings, {"approach": "jump"}, "expected one of descent"),
        (PoseSettings, {"segment_ticks": 1}, "4 to 500"),
        (PoseSettings, {"trials_per_turn": 0}, "expected 1 to"),
        (PoseSettings, {"path": "zigzag"}, "cartesian"),
        (EncoderSettings, {"dropped": 0.9}, "expected 0 to"),
        (EncoderSettings, {"repeated": -0.1}, "expected 0 to"),
        (EncoderSettings, {"bogus": float("nan")}, "expected 0 to"),
        (EncoderSettings, {"noise_steps": 99.0}, "expected 0 to"),
    ],
)
def test_settings_are_checked(kind: Any, settings: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        kind(**settings)


def test_a_period_is_a_whole_number_of_physics_steps() -> None:
    with pytest.raises(ConfigurationError, match="whole number"):
        Simulation(SimulationSettings(period_s=0.0155))
