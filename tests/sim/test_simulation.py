from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import MSGPACK, Drift, ServoSample, decode, encode
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.obstacles import ObstacleSettings
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.servo import QUANTUM_RAD
from adaptive_contact_sim.simulation import Simulation, SimulationSettings
from adaptive_contact_sim.terrain import TerrainSettings
from adaptive_contact_sim.walk import WalkSettings

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


@pytest.mark.parametrize("change", [{"seed": 6}, {"robot_seed": 1}])
def test_other_settings_another_trajectory(change: dict[str, float]) -> None:
    base = dataclasses.replace(EVERYTHING["walk"], drift=())
    ends = []
    for settings in (base, dataclasses.replace(base, **change)):
        sim = Simulation(settings)
        for _ in range(100):
            sim.advance()
        ends.append(sim.plant.joint_angles.copy())
    assert not np.array_equal(*ends)


def test_samples_are_what_the_wire_promises() -> None:
    sim = Simulation(dataclasses.replace(EVERYTHING["walk"], epoch_ns=10**18, run=7))
    previous: dict[str, ServoSample] = {}
    invalid = 0
    for tick in sim.run(2.0):
        assert list(tick.samples) == list(LEGS)
        for leg, sample in tick.samples.items():
            assert decode(encode(sample), ServoSample, MSGPACK) == sample
            assert sample.run == 7
            assert sample.phase in ("swing", "stance")
            steps = np.array(sample.desired) / QUANTUM_RAD
            assert np.allclose(steps, np.rint(steps))
            if leg in previous:
                assert sample.seq == previous[leg].seq + 1
                assert sample.t_ns == previous[leg].t_ns + 20_000_000
            else:
                assert (sample.seq, sample.t_ns) == (0, 10**18)
            previous[leg] = sample
            invalid += sample.valid is not None
    assert invalid == 0
    assert sim.ticks == 100


def test_dropped_readings_are_marked() -> None:
    sim = Simulation(SimulationSettings(encoder=EncoderSettings(dropped=0.2)))
    marked = 0
    before: dict[str, ServoSample] = {}
    for tick in sim.run(1.0):
        for leg, sample in tick.samples.items():
            if sample.valid is not None and leg in before:
                for ok, now, last in zip(
                    sample.valid, sample.measured, before[leg].measured, strict=True
                ):
                    marked += not ok
                    assert ok or now == last
            before[leg] = sample
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
        assert touch.speed_m_s is not None
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


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigurationError, match="whole number"):
        Simulation(SimulationSettings(period_s=0.0155))
