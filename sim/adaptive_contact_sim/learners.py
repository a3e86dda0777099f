"""Learners beside a simulation, without a network; only what needs them loads this."""

from __future__ import annotations

from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.model import shipped_baseline
from adaptive_contact.wire import ContactEvent
from adaptive_contact_sim.simulation import Simulation, Tick


class InProcess:
    """The service's learners in this process: a tick's events reach the gait before its next.

    Args:
        sim: whose legs they are; they begin with its shipped baseline, as `serve` does.
        mode: what they may do to follow the legs.
    """

    def __init__(self, sim: Simulation, mode: LearnerMode = LearnerMode.FULL) -> None:
        robot = sim.robot.description
        self._sim = sim
        self._bank = LearnerBank(robot, shipped_baseline(robot.name), mode=mode)

    def take(self, tick: Tick) -> list[ContactEvent]:
        """Take in a tick's samples, and pass the events on to the gait."""
        events = self._bank.update(tick.samples)
        for event in events:
            self._sim.notify_contact(event.leg, event.contact)
        return events
