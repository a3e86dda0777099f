"""Recorded runs through the learner, and scored: the same code path as on the wire, without it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from adaptive_contact.core.bank import LegGroup
from adaptive_contact.core.detect.standing import Standing
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.fit.refit_job import Job
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import (
    Events,
    LegOutcome,
    LegStream,
    Summary,
    find_swings,
    lift_by_height,
    match,
    summarise,
)
from adaptive_contact.wire import ContactEvent, ServoSample
from adaptive_contact_sim.arrays import Run


class NoRefits:
    """Makes no refit, for a learner of recursion alone."""

    def submit(self, job: Job) -> None:
        """Nothing is done with it."""

    def collect(self, leg: str, number: int) -> object | None:
        """Nothing ever comes."""
        return None


class Played(NamedTuple):
    """What the learners made of a run."""

    events: dict[str, list[ContactEvent]]  # by leg, in order
    learners: dict[str, ContactLearner]  # as they are at the end


def samples_of(run: Run, leg: str) -> list[ServoSample]:
    """A leg's stream as the messages that the simulator would have sent."""
    arrays = run.legs[leg]
    good: list[bool] = np.asarray(arrays.valid.all(axis=1)).tolist()
    rows = zip(
        run.t_ns.tolist(),
        arrays.measured.tolist(),
        arrays.desired.tolist(),
        arrays.swing.tolist(),
        arrays.valid.tolist(),
        strict=True,
    )
    return [
        ServoSample(
            t_ns=t_ns,
            seq=seq,
            measured=measured,
            desired=desired,
            phase="swing" if swing else "stance",
            valid=None if good[seq] else valid,
        )
        for seq, (t_ns, measured, desired, swing, valid) in enumerate(rows)
    ]


def play(run: Run, robot: Robot, baseline: Baseline | None) -> Played:
    """Feed a run to new learners, one for each leg that ever swings."""
    legs = [leg for leg, arrays in run.legs.items() if arrays.swing.any()]
    standing = Standing()
    learners = {leg: ContactLearner(robot, leg, baseline, standing=standing) for leg in legs}
    events = feed(list(learners.values()), [samples_of(run, leg) for leg in legs])
    return Played(dict(zip(legs, events, strict=True)), learners)


def feed(
    learners: Sequence[ContactLearner],
    streams: Sequence[Sequence[ServoSample]],
    on_tick: Callable[[int], None] = lambda _: None,
) -> list[list[ContactEvent]]:
    """Feed each learner its stream with the calls of the service; the events of each.

    All of a tick are fed at once, which shares what a tick costs and does not change a number (a
    test compares with one at a time).  Streams may end before others.

    Args:
        learners: one for each stream.
        streams: samples, in order.
        on_tick: called with the number of each tick that has been fed.
    """
    events: list[list[ContactEvent]] = [[] for _ in streams]
    group = LegGroup(learners)
    for k, samples in enumerate(itertools.zip_longest(*streams)):
        for own, event in zip(events, group.advance(samples), strict=True):
            if event is not None:
                own.append(event)
        on_tick(k)
    return events


def leg_stream(run: Run, leg: str, robot: Robot) -> LegStream:
    """A leg's run as the scoring takes it."""
    arrays, described = run.legs[leg], robot.leg(leg)
    assert described.chain is not None
    height = described.chain.foot(arrays.desired)[:, 2]
    swings = find_swings(run.t_ns, arrays.swing)
    return LegStream(
        leg=leg,
        t_ns=run.t_ns,
        swing=arrays.swing,
        truth=arrays.truth,
        lift=lift_by_height(swings, height),
    )


def score_run(run: Run, robot: Robot, events: dict[str, list[ContactEvent]]) -> list[LegOutcome]:
    """Judge every leg's events against the run's truth."""
    return [
        match(leg_stream(run, leg, robot), Events.from_messages(e)) for leg, e in events.items()
    ]


def parts_of(run: Run, outcomes: Sequence[LegOutcome], count: int) -> list[Summary]:
    """Figures of so many equal parts of a run, by when swings begin."""
    edges = np.linspace(run.t_ns[0], run.t_ns[-1] + 1, count + 1).astype(np.int64).tolist()
    return [
        summarise([outcome.between(begin, end) for outcome in outcomes])
        for begin, end in itertools.pairwise(edges)
    ]
