"""Follows one leg's model: level of the residuals, recursion, refits, return to what was known.

The lift is the witness.  What presses on a foot presses from below, so a lift that no longer fits
the model speaks of the leg.  Once in a row that is only doubted: for this swing the threshold
widens to what the lift shows, and nothing is learned.  Twice in a row it is taken for a change:
the recursion is loosened along the ways in which legs change, and learns from the lifts at once.
"""

from __future__ import annotations

import dataclasses
import enum
from collections import deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from adaptive_contact.adapt.baseline import LegBaseline
from adaptive_contact.adapt.buffer import SlidingBuffer
from adaptive_contact.adapt.challenger import Challenger
from adaptive_contact.adapt.directions import core_support, drift_directions
from adaptive_contact.adapt.kinds import kind_of_change
from adaptive_contact.adapt.refit import Refitter
from adaptive_contact.adapt.segments import Row
from adaptive_contact.adapt.snapshot import (
    FORMAT,
    ImplausibleError,
    array_of,
    library_key,
    pack,
    segment_of,
    unpack_segment,
)
from adaptive_contact.identify import LegModel
from adaptive_contact.identify.recursive import RecursiveLeastSquares
from adaptive_contact.wire import DriftLevel, RefitCounts, Status

__all__ = ["Follower", "LearnerMode"]

Array = NDArray[np.float64]

# A good model's lift exceeds the doubt level once in so many; the slack is for what a covariance
# of one context does not tell of another.
DOUBT_PROBABILITY: Final = 1e-4
DOUBT_SLACK: Final = 1.5
DOUBTS: Final = 2  # in a row, for a change
# A doubt is taken back when the mean level of so many ticks in a row after it is below this: a foot
# that let go late made it.  A good model's is in 9 of 10, one whose level is 4 in 1 of 20.
TAKE_BACK_TICKS: Final = 3
TAKE_BACK_LEVEL: Final = 1.5
# Share of a new lift in the followed level, and while adapting.
LEVEL_SHARE: Final = 0.1
LEVEL_SHARE_ADAPTING: Final = 0.8
LEVEL_RANGE: Final = (1.0, 400.0)
# Calm lifts in a row after which an adapting leg is valid again.
SETTLED_SWINGS: Final = 3
SETTLED_LEVEL: Final = 2.5
# Swings after which a leg that will not settle is called ambiguous, or taken for noisier.
PATIENCE_SWINGS: Final = 20
LOOSEN_EVERY: Final = 5
# A foot that does not rise in so many swings in a row is held by something.
HELD_SWINGS: Final = 2
# A baseline whose very first lifts are all further off than this (five times the noise) is of
# another leg; a leg that merely changed overnight is followed instead.
UNFIT_LEVEL: Final = 25.0
UNFIT_LIFTS: Final = 3
# The baseline is taken up again when it has been this much better for so many lifts.
RETURN_RATIO: Final = 0.6
RETURN_SWINGS: Final = 3
# Confirmed ticks whose times are kept for who asks (`drain_confirmed`): some 150 swings.
CONFIRMED_TICKS: Final = 2048
# A term never moves a tick by more than this; the fastest servos make 0.5 rad in one.
MAX_TERM_RAD: Final = 2.0


class LearnerMode(enum.StrEnum):
    """How a learner follows its leg; the lesser ones are there for comparison."""

    FROZEN = "frozen"
    UNGATED = "ungated"
    REFIT = "refit"
    RLS = "rls"
    FULL = "full"


