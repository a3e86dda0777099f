"""The analytical model against the simulator it is to describe."""

from __future__ import annotations

import numpy as np

from adaptive_contact_sim import PoseSettings, SimulationSettings
from adaptive_contact_sim.simulation import Simulation
from adaptive_contact_studies.paper.analytical import Dynamics, Gains, NominalLeg, predict
from adaptive_contact_studies.paper.data import Stream


def test_one_tick_from_the_true_state_is_the_simulators() -> None:
    """Nominal servos and stiff supply: what is left is the body giving way."""
    sim = Simulation(
        SimulationSettings(
            motion=PoseSettings(), seed=3, servo_spread=0.0, supply_resistance_ohm=0.0
        )
    )
    dynamics = Dynamics(NominalLeg.of())
    own = slice(9, 12)
    errors, moved = [], []
    for k in range(300):
        q, v = sim.plant.joint_angles[own].copy(), sim.plant.joint_speeds[own].copy()
        sim.advance()
        after = sim.plant.joint_angles[own].copy()
        told, _ = dynamics.tick(q[:, None], v[:, None], sim.desired[own, None])
        if k > 60:
            errors.append(told[:, 0] - after)
            moved.append(after - q)
    error = np.degrees(np.sqrt(np.square(errors).mean(axis=0)))
    motion = np.degrees(np.sqrt(np.square(moved).mean(axis=0)))
    assert (error < 0.03).all(), error
    assert (error < 0.01 * motion).all()


def test_streams_together_equal_streams_alone(free_stream: Stream) -> None:
    leg = NominalLeg.of()
    gains = Gains(np.full(3, 0.4), np.full(3, 0.8))
    whole = (free_stream.measured, free_stream.desired)
    part = (free_stream.measured[:700], free_stream.desired[:700])
    alone = predict(leg, [part], gains)[0]
    together = predict(leg, [whole, part], gains)[1]
    # Chunks begin elsewhere, and the observer forgets where it began.
    np.testing.assert_allclose(together[100:], alone[100:], atol=1e-4)
    assert np.isnan(alone[0]).all()


def test_the_observer_beats_two_positions(free_stream: Stream) -> None:
    leg = NominalLeg.of()
    streams = [(free_stream.measured[:2000], free_stream.desired[:2000])]
    swing = free_stream.swing[:2000]

    def rms(gains: Gains) -> float:
        told = predict(leg, streams, gains)[0]
        residual = (streams[0][0] - told)[swing]
        return float(np.sqrt(np.nanmean(np.square(residual))))

    observer = rms(Gains(np.array([0.2, 0.4, 0.4]), np.full(3, 0.8)))
    assert observer < 0.75 * rms(Gains(np.ones(3), None))
    naive = np.diff(streams[0][0], axis=0)[swing[1:]]
    assert observer < 0.1 * np.sqrt(np.square(naive).mean())
