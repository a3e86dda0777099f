"""Limits of lengths hold for legs of any size: decisions depend on proportions alone."""

from __future__ import annotations

import dataclasses

import msgspec
import pytest

from adaptive_contact import ContactEvent, ContactLearner, ServoSample
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact_sim import SimulationSettings, parse_drift, simulated_robot
from adaptive_contact_sim.arrays import LegArrays, Run, record_arrays

NAME, LEG = "quadruped12", "fr"


@pytest.fixture(scope="module")
def run() -> Run:
    """A walk in which joints begin to rub: there is much to be labelled."""
    layout = simulated_robot(NAME).layout
    settings = SimulationSettings.of(NAME, "walk", "walk")
    drift = (parse_drift("friction:value=4@6s", layout),)
    return record_arrays(dataclasses.replace(settings, drift=drift, seed=21), 22.0)


def sized(factor: float) -> Robot:
    """The robot, so many times as large; powers of two scale every float exactly."""
    robot = shipped_robot(NAME)
    legs = []
    for leg in robot.legs:
        origins = tuple(tuple(factor * x for x in origin) for origin in leg.origins_m)
        legs.append(msgspec.structs.replace(leg, origins_m=origins))
    return msgspec.structs.replace(robot, legs=tuple(legs))


def decided(
    robot: Robot, leg: LegArrays, t_ns: list[int], *, says: bool
) -> tuple[list[ContactEvent], list[int]]:
    """Events of a leg, and the ticks that were taken for free."""
    learner = ContactLearner(robot, LEG, shipped_baseline(NAME))
    events = []
    for k, at_ns in enumerate(t_ns):
        event = learner.update(
            ServoSample(
                t_ns=at_ns,
                seq=k,
                measured=leg.measured[k].tolist(),
                desired=leg.desired[k].tolist(),
                phase=("swing" if leg.swing[k] else "stance") if says else None,
            )
        )
        if event is not None:
            # Where the foot is, is as large as the leg.
            events.append(msgspec.structs.replace(event, foot_m=None, foot_sd_m=None))
    return events, learner.drain_confirmed()


@pytest.mark.parametrize("says", [True, False])
def test_decisions_do_not_depend_on_the_size_of_a_leg(run: Run, says: bool) -> None:
    leg, t_ns = run.legs[LEG], run.t_ns.tolist()
    usual = decided(sized(1.0), leg, t_ns, says=says)
    assert sum(event.contact for event in usual[0]) > 5
    assert len(usual[1]) > 100
    for factor in (0.25, 4.0):
        assert decided(sized(factor), leg, t_ns, says=says) == usual