class Follower:
    """The adapting part of one leg's learner.

    Args:
        leg: its id.
        known: the baseline.
        mode: what it may do.
        refitter: does the sparse refits.
    """

    def __init__(self, leg: str, known: LegBaseline, mode: LearnerMode, refitter: Refitter) -> None:
        self.mode = mode
        self.model = known.model
        self.level = 1.0  # followed: squared whitened residual over J on free ticks
        self.status: Status = "valid"
        self.buffer = SlidingBuffer()
        self.confirmed_ns: deque[int] = deque(maxlen=CONFIRMED_TICKS)
        self._leg = leg
        self._baseline = known.model
        self._noise = known.noise.rms
        self._scale = known.scale
        self._rls = self._recursion(known.model)
        self._swing_level: float | None = None
        self._queue: deque[Row] = deque()
        self._doubted: list[Row] = []
        self._doubts = 0
        self._doubted_ns = 0
        self._since_doubt: deque[float] = deque(maxlen=TAKE_BACK_TICKS)
        self._settled = 0
        self._since_ns: int | None = None
        self._swings_adapting = 0
        self._better_baseline = 0
        self._era = 0
        self._loose_swings = 0
        self._challenger = Challenger(leg, self._noise, self._scale, refitter)
        self._held_swings = 0
        self._lifts = self._lifts_far = 0
        self._kind: str | None = None

    # -- what the detector asks -------------------------------------------------------------------

    @property
    def learning(self) -> bool:
        """Whether this follower does anything at all."""
        return self.mode is not LearnerMode.FROZEN

    @property
    def gated(self) -> bool:
        """Whether it learns from what is confirmed only, and lifts are heard as witnesses."""
        return self.mode not in (LearnerMode.FROZEN, LearnerMode.UNGATED)

    def variance(self, theta: Array) -> Array | float:
        """Factor on the residual's variance at a tick: the level, and the model's own doubt.

        Args:
            theta: (p,) regressors of the prediction.

        Returns:
            (J,) or one number.
        """
        level = self.level_in_force
        if self._loose_swings > 0:
            return level * (1.0 + self._rls.uncertainty(theta))
        return level

    @property
    def level_in_force(self) -> float:
        """The level by which this swing is judged."""
        return self.level if self._swing_level is None else self._swing_level

    @property
    def drift(self) -> DriftLevel:
        """For the status."""
        return DriftLevel(level=self.level, since_ns=self._since_ns, kind=self._kind)

    @property
    def refits(self) -> RefitCounts:
        """For the status."""
        return self._challenger.counts

    # -- what the learner tells -------------------------------------------------------------------

    def begin_swing(self) -> None:
        """A new swing: doubts of the last one's lift are not carried over."""
        self._swing_level = None

    def learn_now(self, row: Row) -> None:
        """Ungated: any tick is learned as it comes, contact or not."""
        self._rls.update(row.theta, row.target)
        self._publish()

    def lift(self, rows: list[Row], region: int, t_ns: int) -> None:
        """The top of a swing has been passed.

        Args:
            rows: ticks of the lift, all free.
            region: of the workspace.
            t_ns: now.
        """
        if not rows:
            return
        levels = np.sort([row.level for row in rows])
        joints = len(self._noise)
        kept = levels[: max(1, len(levels) - 1)]  # one wild reading is no change
        level = float(kept.mean())
        self._lifts += 1
        self._lifts_far += level > UNFIT_LEVEL
        dof = joints * len(kept)
        limit = DOUBT_SLACK * float(stats.chi2.isf(DOUBT_PROBABILITY, dof)) / dof
        if level > limit * self.level:
            self._doubt(rows, level, region, t_ns)
            return
        self._doubts = 0
        self._doubted = []
        self._accept(rows, level, region)
        self._settle(level, t_ns)

    def look(self, level: float) -> None:
        """Take in the level of a tick after the lift: a doubt that it belies is taken back."""
        if self._swing_level is None or self._doubts != 1:
            return
        self._since_doubt.append(level)
        if len(self._since_doubt) < TAKE_BACK_TICKS:
            return
        if sum(self._since_doubt) < TAKE_BACK_LEVEL * TAKE_BACK_TICKS * self.level:
            self._swing_level = None
            self._doubts, self._doubted = 0, []

    def descent(self, rows: list[Row], region: int) -> None:
        """The confirmed part of a descent."""
        self._confirm(rows, region)

    def foot_held(self, held: bool) -> None:
        """Tell whether the foot failed to rise with its command in the swing that ends.

        A foot that is caught and a leg that has lost its strength look alike; neither is learned.
        """
        self._held_swings = self._held_swings + 1 if held else 0
        if self._held_swings >= HELD_SWINGS:
            self.status = "ambiguous"
        elif self.status == "ambiguous" and not held and self._swings_adapting == 0:
            self.status = "valid"

    @property
    def unfit(self) -> bool:
        """Whether the baseline was never this leg's: its first lifts were all far off."""
        return self._lifts_far >= UNFIT_LIFTS and self._lifts_far == self._lifts

    @property
    def note(self) -> str | None:
        """One line for a person, None when all is well."""
        if self._held_swings >= HELD_SWINGS:
            return f"the foot did not rise in {self._held_swings} swings: caught, or no strength"
        if self.status == "ambiguous":
            return (
                f"lifts stay {self.level**0.5:.1f} times as far from the model as they should: "
                "a lasting change, or a foot that drags"
            )
        return None

    def swing_done(self) -> None:
        """A swing has been resolved."""
        self._loose_swings = max(0, self._loose_swings - 1)
        if self.mode in (LearnerMode.REFIT, LearnerMode.FULL):
            self._challenger.swing_done(self.model, self.buffer, self._era)

    def tick(self, budget: int) -> None:
        """Once per control tick: learn a few rows, collect a result that is due."""
        if self._queue:
            for _ in range(min(budget, len(self._queue))):
                row = self._queue.popleft()
                self._compare(row)
                self._rls.update(row.theta, row.target)
            self._publish()
        self._challenger.tick()

    def snapshot(self) -> dict[str, Any]:
        """What has been learned, for :meth:`restore`."""
        return {
            "format": FORMAT,
            "library": library_key(self.model.library),
            "baseline": pack(self._baseline.coefficients),
            "coefficients": pack(self.model.coefficients),
            "version": self.model.version,
            "factor": pack(self._rls.factor),
            "support": pack(self._rls.support.astype(np.float64)),
            "level": self.level,
            "status": self.status,
            "since_ns": self._since_ns,
            "era": self._era,
            "loose_swings": self._loose_swings,
            "refits": self._challenger.snapshot(),
            "segments": [segment_of(s) for s in self.buffer.segments],
        }

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        p, joints = self.model.coefficients.shape
        try:
            if saved.get("format") != FORMAT:
                raise ImplausibleError(
                    f"its format is {saved.get('format')!r}, this version's {FORMAT}"
                )
            if saved.get("library") != library_key(self.model.library):
                raise ImplausibleError(
                    "it belongs to another library, other joints or another rate"
                )
            baseline = array_of(saved.get("baseline"), (p, joints), "its baseline")
            if not np.allclose(baseline, self._baseline.coefficients, rtol=0, atol=1e-9):
                raise ImplausibleError("it was learned from another baseline")
            coefficients = array_of(saved.get("coefficients"), (p, joints), "its model")
            # A model that moves a typical tick by radians is none of a servo's.
            if np.abs(coefficients * self._scale[:, None]).max() > MAX_TERM_RAD:
                raise ImplausibleError("its model is implausible")
            support = array_of(saved.get("support"), (p, joints), "its support") > 0.5
            # A promoted model has a support of its own.
            rls = RecursiveLeastSquares(coefficients, support, self._scale, self._noise)
            q = len(rls.terms)
            factor = array_of(saved.get("factor"), (joints, q, q), "its covariance")
            segments = [unpack_segment(s, p, joints) for s in saved.get("segments", [])]
            version, level, era = saved.get("version"), saved.get("level"), saved.get("era")
            if not (isinstance(version, int) and isinstance(era, int) and version >= 0):
                raise ImplausibleError("its version or era is no number")
            if not (isinstance(level, float) and LEVEL_RANGE[0] <= level <= LEVEL_RANGE[1]):
                raise ImplausibleError(f"its level is {level!r}")
            status = saved.get("status")
            if status not in ("valid", "adapting", "ambiguous"):
                raise ImplausibleError(f"its status is {status!r}")
        except ImplausibleError as problem:
            return f"snapshot of leg '{self._leg}' not used: {problem}"
        self.model = dataclasses.replace(self.model, coefficients=coefficients, version=version)
        self._rls = rls
        self._rls.restore(coefficients, factor)
        self.level, self._era, self.status = level, era, status
        self._loose_swings = int(saved.get("loose_swings", 0))
        self._since_ns = None  # of another clock, perhaps
        self._challenger.restore(saved.get("refits"))
        self.buffer.restore(segments)
        return None

    # -- private ----------------------------------------------------------------------------------

    def _doubt(self, rows: list[Row], level: float, region: int, t_ns: int) -> None:
        self._swing_level = float(np.clip(level, *LEVEL_RANGE))
        self._since_doubt.clear()
        self._doubts += 1
        self._settled = 0
        if self._doubts < DOUBTS:
            self._doubted = rows
            self._doubted_ns = t_ns
            return
        if self.status != "adapting" or self._swings_adapting >= LOOSEN_EVERY:
            self._change([*self._doubted, *rows], self._doubted_ns)
        self._swings_adapting += 1
        self.level = self._swing_level**0.5
        self._accept([*self._doubted, *rows], level, region)
        self._doubted = []
        if self._swings_adapting > PATIENCE_SWINGS:
            self.status = "ambiguous"

    def _change(self, rows: list[Row], since_ns: int) -> None:
        """Something about the leg has changed: let the recursion move."""
        if self.status != "adapting":
            self._since_ns = since_ns
            theta = np.array([row.theta for row in rows])
            residual = np.array([row.target for row in rows]) - theta @ self.model.coefficients
            self._kind = kind_of_change(theta, residual, self.model, self._noise)
        self.status = "adapting"
        self._swings_adapting = 0
        self._era += 1
        if self.mode in (LearnerMode.RLS, LearnerMode.FULL):
            self._loose_swings = PATIENCE_SWINGS
            self._rls.loosen(drift_directions(self.model, self._scale, self._noise))
        self._challenger.withdraw()

    def _accept(self, rows: list[Row], level: float, region: int) -> None:
        share = LEVEL_SHARE_ADAPTING if self.status == "adapting" else LEVEL_SHARE
        self.level = float(np.clip((1 - share) * self.level + share * level, *LEVEL_RANGE))
        self._consider_baseline(rows)
        self._confirm(rows, region)

    def _confirm(self, rows: list[Row], region: int) -> None:
        rows = [row for row in rows if row.cleared]
        self.confirmed_ns.extend(row.t_ns for row in rows)
        self.buffer.add(rows, region, self._era)
        if self.mode in (LearnerMode.RLS, LearnerMode.FULL):
            self._queue.extend(rows)
        else:
            for row in rows:
                self._compare(row)

    def _settle(self, level: float, t_ns: int) -> None:
        if self.status == "valid":
            return
        self._swings_adapting += 1
        self._settled = self._settled + 1 if level < SETTLED_LEVEL else 0
        patient = self._swings_adapting > PATIENCE_SWINGS
        if self._settled >= SETTLED_SWINGS or patient:
            self.status = "valid"
            self._since_ns = self._kind = None
            self._swings_adapting = 0

    def _consider_baseline(self, rows: list[Row]) -> None:
        """Mud is washed off, a battery is changed: what was known may hold again."""
        if self.model.version == 0:
            return
        now = self._error(rows, self.model.coefficients)
        before = self._error(rows, self._baseline.coefficients)
        self._better_baseline = self._better_baseline + 1 if before < RETURN_RATIO * now else 0
        if self._better_baseline < RETURN_SWINGS:
            return
        self._better_baseline = 0
        self._rls = self._recursion(self._baseline)
        self._queue.clear()
        self._challenger.rolled_back(f"the baseline fits {RETURN_SWINGS} lifts better")
        self._publish()
        self.level = 1.0
        self._era += 1

    def _compare(self, row: Row) -> None:
        """Let a candidate, if there is one, be tried on a row before it is learned."""
        promoted = self._challenger.compare(row, self.model)
        if promoted is not None:
            self.model = promoted
            self._rls = self._recursion(promoted)

    def _error(self, rows: list[Row], coefficients: Array) -> float:
        theta = np.array([row.theta for row in rows])
        target = np.array([row.target for row in rows])
        return float(np.square((target - theta @ coefficients) / self._noise).mean())

    def _recursion(self, model: LegModel) -> RecursiveLeastSquares:
        return RecursiveLeastSquares(
            model.coefficients, core_support(model), self._scale, self._noise
        )

    def _publish(self) -> None:
        coefficients = self._rls.coefficients
        if not np.isfinite(coefficients).all():
            self._rls = self._recursion(self._baseline)
            self._challenger.rolled_back("a coefficient was not finite")
            coefficients = self._rls.coefficients
        self.model = dataclasses.replace(
            self.model, coefficients=coefficients, version=max(1, self.model.version)
        )
