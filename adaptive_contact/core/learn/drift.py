"""Detects drift from the residuals of lift phases.

What presses on a foot presses from below, so a lift that no longer fits the model shows a change of
the leg.  One such lift is suspected: the threshold of this swing widens to the lift's NIS, and
nothing is learned.  Two in a row are a change.  So is a variance scale that crept up without any
suspected lift.  A leg that does not fit again is never valid: it is ambiguous, as a foot that drags
looks the same.

A *level* here is a NIS: of a lift, or followed over lifts as the variance scale.
"""

from __future__ import annotations

import functools
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import scipy
from adaptive_contact.model.labelled_swing import NO_ROWS, Rows
from adaptive_contact.model.noise import UNFIT_LEVEL
from adaptive_contact.wire import Doubt, DriftLevel, Status

# The probability with which a good model's lift is suspected.
SUSPICION_PROBABILITY: Final = 1e-4
SUSPICIONS: Final = 2  # in a row, for a change
# A suspicion is withdrawn when the mean level of so many ticks in a row after it is below this: a
# foot that let go late made it.  A good model's is in 9 of 10, one whose level is 4 in 1 of 20.
TAKE_BACK_TICKS: Final = 3
TAKE_BACK_LEVEL: Final = 1.5
# A tick in which the joints move less than this share of what they did in the lift says nothing.
MOVING_SHARE: Final = 0.5
# Share of a new lift in the followed level, and while adapting.
LEVEL_SHARE: Final = 0.1
LEVEL_SHARE_ADAPTING: Final = 0.8
# A baseline's noise is that of many swings: no level below it is followed.  A prior's is that of
# any leg with such a servo; a leg's own may be a fifth of it.
LEVEL_RANGE: Final = (1.0, 400.0)
LEAST_OWN: Final = 0.04
# Calm lifts in a row after which an adapting leg is valid again.
SETTLED_SWINGS: Final = 3
SETTLED_LEVEL: Final = 2.5
# Swings after which a leg that will not settle is taken for noisier, or, above the level of a worn
# leg (two and a half times the noise), called ambiguous.
PATIENCE_SWINGS: Final = 20
WORN_LEVEL: Final = 6.25
# Lifts between two inflations; and worn lifts in a row that are a change.
INFLATE_EVERY: Final = 5
# A foot that does not rise in so many swings in a row is held by something.
OBSTRUCTED_SWINGS: Final = 2
# Nor does one whose lifts are so much further off (ten times the noise) than any drift takes them:
# the worst of the simulator's, a drive gone twice as soft, came to 80; a foot that is caught and
# still gives is at 115 to 180.  Not of a leg that began with a prior, which may be as far from it.
FAR_LEVEL: Final = 100.0
# It is free again after so many lifts in a row without a sign of that: where little way is asked,
# a foot on a leash comes all of it.
RELEASE_SWINGS: Final = 3
# A baseline whose very first lifts are all off by more than `UNFIT_LEVEL` is of another leg; a leg
# that merely changed overnight is followed instead.  With lifts that fitted by chance it takes
# longer: nine in ten, for as long as a leg is given to settle.
UNFIT_LIFTS: Final = 3
UNFIT_SHARE: Final = 0.9
# Contacts of so many swings in a row, after which a foot in the air carried nothing, are the
# model's error.
REFUTED_SWINGS: Final = 2
# Early contacts: of so many swings, how many are too many, and with how many that ends.  Legs in
# pose that meet obstacles up to the top of every second swing come to 16, walking ones to 5
# (decision 17).
EARLY_SWINGS: Final = 30
EARLY_BEGIN: Final = 22
EARLY_END: Final = 15


class LiftAssessment(NamedTuple):
    """Holds the assessment of a lift."""

    rows: Rows  # to learn from now; none where the lift is suspected
    # the covariance is to be inflated: for a first change, or for one that lasts
    changed: bool = False
    first: bool = False  # the leg was not known to have changed


