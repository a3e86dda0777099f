"""Reports what a source's samples show of it: false readings, swapped phases, rate, seams.

*False readings*: copies of commands, held and old readings are found by
:mod:`adaptive_contact.checks.information`, twice a stride.

*Swapped phase*: ``swing`` is published for stance and the reverse.  A leg goes as far in its swing
as in its stance, in less time; where the command moves slower in swings than in stances, and comes
down less, they are swapped.

*Rate*: whether ticks are as far apart as the leg's model takes them to be (decision 30).
"""

from __future__ import annotations

import math
from typing import Any, Final

import msgspec
import numpy as np

from adaptive_contact.checks.information import NEEDED_SAMPLES, InformationCheck, Kind
from adaptive_contact.checks.limits import SAID, Limits, find_limits
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.core.detect.detector import unwrap
from adaptive_contact.core.detect.layout import (
    BEGAN,
    RESTARTED,
    RING,
    TURNED,
    new_legs,
    scalars_of,
)
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.core.detect.source import ECHO, NONE, PAUSE, PHASE, STALE, update_one_clock
from adaptive_contact.robot import Leg
from adaptive_contact.wire import Doubt, ServoSample

SOURCE_CAUSES: Final[tuple[Doubt | None, ...]] = (None, "echo", "phase", "stale")
_SAID: Final[dict[Kind | None, str]] = {
    None: (
        "nothing tells measured from a copy of desired: let the leg carry load, or publish the "
        "positions that the servos report"
    ),
    "copy": "measured copies desired ({names}): publish the positions that the servos report",
    "held": (
        "readings are held for three ticks and more ({names}): read every servo in every tick"
    ),
    "old": (
        "measured follows an earlier desired: publish the positions that the servos report now"
    ),
    "twin": "measured is that of leg '{twin}': publish each leg's own positions",
}
# Legs that read the same to the last bit for so many ticks, in which a joint goes so many steps.
TWIN_TICKS: Final = 40
TWIN_STEPS: Final = 10.0
# Deviations above this, root mean square in periods, are worth a line to a person.
NOTED_JITTER: Final = 0.15
# By a leg's ``late``.
_JITTER_CAUSES: Final = {
    -1: "whether the readings are late, too, is not known yet",
    0: "the readings are on time, and ticks are counted by seq",
    1: "the readings are late, too, and are moved to their ticks",
}


class SourceWatch:
    """Reports what is wrong with the source of one leg's samples.

    Attributes:
        check: whether readings carry information that the commands do not have.
        limits_note: one line for the operator while goals go beyond what the servos do, else None.
    """

    def __init__(self, leg: Leg, place: LegPlace) -> None:
        self._leg = leg
        self._place = place
        self.reset()

    def reset(self) -> None:
        """Reset the findings, and the evidence for them."""
        self.check = InformationCheck(len(self._leg.joints), self._place.leg.quantum)
        self._since_ns = 0
        self._twin = ""  # leg of the same readings
        self.limits_note: str | None = None
        self._place.leg.false_readings = NONE

    @property
    def cause(self) -> Doubt | None:
        """``echo``, ``stale`` or ``phase`` while samples cannot be judged, else None."""
        return SOURCE_CAUSES[int(self._place.leg.cause)]

    @property
    def unproved(self) -> bool:
        """Whether nothing tells the readings from a copy, or one look alone has found a fault."""
        return self.check.unproved or self.check.suspicion is not None

    @property
    def since_ns(self) -> int:
        """Time since which samples have been false."""
        leg = self._place.leg
        return int(leg.began_ns) if leg.cause == PHASE else self._since_ns

    @property
    def off_rate_since_ns(self) -> int:
        """Scheduled time of the oldest tick by which the rate is judged."""
        leg, ring = self._place.leg, self._place.batch.ring[self._place.row]
        return int(ring[(leg.ring_n - min(leg.rate_ticks, leg.ring_n, RING)) % RING, 2])

    def check_source(self, flags: int, *, predicted: bool | None) -> bool:
        """Look at the readings as a swing begins or ends.

        Args:
            flags: of the tick.
            predicted: whether the leg's model predicted its last lifts; None where no lift tells.

        Returns:
            Whether the servos stop elsewhere than was known: what was learned is of other commands.
        """
        leg, check = self._place.leg, self.check
        if flags & RESTARTED:
            check.restart()
        if not flags & (BEGAN | TURNED):
            return False
        moved = bool(flags & BEGAN) and self._check_limits()
        samples = self._place.batch.kept(self._place.row, NEEDED_SAMPLES)
        begins, twin = bool(flags & BEGAN), self._find_twin(samples)
        if check.check_strides(leg.kept_n, samples, begins=begins, predicted=predicted, twin=twin):
            found, t_ns = check.found, samples.t_ns
            leg.false_readings = NONE if found is None else ECHO if found.kind == "copy" else STALE
            if found is not None:
                self._since_ns = int(t_ns[-min(found.since, len(t_ns))]) - leg.period_ns
        return moved

    @property
    def limits(self) -> Limits:
        """Where the servos stop, as far as is known."""
        batch, row = self._place.batch, self._place.row
        return Limits(batch.lower[row].copy(), batch.upper[row].copy())

    def set_limits(self, limits: Limits) -> None:
        """Put limits in force, also for the samples that are kept."""
        batch, row, joints = self._place.batch, self._place.row, len(self._leg.joints)
        batch.lower[row], batch.upper[row] = limits
        kept = batch.kept_angles[row, :, joints:]
        kept[:] = limits.clip(kept)

    def _check_limits(self) -> bool:
        """Look for where the servos stop, in the samples of a minute."""
        place, limits = self._place, self.limits
        kept = place.batch.kept_angles[place.row, : place.leg.kept_n]
        measured, desired = np.split(kept, 2, axis=1)
        found = find_limits(
            self._leg.chain,
            Limits.from_leg(self._leg),
            limits,
            place.leg.quantum,
            measured,
            desired,
        )
        ends = found.reached(self._leg.joints, desired)
        self.limits_note = SAID.format(ends=ends) if ends else None
        if found is not limits:
            self.set_limits(found)
        return found is not limits

    @property
    def note(self) -> str | None:
        """One line for the operator, None when all is well."""
        cause, found = self.cause, self.check.found or self.check.suspicion
        if cause == "phase":
            return (
                "phase is swapped: the foot swings while the samples say stance; no contacts are "
                "reported until it is right"
            )
        if not self.unproved and (cause is None or found is None):
            return None
        kind, joints = (None, ()) if found is None else (found.kind, found.joints)
        names = ", ".join(self._leg.joints[joint] for joint in joints)
        return (
            f"{_SAID[kind].format(names=names, twin=self._twin)}; no contacts are reported until "
            "then"
        )

    def _find_twin(self, samples: LegMotion) -> LegMotion | None:
        """Return the samples of a leg of the batch that sends the same readings while it moves."""
        batch, newest = self._place.batch, samples.measured[-TWIN_TICKS:]
        if np.ptp(newest, axis=0).max() < TWIN_STEPS * self._place.leg.quantum:
            return None
        for row in range(batch.count):
            read = batch.kept(row, TWIN_TICKS).measured
            if row != self._place.row and np.array_equal(read, newest):
                self._twin = batch.described[row].id
                return batch.kept(row, NEEDED_SAMPLES)
        return None


