"""The recording judged: the service's events, and those of a frozen learner on the same samples.

Before and after the drift, by the rules of ``docs/scoring.md``.  The frozen learner keeps the model
that the service started with; where the service's learner adapts, the two come apart after the
drift, and what lies between them is what adapting is worth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.bank import LegGroup
from adaptive_contact.fit.recordings import untouched
from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import (
    Gatherer,
    LegOutcome,
    LegStream,
    Score,
    Summary,
    contacts_of,
    match,
    summarise,
    swings_to_recovery,
)
from adaptive_contact.service.recording import Record, read_recording
from adaptive_contact.service.replay import Counts, control_ticks
from adaptive_contact.wire import ContactEvent, ContactTruth, LearnerStatus, decode

# So many swings in a row with at most one error show a leg to be reliable again.  The design's
# twenty, half of them without contact, take longer than a demo has.
RECOVERY_SWINGS: Final = 10
# Fewer free ticks than this say nothing about a swing's residual.
_LEAST_TICKS: Final = 4


@dataclasses.dataclass(frozen=True, slots=True)
class Level:
    """How well a model predicts a leg, one value per swing, on the ticks that touched nothing."""

    t_ns: Ints  # (s,) beginning of the swing
    over_floor: Array  # (s,) RMS of the one-step error of its worst joint, over the noise floor


@dataclasses.dataclass(frozen=True, slots=True)
class Judged:
    """One detector."""

    # whole, before, after: figures of all swings, of those that were over before the drift, and of
    # the others
    whole: Score
    before: Score
    after: Score
    outcomes: tuple[LegOutcome, ...]  # every touch and false alarm, per leg
    level: dict[str, Level]  # per leg
    # swings of the drifted leg from the drift on until ten in a row hold at most one error; 0 where
    # nothing was lost, None where it did not happen
    recovery: int | None
    swings_after: int  # of the drifted leg, that began after the drift


@dataclasses.dataclass(frozen=True, slots=True)
class Verdict:
    """What the recording shows."""

    # start_ns, end_ns: of the samples
    start_ns: int
    end_ns: int
    drift_ns: int  # moment of the drift
    drift_leg: str  # the leg it befell
    service: Judged  # the events that the service published
    frozen: Judged  # those of the model it started with, on the same samples
    truth: dict[str, Ints]  # (c, 2) begin and end of each real contact, ns; per leg
    versions: dict[str, int]  # newest model version of each leg that the service reported


def judge(path: Path, robot: Robot, drift_ns: int, drift_leg: str) -> Verdict:
    """Judge a recording of the demo.

    Raises:
        RecordingError: the recording cannot be read, or holds two runs.
    """
    records = list(read_recording(path))
    gathered = Gatherer(robot)
    for record in records:
        gathered.take(record)
    legs = gathered.legs_with_truth
    streams = {leg: gathered.stream(leg) for leg in legs}
    free = {leg: _free(streams[leg]) for leg in legs}

    def judged(replayed: _Replayed) -> Judged:
        outcomes = tuple(match(streams[leg], gathered.events(leg)) for leg in legs)
        level = {
            leg: _level(streams[leg], free[leg], replayed.residual[leg], replayed.floor[leg])
            for leg in legs
        }
        (drifted,) = (one for one in outcomes if one.leg == drift_leg)
        before = tuple(one.between(0, _split(one, drift_ns)) for one in outcomes)
        after = tuple(one.between(_split(one, drift_ns), _END) for one in outcomes)
        return Judged(
            whole=Score.of(outcomes, gathered.rejects),
            before=Score.of(before, gathered.rejects),
            after=Score.of(after, gathered.rejects),
            outcomes=outcomes,
            level=level,
            recovery=swings_to_recovery(
                drifted.swings, drift_ns, window=RECOVERY_SWINGS, least_of_a_kind=0
            ),
            swings_after=int((drifted.swings.start_ns >= drift_ns).sum()),
        )

    # Its residuals are not on the wire; its learners, fed the same samples, have the same.
    service = judged(_replay(records, robot, LearnerMode.FULL, streams))
    replayed = _replay(records, robot, LearnerMode.FROZEN, streams)
    gathered.replace_events(replayed.events)
    frozen = judged(replayed)
    return Verdict(
        start_ns=min(int(stream.t_ns[0]) for stream in streams.values()),
        end_ns=max(int(stream.t_ns[-1]) for stream in streams.values()),
        drift_ns=drift_ns,
        drift_leg=drift_leg,
        service=service,
        frozen=frozen,
        truth={leg: _contacts(streams[leg]) for leg in legs},
        versions=_versions(records),
    )


def others(score: Score, leg: str) -> Summary:
    """Figures of all legs but one."""
    return summarise([one for one in score.outcomes if one.leg != leg])


_END: Final = int(np.iinfo(np.int64).max)


# -- replaying ---------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, slots=True)
class _Replayed:
    """Events of learners on a recording, and their residuals."""

    events: list[ContactEvent]
    residual: dict[str, Array]  # (n, J) rad of each sample, NaN where there was no prediction
    floor: dict[str, Array]  # (J,) rad, the level of the model at the start


def _replay(
    records: Iterable[Record], robot: Robot, mode: LearnerMode, streams: dict[str, LegStream]
) -> _Replayed:
    baseline = shipped_baseline(robot.name)
    learners = {leg: ContactLearner(robot, leg, baseline, mode=mode) for leg in streams}
    # The same floor for every mode: that of the model they begin with.
    floor = {leg: np.array(learner.status.noise_floor) for leg, learner in learners.items()}
    residual = {
        leg: np.full((len(stream.t_ns), len(floor[leg])), np.nan) for leg, stream in streams.items()
    }
    row = {leg: {int(t): i for i, t in enumerate(s.t_ns)} for leg, s in streams.items()}
    events: list[ContactEvent] = []
    team = LegGroup(list(learners.values()))
    for tick in control_ticks(records, lambda leg, _: leg in learners, Counts()):
        decided = team.advance([tick.get(leg) for leg in learners])
        events += [event for event in decided if event is not None]
        for leg, sample in tick.items():
            at, judged = row[leg].get(sample.t_ns), learners[leg].judged()
            if at is not None and judged is not None:
                residual[leg][at] = judged.residual
    return _Replayed(events, residual, floor)


def _free(stream: LegStream) -> Mask:
    """(n,) swing ticks that no contact is near."""
    truth = stream.truth
    changes = [
        ContactTruth(t_ns=int(t), contact=bool(contact), force=0.0)
        for t, contact in zip(truth.t_ns, truth.contact, strict=True)
    ]
    period_ns = int(np.median(np.diff(stream.t_ns)))
    return np.asarray(stream.swing & untouched(stream.t_ns, changes, period_ns))


def _level(stream: LegStream, free: Mask, residual: Array, floor: Array) -> Level:
    """RMS over the noise floor, swing by swing."""
    begins = np.flatnonzero(stream.swing & ~np.concatenate(([False], stream.swing[:-1])))
    usable = free & np.isfinite(residual).all(axis=1)
    times: list[int] = []
    levels: list[float] = []
    for begin, end in zip(begins, [*begins[1:], len(stream.t_ns)], strict=True):
        rows = residual[begin:end][usable[begin:end]]
        if len(rows) >= _LEAST_TICKS and np.all(floor > 0.0):
            times.append(int(stream.t_ns[begin]))
            levels.append(float(np.max(np.sqrt(np.square(rows).mean(axis=0)) / floor)))
    return Level(np.array(times, dtype=np.int64), np.array(levels))


# -- reading -----------------------------------------------------------------------------------


def _split(outcome: LegOutcome, drift_ns: int) -> int:
    """Where "after" begins for a leg: with the swing that the drift fell into, if it did."""
    under_way = (outcome.swings.start_ns <= drift_ns) & (drift_ns <= outcome.swings.end_ns)
    return int(outcome.swings.start_ns[under_way][0]) if under_way.any() else drift_ns


def _contacts(stream: LegStream) -> Ints:
    found = contacts_of(stream.truth, int(stream.t_ns[0]))
    end = np.minimum(found.release_ns, stream.t_ns[-1])
    return np.column_stack([found.onset_ns, end])


def _versions(records: Iterable[Record]) -> dict[str, int]:
    """Newest model version of each leg, by the service's statuses."""
    versions: dict[str, int] = {}
    for record in records:
        if record.key.endswith("/learner"):
            status = decode(record.payload, LearnerStatus, record.encoding)
            if isinstance(status, LearnerStatus):
                versions[status.leg] = max(versions.get(status.leg, 0), status.model_version)
    return versions