class DriftMonitor:
    """Follows one leg's variance scale and status, swing by swing.

    Attributes:
        variance_scale: of the residuals over the baseline's, followed from lift to lift.
        status: of the leg: valid, adapting or ambiguous.
        kind: of the newest change, where it is known.

    Args:
        joints: J.
        known: the leg began with a baseline, not with a prior.
    """

    def __init__(self, joints: int, *, known: bool = True) -> None:
        self._known = known
        self._least = LEVEL_RANGE[0] if known else LEAST_OWN
        self.variance_scale = 1.0
        self.status: Status = "valid"
        self.kind: str | None = None
        self._joints = joints
        self._swing_level: float | None = None
        self._suspected = NO_ROWS
        self._suspicions = 0
        self._suspected_ns = 0
        self._lift_rad = 0.0  # way of all joints in a tick of the last lift
        self._newest: deque[float] = deque(maxlen=TAKE_BACK_TICKS)
        self._settled = 0
        self._since_ns: int | None = None
        self._swings_adapting = self._swings_inflated = 0  # since the change, since the inflation
        self._worn_swings = 0
        self._obstructed_swings = self._far_swings = self._free_swings = 0
        self._sign = ""
        self._obstructed_by: Doubt = "held"
        self._counted_free = False  # in this swing
        self._held = False  # in this swing, by its way
        self._trusted = True
        self._lifts = self._lifts_far = 0
        self._unfit_n = 0  # lifts that have to fit until the leg is predicted again
        # Of the last swings, this one included, whether the lift was predicted; None: does not tell
        self._predicted = deque[bool | None](maxlen=2)
        self._refuted = 0  # swings in a row whose contact was refuted

    @property
    def variance_in_force(self) -> float:
        """Variance scale by which this swing is judged."""
        return self.variance_scale if self._swing_level is None else self._swing_level

    @property
    def drift(self) -> DriftLevel:
        """Variance scale, time and kind of the newest change, for the status."""
        return DriftLevel(level=self.variance_scale, since_ns=self._since_ns, kind=self.kind)

    @property
    def unfit(self) -> bool:
        """Whether the model is of another leg: nearly all of the first lifts were far off.

        Not while something may hold the foot: a leg that starts on a leash is this leg all the
        same, and a new start would learn it with its leash.
        """
        far, lifts = self._lifts_far, self._lifts
        if self.obstructed or far < UNFIT_LIFTS:
            return False
        return far == lifts or (lifts >= PATIENCE_SWINGS and far >= UNFIT_SHARE * lifts)

    @property
    def doubt(self) -> Doubt | None:
        """Why the leg is ambiguous; None where it is not."""
        if self.status != "ambiguous":
            return None
        return self._obstructed_by if self.obstructed else "unsettled"

    @property
    def unlearned(self) -> bool:
        """Whether a lift was much further off than before, or contacts were refuted, lately."""
        return self._unfit_n > 0

    @property
    def predicts(self) -> bool | None:
        """Whether the last lifts were predicted; None where none tells."""
        if self.unlearned:
            return False
        return True if any(self._predicted) else None

    @property
    def lifts_assessed(self) -> tuple[int, int]:
        """Lifts so far, and how many of them were far off; to be saved."""
        return self._lifts, self._lifts_far

    @property
    def note(self) -> str | None:
        """One line for the operator, None when all is well."""
        if self.obstructed:
            return (
                f"{self._sign}, {self._obstructed_swings} swings in a row: caught, no strength, or "
                "it strikes or stands on something"
            )
        if self.status == "ambiguous":
            return (
                f"lifts have been {self.variance_scale**0.5:.1f} times as far from the model as "
                f"they should for {self._swings_adapting} swings: a lasting change, or a foot "
                "that drags"
            )
        return None

    def begin_swing(self, *, refuted: bool = False) -> None:
        """Begin a swing: the suspicion of the last one's lift does not widen its threshold.

        Args:
            refuted: the last swing's contact, as the stance after it showed no load.
        """
        self._refuted = self._refuted + 1 if refuted else 0
        if self._refuted >= REFUTED_SWINGS:
            self._unfit_n = SETTLED_SWINGS
        self._swing_level = None
        self._predicted.append(None)
        self._newest.clear()
        self._trusted = not self.obstructed
        self._counted_free = self._held = False

    @property
    def trusted(self) -> bool:
        """Whether the descent of this swing may be learned; not where its lift was not."""
        return self._trusted

    def assess_lift(self, rows: Rows, t_ns: int, *, whole: bool = True) -> LiftAssessment:
        """Assess a lift at its top, and update status and variance scale.

        Args:
            rows: its ticks, at least one, all free.
            t_ns: now.
            whole: they are most of the lift.
        """
        kept = sorted(rows.nis.tolist())[: max(1, len(rows) - 1)]  # one wild reading is no change
        level = sum(kept) / len(kept)
        # What the model predicts is learned, whatever the foot's way says.
        fitting = rows if level < SETTLED_LEVEL else NO_ROWS
        if self._held:
            return LiftAssessment(fitting)
        self._lift_rad = float(np.abs(rows.target).sum(axis=1).mean())
        self._lifts += 1
        self._lifts_far += level > UNFIT_LEVEL
        off = level > SETTLED_LEVEL * max(self.variance_scale, 1.0)
        self._unfit_n = SETTLED_SWINGS if off else max(self._unfit_n - 1, 0)
        if self._predicted and whole:
            self._predicted[-1] = not off
        if level > FAR_LEVEL and self._known:
            return self._assess_far(rows, level, t_ns)
        self._far_swings = 0
        self._count_free()
        if self.obstructed:
            self._swing_level = self._clamp_level(max(level, self.variance_scale))
            self._trusted = bool(fitting)
            return LiftAssessment(fitting)
        if level > _suspicion_limit(self._joints * len(kept)) * self.variance_scale:
            return self._suspect(rows, level, t_ns)
        self._drop_suspicions()
        self._update_level(level)
        if self._crept():
            return self._changed(rows, t_ns)
        self._settle(level)
        return LiftAssessment(rows)

    def distrust(self, since_ns: int) -> None:
        """Drop the suspicion if its lift was at or after a time."""
        if self._suspected_ns >= since_ns:
            self._drop_suspicions()

    def new_clock(self) -> None:
        """Drop all times: those from before do not compare with those to come."""
        self._since_ns = None
        self._drop_suspicions()

    @property
    def watches(self) -> bool:
        """Return whether the ticks of this swing may contradict the suspicion of its lift."""
        return self._swing_level is not None and self._suspicions == 1

    def watch_tick(self, level: float, way_rad: float) -> None:
        """Withdraw the suspicion of a lift if the ticks after it fit.

        Ticks in which the leg hardly moves fit any model.

        Args:
            level: NIS of the tick.
            way_rad: how far the joints were to move in it, added up.
        """
        if not self.watches or way_rad < MOVING_SHARE * self._lift_rad:
            return
        self._newest.append(level)
        limit = TAKE_BACK_LEVEL * self.variance_scale
        if len(self._newest) == TAKE_BACK_TICKS and sum(self._newest) / TAKE_BACK_TICKS < limit:
            self._swing_level = None
            self._drop_suspicions()
            self._trusted = True

    def mark_unchanged(self) -> None:
        """Drop variance scale, time and kind of a change; the status settles by lifts."""
        self.variance_scale, self._since_ns, self.kind = 1.0, None, None

    def record_travel(self, *, obstructed: bool, travel_ratio: float) -> None:
        """Record whether the foot followed its command in the lift.

        A foot that is caught and a leg that has lost its strength look alike.  Of neither is
        anything learned but a lift that the model predicts.

        Args:
            obstructed: whether it did not.
            travel_ratio: share of its command's way that it went.
        """
        if not obstructed:
            if not self._far_swings:  # else a lift has to fit
                self._count_free()
        else:
            self._far_swings, self._held = 0, True
            self._count_obstructed(
                "held", f"the foot came {100 * travel_ratio:.0f} % of its command's way"
            )

    @property
    def obstructed(self) -> bool:
        """Whether the foot seems to be held: then nothing is learned."""
        return self._obstructed_swings >= OBSTRUCTED_SWINGS

    def resume(
        self,
        level: float,
        status: Status,
        *,
        obstructed: bool = False,
        lifts_assessed: tuple[int, int] = (1, 0),
        kind: str | None = None,
    ) -> None:
        """Resume a saved state; its times may be of another clock and are dropped.

        Args:
            level: followed.
            status: of the leg.
            obstructed: whether that was because of a foot that did not rise.
            lifts_assessed: those, and those far off; where not saved, the model is this leg's.
            kind: of the newest change, where it is known.
        """
        self.variance_scale, self.status, self._since_ns = self._clamp_level(level), status, None
        self.kind = kind
        self._obstructed_swings = OBSTRUCTED_SWINGS if obstructed else 0
        self._sign = "the foot was held when the state was saved"
        adapting = {"adapting": 1, "ambiguous": PATIENCE_SWINGS}
        self._swings_adapting = 0 if obstructed else adapting.get(status, 0)
        self._swings_inflated = INFLATE_EVERY  # a suspicion that comes now is of something new
        self._lifts, self._lifts_far = lifts_assessed

    def record_kind(self, kind: str | None) -> None:
        """Record the kind of the newest change, by its evidence so far."""
        self.kind = kind

    def _drop_suspicions(self) -> None:
        self._suspicions, self._suspected = 0, NO_ROWS

    def _suspect(self, rows: Rows, level: float, t_ns: int) -> LiftAssessment:
        self._swing_level = self._clamp_level(level)
        self._suspicions += 1
        self._settled = 0
        self._trusted = self._suspicions >= SUSPICIONS
        if self._suspicions < SUSPICIONS:
            self._suspected, self._suspected_ns = rows, t_ns
            return LiftAssessment(NO_ROWS)
        rows, self._suspected = self._suspected.then(rows), NO_ROWS
        self.variance_scale = self._swing_level**0.5
        assessed = self._changed(rows, self._suspected_ns)
        self._update_level(level)
        return assessed

    def _assess_far(self, rows: Rows, level: float, t_ns: int) -> LiftAssessment:
        """Assess a lift further off than any drift: obstructed, or, if it lasts, another leg."""
        self._swing_level = self._clamp_level(level)
        self._settled = 0
        self._far_swings += 1
        sign = f"the lift is {level**0.5:.0f} times as far from the model as it should be"
        self._count_obstructed("far", sign)
        if self._far_swings < PATIENCE_SWINGS:
            return LiftAssessment(NO_ROWS)
        # The foot comes all its way, and each time so: a horn that slipped, another leg's horn.
        self._far_swings = self._obstructed_swings = 0
        self.variance_scale = self._swing_level**0.5
        self._trusted = True
        return self._changed(rows, t_ns)

    def _count_obstructed(self, by: Doubt, sign: str) -> None:
        self._obstructed_by, self._sign = by, sign
        self._obstructed_swings += 1
        self._free_swings = 0
        self._trusted = False
        if self.obstructed:
            self.status = "ambiguous"
            # They may be of what held the foot, and are no evidence of a change after it.
            self._drop_suspicions()

    def _count_free(self) -> None:
        if not self.obstructed:
            self._obstructed_swings = 0
            return
        if self._counted_free:
            return
        self._counted_free = True
        self._free_swings += 1
        if self._free_swings < RELEASE_SWINGS:
            return
        self._obstructed_swings = self._free_swings = 0
        self._trusted = True
        self.status = "adapting" if self._swings_adapting else "valid"

    def _crept(self) -> bool:
        """Whether the leg has left its model so slowly that no lift was suspected."""
        worn = self.status == "valid" and self.variance_scale > WORN_LEVEL
        self._worn_swings = self._worn_swings + 1 if worn else 0
        return self._worn_swings >= INFLATE_EVERY

    def _changed(self, rows: Rows, since_ns: int) -> LiftAssessment:
        """Set status and counts for a leg that has changed, for the first time or still."""
        first = self._swings_adapting == 0
        if first:
            self.status, self._since_ns, self.kind = "adapting", since_ns, None
            self._worn_swings = 0
        loose = first or self._swings_inflated >= INFLATE_EVERY
        self._swings_inflated = 1 if loose else self._swings_inflated + 1
        self._swings_adapting += 1
        if self._swings_adapting > PATIENCE_SWINGS:
            self.status = "ambiguous"
        return LiftAssessment(rows, loose, first)

    def _update_level(self, level: float) -> None:
        share = LEVEL_SHARE_ADAPTING if self._swings_adapting else LEVEL_SHARE
        mean = (1 - share) * self.variance_scale + share * level
        self.variance_scale = self._clamp_level(mean)

    def _clamp_level(self, level: float) -> float:
        return min(max(level, self._least), LEVEL_RANGE[1])

    def _settle(self, level: float) -> None:
        if self.status == "valid":
            return
        self._swings_adapting += 1
        self._swings_inflated += 1
        self._settled = self._settled + 1 if level < SETTLED_LEVEL else 0
        patient = self._swings_adapting > PATIENCE_SWINGS
        if self._settled >= SETTLED_SWINGS or (patient and self.variance_scale <= WORN_LEVEL):
            self.status = "valid"
            self._swings_adapting = 0
        elif patient:
            self.status = "ambiguous"


