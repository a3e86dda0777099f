"""From messages to stretches of samples to learn from.

Samples go through the same stream guard as in the learner; a gap, a restart or a rejected sample
ends a stretch.  What may be learned as free comes from the truth where a recording has it, and
from the cautious part of each swing where it has not.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.stream import RATE_STEPS, RateWatch, StreamGuard
from adaptive_contact.adapt.tracker import LIFT_OFF_TICKS
from adaptive_contact.adapt.training import Stretch, swing_ticks
from adaptive_contact.errors import IdentificationError
from adaptive_contact.robot import Leg
from adaptive_contact.robot.phase import infer_phase
from adaptive_contact.wire import ContactTruth, Reject, ServoSample

__all__ = ["LegGatherer", "cautious", "untouched"]

Mask = NDArray[np.bool_]

# Around a touch of the truth: it counts from 0.5 N on, so a tick before it may be pressed on
# already, and a leg let go of rings for some ticks.
BEFORE_TICKS: Final = 1
AFTER_TICKS: Final = 3
# Without truth: the last ticks of a swing may hold the touch that ended it.
LAST_TICKS: Final = 6


class LegGatherer:
    """Collects one leg's samples and truth, in the order of the recording.

    Attributes:
        rejects: samples that were not used, by reason.
        missed: samples lost.
        off_rate: samples that came at another rate than the robot's, not used.
    """

    def __init__(self, leg: Leg, period_s: float) -> None:
        self.leg = leg
        self.rejects: Counter[Reject] = Counter()
        self._period_ns = round(period_s * 1e9)
        self.off_rate = 0
        self._guard = StreamGuard(len(leg.joints))
        self._rate = RateWatch(self._period_ns)
        self._runs: list[list[ServoSample]] = []
        self._truth: list[ContactTruth] = []

    @property
    def missed(self) -> int:
        """Samples lost, from gaps in ``seq``."""
        return self._guard.missed

    @property
    def samples(self) -> int:
        """Samples accepted."""
        return sum(map(len, self._runs))

    def take_sample(self, sample: ServoSample) -> None:
        """Take in the next sample; a bad one is counted."""
        result = self._guard.admit(sample)
        if isinstance(result, Reject):
            self.rejects[result] += 1
            return
        connected = self._rate.follow(sample.t_ns, sample.seq, restart=result.restart)
        if self._rate.off:
            self.off_rate += 1
            # Those that told are as far off as those that came after.
            if self._runs and self._runs[-1]:
                del self._runs[-1][-RATE_STEPS:]
                self._runs.append([])
            return
        if result.restart or result.missed or not connected or not self._runs:
            self._runs.append([])
        self._runs[-1].append(sample)

    def take_truth(self, truth: ContactTruth) -> None:
        """Take in a change of the true contact."""
        self._truth.append(truth)

    def stretches(self, *, free: bool = False) -> list[Stretch]:
        """What was collected.

        Args:
            free: take every swing for contact-free where there is no truth.

        Raises:
            IdentificationError: swings cannot be told: no phase, and no lengths to infer it.
        """
        return [self._stretch(run, free) for run in self._runs if len(run) > 1]

    def _stretch(self, run: list[ServoSample], free: bool) -> Stretch:
        joints = len(self.leg.joints)
        desired = np.array([s.desired for s in run])
        swing = self._swing(run, desired)
        if self._truth:
            t_ns = np.array([s.t_ns for s in run], dtype=np.int64)
            mask = untouched(t_ns, self._truth, self._period_ns)
        else:
            mask = np.ones(len(run), dtype=bool) if free else cautious(swing)
        sound = [s.valid is None or all(s.valid) for s in run]
        return Stretch(
            measured=np.array([s.measured for s in run]).reshape(-1, joints),
            desired=desired,
            swing=swing,
            free=mask,
            sound=np.array(sound),
            certain=bool(self._truth) or free,
        )

    def _swing(self, run: list[ServoSample], desired: NDArray[np.float64]) -> Mask:
        inferred = infer_phase(desired, self.leg)
        told = np.array([s.phase is not None for s in run])
        if inferred is None and not told.all():
            raise IdentificationError(
                f"leg '{self.leg.id}': {np.count_nonzero(~told)} samples carry no phase and "
                "robot.toml has no lengths_m for it; give one or the other"
            )
        swing = np.array([s.phase == "swing" for s in run])
        return swing if inferred is None else np.where(told, swing, inferred)


def untouched(t_ns: NDArray[np.int64], truth: Iterable[ContactTruth], period_ns: int) -> Mask:
    """Ticks that no contact of the truth is near.

    A touch that begins and ends between two readings leaves no tick in contact, but its mark on
    the reading after: ticks are excluded by time, not by state.

    Args:
        t_ns: (n,) times of the readings.
        truth: changes of contact, in order.
        period_ns: control tick.

    Returns:
        (n,) True where nothing touches.
    """
    mask = np.ones(len(t_ns), dtype=bool)
    onset: int | None = None
    for change in truth:
        if change.contact:
            onset = change.t_ns if onset is None else onset
        elif onset is not None:
            _exclude(mask, t_ns, onset, change.t_ns, period_ns)
            onset = None
        else:  # the recording began in contact
            _exclude(mask, t_ns, int(t_ns[0]), change.t_ns, period_ns)
    if onset is not None and len(t_ns):
        _exclude(mask, t_ns, onset, int(t_ns[-1]), period_ns)
    return mask


def cautious(swing: Mask) -> Mask:
    """The part of every swing that is free with some certainty, without truth.

    Args:
        swing: (n,).

    Returns:
        (n,) True but for the first ticks of each swing (foot still loaded) and its last ones (a
        touch may have ended it).
    """
    from_start = swing_ticks(swing)
    to_end = swing_ticks(swing[::-1])[::-1]
    return np.asarray(swing & (from_start > LIFT_OFF_TICKS) & (to_end > LAST_TICKS))


def _exclude(mask: Mask, t_ns: NDArray[np.int64], onset: int, release: int, period_ns: int) -> None:
    first = np.searchsorted(t_ns, onset - BEFORE_TICKS * period_ns)
    last = np.searchsorted(t_ns, release + AFTER_TICKS * period_ns, side="right")
    mask[first:last] = False
