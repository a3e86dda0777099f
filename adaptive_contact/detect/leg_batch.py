"""Holds the arrays of several legs, and runs the two halves of their tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from adaptive_contact.compiled import records
from adaptive_contact.detect.detector import finish_tick, judge_tick
from adaptive_contact.detect.echo import COMMANDS, LAGS
from adaptive_contact.detect.layout import (
    ASKED,
    DEPTH,
    HEIGHTS,
    LOW_TICKS,
    PATH_TICKS,
    RING,
    ROW,
    SWINGS,
    VALUES,
    new_legs,
)
from adaptive_contact.detect.regressors import term_table
from adaptive_contact.detect.swing import tabulate
from adaptive_contact.model.free_motion import FreeMotion
from adaptive_contact.model.library import ChangeLibrary, Library
from adaptive_contact.model.noise import CONTEXTS
from adaptive_contact.robot import Leg
from adaptive_contact.wire import ServoSample

__all__ = ["LegBatch", "LegPlace"]

Array = NDArray[np.float64]

STATUS_TICKS: Final = 256


class LegBatch:
    """Holds the arrays of L legs whose models share a library of J joints and p terms.

    Args:
        legs: L descriptions.
        library: of their models.
        quantum_rad: position step of each leg's servos.
        period_ns: control tick.
        capacity: rows of a swing held back at first; grows.

    Attributes:
        legs: scalars of every leg, see :mod:`adaptive_contact.detect.layout`.
        window: measured positions, then commands, then preview, newest first, rad.
        history: (2, 3, J) rad, residuals and predicted increments, lag 0 first.
        theta, thetas: (p,) and (3, p), regressors of the next tick and of the last ones.
        unit: (J,) variance of this tick's residuals over the baseline's.
        limits, limits_awaited: (windows,) thresholds, in a swing and after the turn to stance.
        domain: (p, p) matrix whose product with regressors has the leverage as squared length.
        index, per_scale, root, sizes: covariance of the coefficients while it is inflated.
        rows, row_thetas, row_targets, row_asides: rows of the swing until it is resolved.
        scores: (windows,) test ratios of this tick.
        free_ring: residuals of the newest free ticks, rad.
    """

    def __init__(
        self, legs: Sequence[Leg], library: Library, quantum_rad: Sequence[float], period_ns: int,
        *, max_step: float, capacity: int = 96,
    ) -> None:  # fmt: skip
        rows, joints = len(legs), len(library.joints)
        shape = library.window
        self.described = tuple(legs)
        self.library, self.count = library, rows
        self.open = np.zeros(rows, dtype=np.bool_)
        self.table = term_table(library)
        self.lags = shape.past_measured + 1
        self.preview = shape.preview
        depth = self.lags + shape.past_desired + 1 + shape.preview
        q, p, n = len(self.table.kind), library.size, library.size
        f, b, i = np.float64, np.bool_, np.int64

        def zeros(*shape: int, dtype: Any = f) -> Any:
            return np.zeros((rows, *shape), dtype=dtype)

        self.legs = legs_ = new_legs(rows)
        # A tick's samples.
        self.accepted, self.restart = zeros(dtype=b), zeros(dtype=b)
        self.lost, self.t_ns, self.seq = zeros(dtype=i), zeros(dtype=i), zeros(dtype=i)
        self.phase = zeros(dtype=np.int8)
        self.measured, self.desired = zeros(joints), zeros(joints)
        self.valid, self.has_valid = zeros(joints, dtype=b), zeros(dtype=b)
        self.preview_in, self.preview_n = zeros(shape.preview, joints), zeros(dtype=i)
        # Stream and clock.
        self.ring = zeros(RING, 3, dtype=i)
        self.seam, self.command, self.before = zeros(joints), zeros(joints), zeros(joints)
        # Source.
        self.echo_commands = zeros(COMMANDS, joints)
        self.echo_runs = zeros(joints, LAGS, 5)
        self.echo_runs[..., 4] = -1.0
        self.echo_off, self.echoing = zeros(joints, dtype=i), zeros(joints, dtype=b)
        self.phase_before, self.parts = zeros(joints), zeros(3, 4)
        # Swing.
        self.links, self.turns = zeros(joints, 6), zeros(joints, dtype=np.int8)
        self.low, self.lengths_ticks = zeros(LOW_TICKS), zeros(SWINGS, dtype=i)
        self.last_desired, self.last_measured = zeros(joints), zeros(joints)
        self.last_read = zeros(joints)
        self.path, self.asked = zeros(PATH_TICKS, joints), zeros(ASKED)
        self.commanded, self.foot, self.start = zeros(3), zeros(3), zeros(3)
        self.heights = zeros(HEIGHTS)
        # History.
        self.window = zeros(depth * joints)
        self.history = zeros(2, DEPTH, joints)
        self.increment = zeros(joints)
        self.theta, self.thetas = zeros(p), zeros(DEPTH, p)
        self.began_window = zeros(depth * joints)
        self.reach, self.believed, self.last = zeros(joints), zeros(joints), zeros(joints)
        self.doubts = zeros(joints, dtype=b)
        self.stale, self.refused = zeros(joints, dtype=i), zeros(joints, dtype=b)
        self.values, self.counts = zeros(VALUES + 1), zeros(VALUES + 1, dtype=i)
        # What is known of free motion.
        self.xi0, self.coefficients = zeros(q, joints), zeros(p, joints)
        self.whiten = zeros(CONTEXTS, DEPTH, joints, joints)
        self.limits, self.limits_awaited = zeros(DEPTH), zeros(DEPTH)
        self.sigma, self.unit = zeros(joints), np.ones((rows, joints))
        self.index = zeros(joints, n, dtype=i)
        self.per_scale, self.root = zeros(joints, n), zeros(joints, n, n)
        self.sizes = zeros(dtype=i)
        self.domain = zeros(p, p)
        # Labels.
        self.rows = np.zeros((rows, capacity), dtype=ROW)
        self.row_thetas, self.row_targets = zeros(capacity, p), zeros(capacity, joints)
        self.row_asides = zeros(capacity, joints)
        self.free_ring = zeros(STATUS_TICKS, joints)
        self.scores = zeros(DEPTH)
        # Scratch.
        self.bools = np.zeros((6, joints), dtype=b)
        self.floats, self.room = np.zeros((9, joints)), np.zeros(2 * joints)
        self.now, self.sums = np.zeros(3), np.zeros((2, joints))
        for row, leg in enumerate(legs):
            legs_[row]["quantum"] = quantum_rad[row]
            legs_[row]["max_step"] = max_step
            legs_[row]["length"] = shape.length
            legs_[row]["period_ns"] = period_ns
            legs_[row]["has_lengths"] = leg.chain is not None
            if leg.chain is not None:
                self.links[row], self.turns[row] = tabulate(leg.chain)

    @property
    def flags(self) -> list[int]:
        """Flags of the last tick of each leg."""
        found: list[int] = self.legs["found"].tolist()
        return found

    def judge(self) -> int:
        """Run the first half of a tick; returns the flags of all legs, in one."""
        self.open |= self.accepted
        found: int = judge_tick(
            records(self.legs), self.accepted, self.restart, self.lost, self.t_ns, self.seq,
            self.phase, self.measured, self.desired, self.valid, self.has_valid, self.preview_in,
            self.ring, self.seam, self.echo_commands, self.echo_runs, self.echo_off,
            self.echoing, self.phase_before, self.parts, self.command, self.before, self.links,
            self.turns, self.low, self.lengths_ticks, self.last_desired, self.last_measured,
            self.last_read, self.path, self.asked, self.commanded, self.foot, self.start,
            self.heights, self.window, self.lags, self.preview, self.history, self.increment,
            self.theta, self.thetas, self.began_window, self.reach, self.believed, self.last,
            self.doubts, self.stale, self.refused, self.values, self.counts, *self.table,
            self.xi0, self.coefficients, self.whiten, self.limits, self.limits_awaited,
            self.sigma, self.unit, self.index, self.per_scale, self.root, self.sizes,
            self.domain, records(self.rows), self.row_thetas, self.row_targets, self.row_asides,
            self.free_ring, self.scores, self.bools, self.floats, self.room, self.now, self.sums,
        )  # fmt: skip
        return found

    def finish(self) -> None:
        """Run the second half of a tick."""
        finish_tick(
            records(self.legs), self.open, self.desired, self.preview_in, self.preview_n,
            self.command, self.before, self.window, self.lags, self.preview, self.increment,
            self.theta, *self.table, self.xi0, self.coefficients, self.room,
        )  # fmt: skip
        self.open[:] = False
        if self.legs["row_n"].max() + 2 > self.rows.shape[1]:
            self.grow()

    @classmethod
    def of(cls, places: Sequence[LegPlace]) -> LegBatch:
        """Bring legs of equal libraries into one batch."""
        first = places[0].batch
        batch = cls(
            [leg for place in places for leg in [place.batch.described[place.row]]], first.library,
            [float(place.leg["quantum"]) for place in places], int(first.legs["period_ns"][0]),
            max_step=float(first.legs["max_step"][0]),
        )  # fmt: skip
        for row, place in enumerate(places):
            place.move(batch, row)
        return batch

    def alike(self, other: LegBatch) -> bool:
        """Tell whether rows of another batch fit into this one, and mean the same."""
        ours, theirs = self.library, other.library
        return ours is theirs or ours == theirs

    def adopt(self, row: int, other: LegBatch, of: int) -> None:
        """Copy a row of another batch: what fits, where its library is another."""
        whole = self.alike(other)
        while whole and self.rows.shape[1] < other.rows.shape[1]:
            self.grow()
        for name, mine in vars(self).items():
            theirs = vars(other).get(name)
            if not isinstance(mine, np.ndarray) or name in _SCRATCH or theirs is None:
                continue
            if name in _OF_ROWS:
                if whole:
                    mine[row, : theirs.shape[1]] = theirs[of]
            elif mine.shape[1:] == theirs.shape[1:] and (whole or name not in _OF_MODEL):
                mine[row] = theirs[of]

    def grow(self) -> None:
        """Make room for longer swings."""
        for name in _OF_ROWS:
            kept = getattr(self, name)
            setattr(self, name, np.concatenate([kept, np.zeros_like(kept)], axis=1))

    def forget_past(self, row: int) -> None:
        """Forget a row's past under its last model, as another begins."""
        for name in _OF_MODEL:
            getattr(self, name)[row] = 0
        leg = self.legs[row]
        for name in ("filled", "impossible", "unsure", "refused", "reach_ticks", "values_n"):
            leg[name] = 0
        for name in ("usable", "thetas_n"):
            leg[name] = 0
        leg["predicted"] = leg["bad"] = leg["seen"] = False
        leg["sound"], leg["inflation"] = True, 1.0