class EarlyContacts:
    """Counts the last swings of one leg that reported an early contact.

    A change that shows on descents only leaves every lift as it was, and makes each descent look
    like a contact: nothing is learned from there on.  The foot's height shows it: a foot cannot
    meet the ground in swing after swing where it has hardly begun to come down.

    Attributes:
        reported: early contacts are too many to be contacts.
    """

    def __init__(self) -> None:
        self.reported = False
        self._lately: deque[bool] = deque(maxlen=EARLY_SWINGS)
        self._refuted: deque[bool] = deque(maxlen=EARLY_SWINGS)

    @property
    def refuted(self) -> bool:
        """Whether nothing is in the way: the foot came down after that many of them."""
        return self.reported and sum(self._refuted) >= EARLY_BEGIN

    def count_swing(self, early: bool, *, refuted: bool = False) -> bool:
        """Count a swing; True if it is the one with which the count becomes too high."""
        self._lately.append(early)
        self._refuted.append(early and refuted)
        count, before = sum(self._lately), self.reported
        self.reported = count > EARLY_END if before else count >= EARLY_BEGIN
        return self.reported and not before

    def forget(self) -> None:
        """Drop the counts, as the leg is known to have changed."""
        self.reported = False
        self._lately.clear()
        self._refuted.clear()

    @property
    def note(self) -> str | None:
        """One line for the operator, None when all is well."""
        if not self.reported:
            return None
        return (
            f"in {sum(self._lately)} of {len(self._lately)} swings a touch was reported at the top "
            "of the swing: a change that only descents show, or something that is always in the way"
        )

    def snapshot(self) -> dict[str, Any]:
        """Return the counts, for :meth:`restore`."""
        return {"lately": [int(early) for early in self._lately], "told": self.reported}

    def restore(self, saved: Any) -> None:
        """Take over saved counts; what is not usable is left."""
        if not isinstance(saved, dict) or not isinstance(saved.get("lately"), list):
            return
        self.forget()
        self._lately.extend(bool(early) for early in saved["lately"])
        self.reported = saved.get("told") is True and sum(self._lately) > EARLY_END


@functools.cache
def _suspicion_limit(dof: int) -> float:
    """Mean level of so many degrees of freedom above which a lift is suspected."""
    return float(scipy.special.chdtri(dof, SUSPICION_PROBABILITY)) / dof
