"""A foot that strikes a step soon after it began to lift is reported, though it counts as held."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

from adaptive_contact import ContactLearner, load_baseline, load_robot
from adaptive_contact.compiled import records
from adaptive_contact.core.detect.contact import begin_labels, note_contact, strikes
from adaptive_contact.core.detect.layout import new_legs, scalars_of
from adaptive_contact_sim import Simulation, SimulationSettings, TerrainSettings, WalkSettings

PERIOD_NS = 20_000_000


@pytest.mark.parametrize(
    ("fitted", "misfits", "moved_m", "fits"),
    [
        (3, 0, 0.016, True),
        (3, 0, 0.014, False),  # not far enough for so few ticks
        (3, 2, 0.016, False),
        (5, 0, 0.004, True),
        (5, 2, 0.004, True),
        (5, 3, 0.004, False),  # a servo without strength, a foot on a leash: long off by now
        (4, 0, 0.004, False),
        (9, 0, 0.002, False),  # readings that are frozen
        (0, 0, 0.050, False),
    ],
)
def test_what_moved_as_predicted_and_then_met_something(
    fitted: int, misfits: int, moved_m: float, fits: bool
) -> None:
    """The contact begins a tick after the last that fits, or ``misfits`` later."""
    legs = new_legs(1)
    leg = scalars_of(legs, 0)
    leg.leg_size, leg.period_ns, leg.moved = 1.0, PERIOD_NS, moved_m
    leg.onset_ns = 100 * PERIOD_NS
    if misfits:
        leg.fit_n, leg.fit_before = 0, fitted
        leg.misfit_ns = leg.onset_ns - (misfits + 1) * PERIOD_NS
    else:
        leg.fit_n = fitted
    note_contact(records(legs)[0])
    assert bool(leg.fits) is fits


def test_a_leg_that_loses_its_way_in_the_same_tick_of_each_lift_strikes_nothing() -> None:
    """As one whose joint is read through a filter, until that is learned."""
    legs = new_legs(1)
    leg, record = scalars_of(legs, 0), records(legs)[0]
    leg.period_ns, leg.leg_size = PERIOD_NS, 1.0
    way = np.array([0.0, 0.03, 0.02])
    history = np.zeros((2, 3, 3))
    history[:, 0] = -0.5 * way, way  # half of it is lost

    def reported(tick: int) -> bool:
        begin_labels(record)
        leg.ticks, leg.fit_n, leg.at_ns = tick, 5, leg.at_ns + 70 * PERIOD_NS
        leg.misfit_ns = leg.at_ns - 20 * PERIOD_NS
        return strikes(record, history, 1.5)

    assert [reported(tick) for tick in (6, 6, 5, 6)] == [True, False, False, False]
    assert [reported(tick) for tick in (11, 11, 6)] == [True, False, True]


def test_contacts_of_a_leg_that_stands_before_a_step_are_reported() -> None:
    """Its lifts strike the step after some millimetres: 10 and more contacts, all of them true."""
    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="steps", relief_m=0.07), seed=11
    )
    shipped = resources.files("adaptive_contact_models").joinpath("hexapod")
    with resources.as_file(shipped) as folder:
        robot = load_robot(folder / "robot.toml")
        learner = ContactLearner(robot, "lf", load_baseline(folder / "baseline.json"))
    held = []
    for tick in Simulation(settings).run(45.0):
        event = learner.update(tick.samples["lf"])
        if event is not None and event.doubt == "held" and event.score > 1.0:
            held.append(event)
    reported = sum(event.contact for event in held)
    assert reported >= 10
    assert reported >= 0.6 * len(held)
