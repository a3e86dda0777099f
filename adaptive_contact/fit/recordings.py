"""Cuts messages into stretches of samples to learn from.

Samples go through the same stream guard as in the learner; a gap, a restart or a rejected sample
ends a stretch.  What may be learned as free comes from the truth where a recording has it, and
from the cautious part of each swing where it has not.

A change of the truth states its time by its source's clock, but not the start of the source that it
belongs to; the next start may count the same times again.  It is of the run whose samples had a
time nearest to its own when it was received.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.checks.conventions.judge import (
    ConventionFinding,
    Findings,
    check_hanging,
    check_motion,
)
from adaptive_contact.checks.limits import Limits, find_limits
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.checks.source_watch import RateWatch, Seams
from adaptive_contact.core.detect.source import LATE_PERIODS
from adaptive_contact.core.detect.stream import (
    StreamGuard,
)
from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit.train import Stretch, cautious
from adaptive_contact.robot import AngleFrame, Leg, Robot
from adaptive_contact.robot.description import ASSUMED_STEP_RAD
from adaptive_contact.robot.gait_phase import infer_phase
from adaptive_contact.wire import ContactTruth, Reject, ServoSample

# Around a touch of the truth: it counts from 0.5 N on, so a tick before it may be pressed on
# already, and a leg let go of rings for some ticks.
BEFORE_TICKS: Final = 1
AFTER_TICKS: Final = 3
# Stamps on each side of a late one, by which it is judged whether the loop slipped.
SLIP_TICKS: Final = 25
# How much of a recording is judged at a time for signs and zeros, and how often.
JUDGED_NS: Final = 60_000_000_000
# A reading that is off the median of five: by so many times what one tick in twenty moves, and by
# so much, rad, at least.  At a turn a joint is off it by two ticks' movements at most.
STRAY_TICKS: Final = 5
STRAY_TIMES: Final = 4.0
STRAY_RAD: Final = 0.15


class LegGatherer:
    """Collects one leg's samples and truth, in the order of the recording.

    Attributes:
        rejects: samples that were not used, by reason.
        off_rate: samples that came at another rate than the robot's, not used.
    """

    def __init__(self, leg: Leg, period_s: float) -> None:
        self.leg = leg
        self.rejects: Counter[Reject] = Counter()
        self._period_ns = round(period_s * 1e9)
        self.off_rate = 0
        self._frame = AngleFrame(leg)
        self._limits = Limits.none(len(leg.joints))  # where the servos stop
        self._guard = StreamGuard(len(leg.joints))
        self._seams = Seams(len(leg.joints))
        self._rate = RateWatch(self._period_ns)
        self._runs: list[_Run] = []
        self._changes: list[_Received] = []

    @property
    def samples(self) -> int:
        """Samples accepted."""
        return sum(len(rows) for run in self._runs for rows in run.stretches)

    def add_sample(self, sample: ServoSample) -> None:
        """Add the next sample of the wire; a bad one is counted."""
        sample = self._frame.sample(sample)
        result = self._guard.admit(sample)
        if isinstance(result, Reject):
            self.rejects[result] += 1
            return
        sample = self._seams.unwrap(sample, restart=result.restart)
        missed = self._rate.update(sample.t_ns, sample.seq, restart=result.restart)
        if result.restart:  # as the first sample is
            self._runs.append(_Run([], [[]]))
        run = self._runs[-1]
        run.t_ns.append(sample.t_ns)
        if self._rate.leg.rate_off:
            self.off_rate += 1
            # The ticks that showed the wrong rate are as far off as those that came after.
            if run.stretches[-1]:
                del run.stretches[-1][1 - int(self._rate.leg.rate_ticks) :]
                run.stretches.append([])
            return
        if missed != 0:  # None after a pause
            run.stretches.append([])
        run.stretches[-1].append(sample)

    def add_truth(self, truth: ContactTruth) -> None:
        """Add a change of the true contact."""
        came = len(self._runs[-1].t_ns) if self._runs else 0
        self._changes.append(_Received(truth, len(self._runs) - 1, came))

    def stretches(self, *, free: bool = False) -> list[Stretch]:
        """Return the stretches that were collected.

        Args:
            free: take every swing for contact-free in a run that has no truth.

        Raises:
            IdentificationError: swings cannot be found: no phase, and no lengths to infer it.
        """
        motion = self.motion()
        if len(motion.t_ns):
            self._limits = find_limits(
                self.leg.chain,
                Limits.from_leg(self.leg),
                self._limits,
                ASSUMED_STEP_RAD,
                motion.measured,
                motion.desired,
            )
        return [
            self._stretch(rows, truth, free)
            for run, truth in zip(self._runs, self._truths(), strict=True)
            for whole in run.stretches
            for rows in _between_slips(whole, self._period_ns)
            if len(rows) > 1
        ]

    def motion(self) -> LegMotion:
        """Return all samples that were collected, in order of time."""
        rows = [row for run in self._runs for stretch in run.stretches for row in stretch]
        return LegMotion.from_samples(sorted(rows, key=lambda row: row.t_ns))

    def last_run(self) -> list[ServoSample]:
        """Return the samples of the last start of the source, in order."""
        return (
            [row for stretch in self._runs[-1].stretches for row in stretch] if self._runs else []
        )

    def _truths(self) -> list[list[ContactTruth]]:
        """Every run's changes of contact, in order of time."""
        truths: list[list[ContactTruth]] = [[] for _ in self._runs]
        for received in self._changes if truths else ():
            near = range(max(received.run - 1, 0), min(received.run + 2, len(truths)))
            owner = min(near, key=functools.partial(self._apart_ns, received))
            truths[owner].append(received.change)
        return [sorted(truth, key=lambda change: change.t_ns) for truth in truths]

    def _apart_ns(self, received: _Received, number: int) -> int:
        """How far a change was from a run's time when it was received."""
        change_ns, t_ns = received.change.t_ns, self._runs[number].t_ns
        came = received.came if number == received.run else len(t_ns) * (number < received.run)
        before, after = t_ns[max(came - 1, 0)], t_ns[min(came, len(t_ns) - 1)]
        return max(before - change_ns, change_ns - after, 0)

    def _stretch(self, rows: list[ServoSample], truth: list[ContactTruth], free: bool) -> Stretch:
        joints = len(self.leg.joints)
        desired = self._limits.clip(np.array([s.desired for s in rows]))
        swing = self._swing(rows, desired)
        # A run without changes may have touched nothing, or not know.
        certain = bool(truth) or free
        mask = np.ones(len(rows), dtype=bool) if certain else cautious(swing)
        mask &= untouched(_tick_times(rows, self._period_ns), truth, self._period_ns)
        measured = np.array([s.measured for s in rows]).reshape(-1, joints)
        answered = np.array([s.valid is None or all(s.valid) for s in rows])
        return Stretch(
            measured=measured,
            desired=desired,
            swing=swing,
            free=mask,
            sound=answered & ~stray_readings(measured).any(axis=1),
            certain=certain,
        )

    def _swing(self, rows: list[ServoSample], desired: Array) -> Mask:
        inferred = infer_phase(desired, self.leg)
        stated = np.array([s.phase is not None for s in rows])
        if inferred is None and not stated.all():
            raise IdentificationError(
                f"leg '{self.leg.id}': {np.count_nonzero(~stated)} samples carry no phase and "
                "robot.toml has no lengths_m for it; give one or the other"
            )
        swing = np.array([s.phase == "swing" for s in rows])
        return swing if inferred is None else np.where(stated, swing, inferred)


