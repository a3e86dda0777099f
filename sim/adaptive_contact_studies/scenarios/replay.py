"""Recordings of scenarios, and what several learners at once make of each.

All variants see the same samples side by side.  Besides their events, each learner is asked how it
is at the end of every swing, and which ticks it took for free; these are held against the truth.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple, get_args

import numpy as np

from adaptive_contact.arrays import Ints, Mask
from adaptive_contact.core.learn.change_classifier import KINDS
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.core.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.score import Events, LegStream, TruthChanges, contacts_of, truth_changes
from adaptive_contact.wire import ContactEvent, ContactTruth, Status
from adaptive_contact_sim.arrays import Run, record_run
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import Simulation
from adaptive_contact_studies.evaluate import NoRefits, feed, leg_stream, samples_of
from adaptive_contact_studies.scenarios.spec import RecordingSpec, ReplaySpec, Variant
from adaptive_contact_studies.scenarios.staging import stagehand
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, rests_on

STATUSES: Final[tuple[Status, ...]] = get_args(Status)
HEXAPOD: Final = "hexapod"
# The leg diagonally opposite: of the other side, and of the other end.
OPPOSITE: Final = {"lf": "rr", "lm": "rm", "lr": "rf", "rf": "lr", "rm": "lm", "rr": "lf"}


class SwingLog(NamedTuple):
    """How a learner was at the first sample after each swing, (s,) each."""

    t_ns: Ints  # of that sample
    status: Ints  # position in `STATUSES`
    kind: Ints  # of the change that is reported, position in `KINDS`; -1 for none


@dataclass(frozen=True, eq=False)
class LegReplay:
    """What one learner made of one leg."""

    events: Events  # in order
    log: SwingLog  # swing by swing
    confirmed: int  # ticks it took for free
    touched: int  # those of them on which the leg touched something


@dataclass(frozen=True, eq=False)
class Replayed:
    """A recording through its learners."""

    streams: dict[str, LegStream]  # by leg, as the scoring takes them
    learners: dict[str, dict[Variant, LegReplay]]  # by leg


@rests_on(*SIMULATOR, "adaptive_contact_studies.scenarios.staging")
def recorded(_: Work, spec: RecordingSpec) -> tuple[Run, tuple[int, int] | None]:
    """Simulate a recording; when the foot of its first leg was held, ns.

    Raises:
        SimulationDivergedError: the physics blew up.
    """
    sim = Simulation(spec.settings)
    with stagehand(sim, spec.staging, spec.legs[0]) as hand:
        run = record_run(sim, spec.seconds, legs=spec.legs, before_tick=hand.before_tick)
    return run, hand.held_ns


@rests_on(
    *(*SIMULATOR, *LEARNER),
    *("adaptive_contact_studies.evaluate", "adaptive_contact_studies.scenarios.staging"),
)
def replayed(work: Work, spec: ReplaySpec) -> Replayed:
    """Replay a recording through the learners."""
    run, held_ns = work.one(recorded, spec.recording)
    robot = simulated_robot(spec.recording.settings.robot).description
    streams = {leg: leg_stream(run, leg, robot) for leg in spec.recording.legs}
    if held_ns is not None:
        first = streams[spec.recording.legs[0]]
        streams[first.leg] = replace(first, truth=hold(first.truth, *held_ns))
    return Replayed(streams, replay(spec, run, streams))


def replay(
    spec: ReplaySpec, run: Run, streams: dict[str, LegStream]
) -> dict[str, dict[Variant, LegReplay]]:
    """Feed a recording to all learners, tick by tick."""
    samples = {leg: samples_of(run, leg) for leg in streams}
    watches = [_Watch(spec, leg, variant) for leg in streams for variant in spec.variants]

    def notify_swing_ends(k: int) -> None:
        for watch in watches:
            swing = streams[watch.leg].swing
            if k and swing[k - 1] and not swing[k]:
                watch.swing_over()

    told = feed(
        [watch.learner for watch in watches],
        [samples[watch.leg] for watch in watches],
        notify_swing_ends,
    )
    found: dict[str, dict[Variant, LegReplay]] = {leg: {} for leg in streams}
    for watch, events in zip(watches, told, strict=True):
        found[watch.leg][watch.variant] = watch.result(streams[watch.leg], events)
    return found


def hold(truth: TruthChanges, from_ns: int, to_ns: int) -> TruthChanges:
    """Truth with a contact added that holds from one time to another.

    Args:
        truth: in order of time.
        from_ns: when it begins; what the truth says from here on is lost.
        to_ns: when it ends; what the truth last said by then holds afterwards.
    """
    inside = (truth.t_ns >= from_ns) & (truth.t_ns <= to_ns)
    until = truth.t_ns <= to_ns
    after = bool(truth.contact[until][-1]) if until.any() else False
    ends = [(from_ns, True), (to_ns, after)]
    added = truth_changes(
        [ContactTruth(t_ns=t, contact=on, force=0.0, surface="soft") for t, on in ends]
    )
    rest = (column[~inside] for column in truth)
    both = TruthChanges._make(map(np.concatenate, zip(rest, added, strict=True)))
    order = np.argsort(both.t_ns, kind="stable")
    return TruthChanges._make(column[order] for column in both)


_shipped = functools.cache(shipped_baseline)


class _Watch:
    """Looks at one learner while it goes along."""

    def __init__(self, spec: ReplaySpec, leg: str, variant: Variant) -> None:
        self.leg, self.variant = leg, variant
        name = spec.recording.settings.robot
        described = simulated_robot(name).description
        baseline = None if spec.baseline == "none" else _shipped(described.name)
        if baseline is not None and spec.baseline == "other_leg":
            baseline = replace(baseline, legs={leg: baseline.legs[OPPOSITE[leg]]})
        self.learner = ContactLearner(
            described,
            leg,
            baseline,
            mode=LearnerMode.FROZEN if variant == "frozen" else LearnerMode.FULL,
            refitter=NoRefits() if variant == "rls" else None,
        )
        self._confirmed: list[int] = []
        self._rows: list[tuple[Any, ...]] = []

    def swing_over(self) -> None:
        """At the first sample after a swing."""
        status = self.learner.status
        self._confirmed.extend(self.learner.drain_confirmed())
        kind = -1 if status.drift.kind is None else KINDS.index(status.drift.kind)
        self._rows.append((status.t_ns, STATUSES.index(status.status), kind))

    def result(self, stream: LegStream, events: Sequence[ContactEvent]) -> LegReplay:
        """All that was seen."""
        self._confirmed.extend(self.learner.drain_confirmed())
        log = np.array(self._rows, dtype=np.int64).reshape(-1, len(SwingLog._fields)).T
        at = np.searchsorted(stream.t_ns, self._confirmed)
        touched = int(np.count_nonzero(touching(stream)[at]))
        return LegReplay(
            Events.from_messages(events), SwingLog(*log), len(self._confirmed), touched
        )


def touching(stream: LegStream) -> Mask:
    """(n,) whether the leg touched anything between the sample before and this one."""
    contacts = contacts_of(stream.truth, int(stream.t_ns[0]))
    before = np.concatenate((stream.t_ns[:1], stream.t_ns[:-1]))
    begun = np.searchsorted(contacts.onset_ns, stream.t_ns, side="right")
    return np.asarray(begun > np.searchsorted(contacts.release_ns, before, side="right"))
