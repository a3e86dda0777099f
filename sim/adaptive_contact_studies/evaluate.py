"""Recorded runs through the learner, and scored: the same code path as on the wire, without it."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.bank import LegGroup
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import Baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import (
    Events,
    LegOutcome,
    LegStream,
    TruthChanges,
    find_swings,
    lift_by_height,
    match,
)
from adaptive_contact.wire import ContactEvent, ServoSample
from adaptive_contact_sim.arrays import Run

MakeLearner = Callable[[Robot, str, Baseline | None], ContactLearner]


class LegRows(Protocol):
    """One leg's stream and the truth about it, as a run or a file has it; rows are ticks."""

    @property
    def measured(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def desired(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def valid(self) -> NDArray[np.bool_]: ...  # noqa: D102
    @property
    def swing(self) -> NDArray[np.bool_]: ...  # noqa: D102
    @property
    def truth(self) -> TruthChanges: ...  # noqa: D102


class Streams(Protocol):
    """Legs that were recorded together."""

    @property
    def t_ns(self) -> NDArray[np.int64]: ...  # noqa: D102
    @property
    def legs(self) -> Mapping[str, LegRows]: ...  # noqa: D102


class Played(NamedTuple):
    """What the learners made of a run.

    Attributes:
        events: by leg, in order.
        learners: as they are at the end.
        seconds: spent in the learners, messages not counted.
    """

    events: dict[str, list[ContactEvent]]
    learners: dict[str, ContactLearner]
    seconds: float


def samples_of(run: Streams, leg: str) -> list[ServoSample]:
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


def play(
    run: Run,
    robot: Robot,
    baseline: Baseline | None,
    *,
    legs: Sequence[str] | None = None,
    make: MakeLearner = ContactLearner,
) -> Played:
    """Feed a run to new learners, all legs of a tick at once.

    Args:
        run: recorded.
        robot: its description.
        baseline: what the learners start from.
        legs: which; those that ever swing where left out.
        make: makes a leg's learner.
    """
    if legs is None:
        legs = [leg for leg, arrays in run.legs.items() if arrays.swing.any()]
    learners = {leg: make(robot, leg, baseline) for leg in legs}
    events: dict[str, list[ContactEvent]] = {leg: [] for leg in legs}
    streams = [samples_of(run, leg) for leg in legs]
    team = LegGroup(list(learners.values()))
    spent = 0.0
    for samples in zip(*streams, strict=True):
        begin = time.perf_counter()
        decided = team.advance(samples)
        spent += time.perf_counter() - begin
        for leg, event in zip(legs, decided, strict=True):
            if event is not None:
                events[leg].append(event)
    return Played(events, learners, spent)


def leg_stream(run: Streams, leg: str, robot: Robot) -> LegStream:
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


def score_run(
    run: Streams, robot: Robot, events: dict[str, list[ContactEvent]]
) -> list[LegOutcome]:
    """Judge every leg's events against the run's truth."""
    return [match(leg_stream(run, leg, robot), Events.of(e)) for leg, e in events.items()]