def stray_readings(measured: Array) -> Mask:
    """Find readings that leave a joint's path for a tick or two: what failed reads leave behind.

    Args:
        measured: (n, J) rad, of ticks in a row.

    Returns:
        (n, J) True where a reading is none.
    """
    if len(measured) < STRAY_TICKS:
        return np.zeros(measured.shape, dtype=bool)
    usual = np.quantile(np.abs(np.diff(measured, axis=0)), 0.95, axis=0)
    ends = STRAY_TICKS // 2
    padded = np.pad(measured, ((ends, ends), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, STRAY_TICKS, axis=0)
    off = np.abs(measured - np.median(around, axis=-1))
    return np.asarray(off > np.maximum(STRAY_TIMES * usual, STRAY_RAD))


def untouched(t_ns: Ints, truth: Iterable[ContactTruth], period_ns: int) -> Mask:
    """Find the ticks that no contact of the truth is near.

    A touch that begins and ends between two readings leaves no tick in contact, but its mark on
    the reading after: ticks are excluded by time, not by state.

    Args:
        t_ns: (n,) times of the readings, one at least.
        truth: changes of contact, in order.
        period_ns: control tick.

    Returns:
        (n,) True where nothing touches.
    """
    mask = np.ones(len(t_ns), dtype=bool)
    first, last = int(t_ns[0]), int(t_ns[-1])
    changes = [(first, False), *((one.t_ns, one.contact) for one in truth), (last, True)]
    for (since, touches), (until, touched) in itertools.pairwise(changes):
        if touches or not touched:  # between two releases an onset was lost
            begin = np.searchsorted(t_ns, since - BEFORE_TICKS * period_ns)
            end = np.searchsorted(t_ns, until + AFTER_TICKS * period_ns, side="right")
            mask[begin:end] = False
    return mask


@dataclasses.dataclass
class _Run:
    """From one start of the source to the next."""

    t_ns: list[int]  # of all samples accepted, used or not
    stretches: list[list[ServoSample]]  # those used, cut where one is missing


def _tick_times(rows: list[ServoSample], period_ns: int) -> Ints:
    """(n,) times of ticks: those of an even grid, moved by the mean of what stamps are off it."""
    grid = np.array([sample.seq for sample in rows], dtype=np.int64) * period_ns
    off = np.array([sample.t_ns for sample in rows], dtype=np.int64) - grid
    total = np.concatenate(([0], np.cumsum(off - off[0])))
    k = np.arange(len(rows))
    # Ticks on each side over which stamps off the grid are averaged.
    reach = np.minimum(np.minimum(k, k[::-1]), 50)  # even on both sides
    mean = (total[k + reach + 1] - total[k - reach]) / (2 * reach + 1)
    return np.asarray(grid + off[0] + np.round(mean).astype(np.int64))


def _between_slips(reads: list[ServoSample], period_ns: int) -> Iterator[list[ServoSample]]:
    """A stretch cut where a tick came late by a whole period, or nearly, and the loop with it.

    Readings before and after are further apart than any others, however they are numbered.  A
    stamp that is wrong says nothing of its reading: the next ones return to the schedule.
    """
    stamps = [sample.t_ns - sample.seq * period_ns for sample in reads]
    slip_ns = (LATE_PERIODS - 1.0) * period_ns
    first = 0
    for k in range(1, len(reads)):
        if stamps[k] - stamps[k - 1] < slip_ns:
            continue
        before = statistics.median(stamps[max(k - SLIP_TICKS, 0) : k])
        after = statistics.median(stamps[k : k + SLIP_TICKS])
        if after - before >= slip_ns:
            yield reads[first:k]
            first = k
    yield reads[first:]


class _Received(NamedTuple):
    """Holds a change of contact, and when it was received."""

    change: ContactTruth  # it
    run: int  # number of the run in force, -1 before any sample
    came: int  # samples of that run by then


def compare_conventions(
    robot: Robot, gathered: Mapping[str, LegGatherer], *, hangs: bool = False
) -> list[ConventionFinding]:
    """Compare the angles of what was gathered with the robot's description.

    A recording is judged a minute at a time, as legs may move by turns.

    Args:
        robot: its description.
        gathered: by leg.
        hangs: the legs hung free, so that gravity shows their angles, too.

    Returns:
        Findings of any minute in legs that no minute confirms; the first of each leg.
    """
    motions = {leg: one.motion() for leg, one in gathered.items() if one.samples > 1}
    if not motions:
        return []
    begin = min(int(motion.t_ns[0]) for motion in motions.values())
    end = max(int(motion.t_ns[-1]) for motion in motions.values())
    parts = min(max(round((end - begin) / JUDGED_NS), 1), 10)
    firsts = [begin + (end + 1 - begin) * part // parts for part in range(parts)]
    found: Findings = {}
    # The first finding of a leg stays, unless a minute confirms it.
    for first in firsts:
        parts_of = {leg: m.between(first, first + JUDGED_NS) for leg, m in motions.items()}
        for leg, finding in check_motion(robot, parts_of).items():
            found[leg] = finding and found.get(leg, finding)
    for leg, finding in check_hanging(robot, motions).items() if hangs else ():
        found.setdefault(leg, finding)
    return [finding for finding in found.values() if finding is not None]