class RateWatch:
    """Reports what one leg's clock shows: mean rate, jitter, whether ticks or stamps are late.

    Args:
        period_ns: what ticks should be apart.
        place: arrays of the leg, which its tick follows; own ones where absent, to be followed
            with :meth:`follow`.

    Attributes:
        own: scalars of a leg without a place, as compiled code takes them.
    """

    def __init__(self, period_ns: int, place: LegPlace | None = None) -> None:
        self._place = place
        self.own = new_legs(1)
        self.own["period_ns"] = period_ns
        self._ring = np.zeros((1, RING, 3), dtype=np.int64)

    @property
    def burst(self) -> int:
        """Ticks that arrive together, stamped on arrival; 0 where each comes by itself."""
        return int(self.leg.burst) if self.leg.bursts > 1 else 0

    @property
    def jitter(self) -> float:
        """Root mean square of recent deviations from the schedule, periods."""
        return math.sqrt(max(self.leg.jitter_square - self.leg.jitter_mean**2, 0.0))

    @property
    def note(self) -> str | None:
        """One line for the operator while the rate is off, or stamps are far off their schedule."""
        leg, period_ms = self.leg, self.leg.period_ns / 1e6
        if leg.rate_off and not math.isnan(leg.found_ns):
            return (
                f"samples are {leg.found_ns / 1e6:.1f} ms apart, robot.toml says "
                f"{period_ms:.1f} ms: nothing is judged or learned until they agree"
            )
        if self.burst:
            return (
                f"{self.burst} ticks arrive together, stamped on arrival: they are counted by seq; "
                "stamp each reading when it is read, and send it then"
            )
        if self.jitter <= NOTED_JITTER:
            return None
        return (
            f"t_ns jitters: {self.jitter * period_ms:.1f} ms (rms) off an even grid of "
            f"{period_ms:.1f} ms; {_JITTER_CAUSES[int(leg.late)]}"
        )

    def update(self, t_ns: int, seq: int, *, restart: bool) -> int | None:
        """Take in the time and number of an accepted sample.

        Returns:
            Ticks without a reading since the last one, by its number, and where readings are known
            to be late by its time; None where the source has paused: what came before does not
            connect.
        """
        missed = update_one_clock(self.own, self._ring, t_ns, seq, restart)
        return None if missed == PAUSE else int(missed)

    @property
    def leg(self) -> Any:
        """The leg's scalars, by the names of :data:`~adaptive_contact.core.detect.layout.LEG`."""
        return scalars_of(self.own, 0) if self._place is None else self._place.leg


class Seams:
    """Removes the seam of an encoder from one leg's angles, as a tick does.

    Args:
        joints: J.
    """

    def __init__(self, joints: int) -> None:
        self._legs = new_legs(1)
        self._last = np.zeros(joints)

    def unwrap(self, sample: ServoSample, *, restart: bool) -> ServoSample:
        """Return the sample with its angles in one turn."""
        measured, desired = np.array(sample.measured), np.array(sample.desired)
        preview = np.array(sample.preview or ()).reshape(-1, len(desired))
        unwrap(self._legs[0], measured, desired, preview, self._last, restart)
        return msgspec.structs.replace(
            sample,
            measured=measured.tolist(),
            desired=desired.tolist(),
            preview=None if sample.preview is None else preview.tolist(),
        )
