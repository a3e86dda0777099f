"""Walks that act on contacts: events of learners in the process, and strikes in the lift."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from adaptive_contact.arrays import Array
from adaptive_contact.wire import (
    ContactEvent,
    ServoSample,
    contact_key,
    decode,
    servo_key,
)
from adaptive_contact_sim import (
    Simulation,
    SimulationSettings,
    TerrainSettings,
    WalkSettings,
)
from adaptive_contact_sim.live import InProcess
from tests.sim.touches import recorded

ROUGH = SimulationSettings(
    motion=WalkSettings(stop_on="service"), terrain=TerrainSettings(kind="rough"), seed=4
)
HIGH = SimulationSettings(
    motion=WalkSettings(raise_m=0.04), terrain=TerrainSettings(kind="steps", relief_m=0.07)
)


def test_a_walk_on_events_needs_no_network_and_is_the_same_again(tmp_path: Path) -> None:
    first, again = (recorded(ROUGH, 8.0, tmp_path / name) for name in ("a.mcap", "b.mcap"))
    assert first == again
    stops = 0
    for leg in ("lf", "rm"):
        swings = {
            sample.t_ns: sample.phase == "swing"
            for r in first[servo_key(leg)]
            for sample in [decode(r.payload, ServoSample, r.encoding)]
        }
        for record in first[contact_key(leg)]:
            event = decode(record.payload, ContactEvent, record.encoding)
            # The gait gets it before the tick after the one that decided, and stops in that.
            assert record.log_time_ns == event.t_ns + 20_000_000
            if event.contact:
                assert swings[event.t_ns]
                assert not swings[record.log_time_ns]
                stops += 1
    assert stops >= 8


class Walked(NamedTuple):
    """A walk: what was commanded and measured, the true feet, and when legs were raised."""

    desired: Array  # (n, L, 3) m, feet in the legs' frames
    measured: Array
    height_m: Array  # (n, L) of the true feet, at the end of each tick
    raises: list[tuple[int, int]]  # tick and leg


def walk(settings: SimulationSettings, seconds: float) -> Walked:
    """Walk so long, or until 0.3 s after the first leg was raised."""
    sim = Simulation(settings)
    learners = InProcess(sim) if settings.motion.stop_on == "service" else None
    desired, measured, height, raises = [], [], [], []
    for tick in sim.run(seconds):
        if learners is not None:
            learners.process_tick(tick)
        feet = [(s.desired, s.measured) for s in tick.samples.values()]
        desired.append(sim.geometry.feet(np.array([goal for goal, _ in feet])))
        measured.append(sim.geometry.feet(np.array([read for _, read in feet])))
        height.append(sim.plant.foot_positions()[:, 2].copy())
        raises += [(len(height) - 1, int(leg)) for leg in np.flatnonzero(sim.motion.raised)]
        if raises and len(height) > raises[0][0] + 15:
            break
    return Walked(np.array(desired), np.array(measured), np.array(height), raises)


@pytest.mark.parametrize("stop_on", ["truth", "service"])
def test_a_strike_in_the_lift_stops_the_swing_and_raises_the_leg(stop_on: str) -> None:
    """Beside the same walk without: both are the same until the first strike."""
    higher = []
    for seed in (911, 912, 913):
        on = replace(HIGH, seed=seed, motion=replace(HIGH.motion, stop_on=stop_on))
        off = replace(on, motion=replace(on.motion, raise_m=0.0))
        with_it = walk(on, 12.0)
        assert with_it.raises, "nothing was struck"
        without = walk(off, 0.02 * len(with_it.desired))
        assert not without.raises
        k, leg = with_it.raises[0]
        assert (with_it.desired[:k] == without.desired[:k]).all()
        # The swing stops: the command goes back to where the foot is, a step of a servo or two off.
        off_foot = with_it.desired[k, leg, :2] - with_it.measured[k, leg, :2]
        assert np.abs(off_foot).max() < 0.003
        # The leg is raised: within 0.3 s by more than it would have been.
        top = [walked.height_m[k : k + 15, leg].max() for walked in (with_it, without)]
        higher.append(top[0] - top[1])
    assert min(higher) > 0.0
    assert np.median(higher) > 0.01