_OF_ROWS: Final = ("rows", "row_thetas", "row_targets", "row_asides")
_SCRATCH: Final = ("bools", "floats", "room", "now", "sums")
# What belongs to a model and to the past under it.
_OF_MODEL: Final = (
    "window", "history", "increment", "theta", "thetas", "began_window", "reach", "believed",
    "last", "doubts", "stale", "refused", "values", "counts", "xi0", "coefficients", "index",
    "per_scale", "root", "sizes", "domain",
)  # fmt: skip


_PHASES: Final = {None: -1, "stance": 0, "swing": 1}


class LegPlace:
    """Locates a leg's arrays: a row of a batch.

    Attributes:
        batch: that has them.
        row: of the leg.
        leg: its scalars.
    """

    __slots__ = ("_judged_by", "batch", "leg", "row")

    def __init__(self, batch: LegBatch, row: int = 0) -> None:
        self.batch, self.row, self.leg = batch, row, batch.legs[row]
        self._judged_by: FreeMotion | None = None

    def move(self, batch: LegBatch, row: int) -> None:
        """Move the arrays to a row of another batch."""
        batch.adopt(row, self.batch, self.row)
        self.batch, self.row, self.leg = batch, row, batch.legs[row]

    def take(self, sample: ServoSample, *, lost: int, restart: bool) -> None:
        """Put an accepted sample in, for the next tick to judge."""
        batch, row = self.batch, self.row
        batch.accepted[row], batch.restart[row], batch.lost[row] = True, restart, lost
        batch.t_ns[row], batch.seq[row] = sample.t_ns, sample.seq
        batch.phase[row] = _PHASES[sample.phase]
        batch.measured[row], batch.desired[row] = sample.measured, sample.desired
        missing = sample.valid is not None and not all(sample.valid)
        batch.has_valid[row] = missing
        if missing:
            batch.valid[row] = sample.valid
        if batch.preview:
            ahead = sample.preview or ()
            count = batch.preview_n[row] = min(len(ahead), batch.preview)
            batch.preview_in[row, :count] = ahead[:count] if count else 0.0

    @property
    def at(self) -> tuple[LegBatch, int]:
        """The batch and the row."""
        return self.batch, self.row

    def sample(self, taken: ServoSample) -> ServoSample:
        """Return the sample that was taken, with its angles in one turn."""
        measured = self.batch.measured[self.row].tolist()
        desired = self.batch.desired[self.row].tolist()
        return msgspec.structs.replace(taken, measured=measured, desired=desired)

    def drop_tick(self) -> None:
        """Drop the present tick."""
        self.batch.accepted[self.row] = self.batch.open[self.row] = False
        self.leg["found"] = 0

    def restart_swing(self) -> None:
        """Forget the present swing."""
        leg = self.leg
        for name in ("whole", "stood", "obstructed", "has_desired", "has_measured", "open"):
            leg[name] = False
        for name in ("surface", "touch_at", "touch_before"):
            leg[name] = -np.inf
        for name in ("ticks", "after", "heights_n", "low_n", "low_at", "still", "lift_n", "row_n"):
            leg[name] = 0
        leg["commanded_n"], leg["hole_ns"], leg["apex"] = 0, -1, -np.inf
        for name in ("swing_phase", "topped", "closed", "top_seen", "touching"):
            leg[name] = False
        leg["broken"] = True

    def begin(self, library: ChangeLibrary, sigma: Array, *, gated: bool, learning: bool) -> None:
        """Prepare the arrays for a model that takes over.

        Args:
            library: of the model.
            sigma: (J,) rad, deviation of its residuals at the start.
            gated: what is learned is confirmed first.
            learning: anything is learned at all.
        """
        leg, batch, row = self.leg, self.batch, self.row
        leg["known"], leg["gated"], leg["learning"] = True, gated, learning
        batch.xi0[row], batch.sigma[row] = library.first, sigma
        self._judged_by = None

    def end(self) -> None:
        """Mark that no model is in force."""
        self.leg["known"] = False

    def judge_by(self, free: FreeMotion) -> None:
        """Put what is known of free motion into the arrays that ticks judge by."""
        leg, batch, row, before = self.leg, self.batch, self.row, self._judged_by
        leg["variance_scale"], leg["changed"] = free.variance_scale, free.changed
        leg["inflated"] = free.covariance is not None
        if before is None or free.thresholds is not before.thresholds:
            batch.whiten[row] = free.whiten
            batch.limits[row], batch.limits_awaited[row] = free.thresholds, free.awaited
        if before is None or free.domain is not before.domain:
            leg["has_domain"] = free.domain is not None
            if free.domain is not None:
                reach = free.domain.reach
                batch.domain[row] = 0.0
                batch.domain[row, : len(reach), : len(reach)] = reach
        if free.covariance is not None:
            terms, per_scale, root = free.covariance
            n = batch.sizes[row] = terms.shape[1]
            batch.index[row, :, :n], batch.per_scale[row, :, :n] = terms, per_scale
            batch.root[row, :, :n, :n] = root
        if free.coefficients is not None:
            batch.coefficients[row] = free.coefficients
        self._judged_by = free

    @property
    def free_rms(self) -> list[float]:
        """(J,) rad, root mean square of the newest free residuals; zeros without any."""
        kept = self.batch.free_ring[self.row]
        count = max(1, min(int(self.leg["free_n"]), len(kept)))
        rms: list[float] = np.sqrt(np.square(kept).sum(axis=0) / count).tolist()
        return rms

    @property
    def window(self) -> Array:
        """(lags, J) rad, measured, desired and preview, as a prediction is made from."""
        joints = self.batch.measured.shape[1]
        return np.asarray(self.batch.window[self.row].reshape(-1, joints))

    @property
    def residuals(self) -> Array:
        """(3, J) rad, the newest first."""
        return np.asarray(self.batch.history[self.row, 0])

    @property
    def increments(self) -> Array:
        """(3, J) rad that were predicted, the newest first."""
        return np.asarray(self.batch.history[self.row, 1])
