"""Holds the arrays of several legs, and runs the two halves of their tick."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.checks.limits import Limits
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.compiled import records
from adaptive_contact.core.detect.detector import evaluate_tick, predict_next_tick
from adaptive_contact.core.detect.layout import (
    BEGINNING,
    DEPTH,
    FREE,
    FREE_AT,
    KEPT,
    PATH_TICKS,
    PLACES,
    RING,
    SAMPLE,
    SHARED,
    SOURCES,
    STATE,
    TICK,
    new_legs,
    scalars_of,
    vectors,
)
from adaptive_contact.core.detect.regressors import term_table
from adaptive_contact.core.detect.swing import UNKNOWN, tabulate
from adaptive_contact.model.free_motion import FreeMotion
from adaptive_contact.model.labelled_swing import ROW
from adaptive_contact.model.library import ChangeLibrary, Library
from adaptive_contact.model.noise import CONTEXTS, DIRECTIONS
from adaptive_contact.robot import Leg
from adaptive_contact.robot.description import DetectorSettings
from adaptive_contact.wire import ServoSample

STATUS_TICKS: Final = 256


class LegBatch:
    """Holds the arrays of L legs whose models share a library of J joints and p terms.

    Args:
        legs: L descriptions.
        library: of their models.
        quantum_rad: position step of each leg's servos.
        period_ns: control tick.
        max_step: rad per tick, beyond which a reading is impossible.
        detector: the owner's settings; the defaults where absent.
        capacity: rows of a swing held back at first; grows.

    Attributes:
        legs: scalars of every leg, see :mod:`adaptive_contact.core.detect.layout`.
        accepted: (L,) of these, which legs have a sample in this tick.
        vectors: of floats, of integers and of booleans; each has a name there, and so it has here.
        preview_in: (previews, J) rad, commands to come that the sample has.
        ring: (101, 3) time, number and scheduled time of the newest samples, ns.
        kept_angles, kept_stamps: (3000, 2 J) rad, measured and desired, and (3000, 3) time, number
            and phase of the newest samples, a ring.
        parts: see :mod:`adaptive_contact.core.detect.source`.
        links: (J, 6), see :func:`~adaptive_contact.core.detect.swing.tabulate`.
        path: (400, J) rad, commands of the swing.
        history: (2, 3, J) rad, residuals and predicted increments, lag 0 first.
        thetas: (3, p), regressors of the last ticks.
        xi0: (q, J) coefficients of the first model, for the terms of changes.
        coefficients: (p, J) of the model in force.
        whiten: (contexts, 3, J, J), 1/rad, of sums of one to three residuals.
        domain: (p, p) matrix whose product with regressors has the leverage as squared length.
        index, per_scale, root: (J, n), (J, n) and (J, n, n), covariance of the coefficients while
            it is inflated: n terms of each joint, reciprocal scales, square root.
        rows, row_values: rows of the swing until it is resolved, as
            :class:`~adaptive_contact.model.labelled_swing.Rows` has them.
        free_ring: (256, J) rad, residuals of the newest free ticks.
        depths: of all legs: measured lags of a window, and commands to come.
        some, room: scratch of all legs: (6, J) and (8, J), rows by names in
            :mod:`adaptive_contact.core.detect.history`.
        now, sums, forms: scratch of all legs: (3,) m, a place; (2, J) and (2 J,), what a statistic
            and regressors add up.
    """

    # Those of the vectors that swings' judgements read.
    measured: Array
    desired: Array
    valid: Mask
    lower: Array
    upper: Array
    asked: Array
    start: Array
    foot: Array
    heights: Array
    lengths_ticks: Ints
    axis_kinds: Ints
    window: Array
    began_window: Array
    sigma: Array
    unit: Array
    scores: Array

    def __init__(
        self, legs: Sequence[Leg], library: Library, quantum_rad: Sequence[float], period_ns: int,
        *, max_step: float, detector: DetectorSettings | None = None, capacity: int = 96,
    ) -> None:  # fmt: skip
        rows, joints = len(legs), len(library.joints)
        shape = library.window
        self.described = tuple(legs)
        self.library, self.count = library, rows
        self.table = term_table(library)
        self.lags = shape.past_measured + 1
        self.preview = shape.preview
        self.depths = np.array([self.lags, self.preview])
        depth = self.lags + shape.past_desired + 1 + shape.preview
        q, p = len(self.table.kind), library.size
        f, b, i = np.float64, np.bool_, np.int64

        def zeros(*shape: int, dtype: Any = f) -> Any:
            return np.zeros((rows, *shape), dtype=dtype)

        self.legs = legs_ = new_legs(rows, detector)
        lengths = {"J": joints, "p": p, "w": depth * joints}
        self.vectors, self.places = vectors(rows, lengths)
        self._name_vectors()
        self.unit[:] = 1.0
        self.preview_in = zeros(shape.preview, joints)
        # Stream, source and swing.
        self.ring = zeros(RING, 3, dtype=i)
        self.kept_angles, self.kept_stamps = zeros(KEPT, 2 * joints), zeros(KEPT, 3, dtype=i)
        self.parts = zeros(3, 4)
        self.links, self.path = zeros(joints, 6), zeros(PATH_TICKS, joints)
        # History.
        self.history, self.thetas = zeros(2, DEPTH, joints), zeros(DEPTH, p)
        # What is known of free motion.
        self.xi0, self.coefficients = zeros(q, joints), zeros(p, joints)
        self.whiten = zeros(CONTEXTS, DEPTH, joints, joints)
        self.limits = zeros(DIRECTIONS, DEPTH)  # thresholds
        self.index = zeros(joints, 0, dtype=i)
        self.per_scale, self.root = zeros(joints, 0), zeros(joints, 0, 0)
        self.domain = zeros(p, p)
        # Labels.
        self.rows = records(np.zeros((rows, capacity), dtype=ROW))
        self.row_values = zeros(capacity, p + 2 * joints)
        self.free_ring = zeros(STATUS_TICKS, joints)
        # Scratch.
        self.some, self.room = np.zeros((6, joints), dtype=b), np.zeros((8, joints))
        self.now, self.sums = np.zeros(3), np.zeros((2, joints))
        self.forms = np.zeros(2 * joints)
        for row, leg in enumerate(legs):
            legs_[row]["quantum"] = quantum_rad[row]
            legs_[row]["max_step"] = max_step
            legs_[row]["length"] = shape.length
            legs_[row]["period_ns"] = period_ns
            legs_[row]["has_lengths"] = leg.chain is not None
            self.lower[row], self.upper[row] = Limits.none(joints)
            if leg.chain is not None:
                legs_[row]["leg_size"] = leg.chain.size
                self.links[row], self.axis_kinds[row] = tabulate(leg.chain)

        self._gather()

    def __getstate__(self) -> dict[str, Any]:
        return {name: of for name, of in vars(self).items() if name not in _BOUND}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._name_vectors()
        self._gather()

    def _name_vectors(self) -> None:
        """Name the parts of the arrays that have several."""
        self.accepted = self.legs["accepted"]
        for name, (slot, at) in PLACES.items():
            first, last = self.places[at]
            setattr(self, name, self.vectors[SOURCES.index(slot)][:, first:last])

    def _gather(self) -> None:
        """Bind the two halves of a tick to the arrays as they are."""
        floats, ints, bools = self.vectors
        arrays = {
            **vars(self), **self.table._asdict(), "floats": floats,
            "ints": ints, "bools": bools,
        }  # fmt: skip
        self._evaluate_tick = TICK.bind(evaluate_tick, arrays)
        self._predict_next_tick = TICK.bind(predict_next_tick, arrays)

    @property
    def flags(self) -> list[int]:
        """Flags of the last tick of each leg."""
        found: list[int] = self.legs["found"].tolist()
        return found

    def evaluate_tick(self) -> int:
        """Evaluate the samples, the first half of a tick; returns the flags of all legs, in one."""
        found: int = self._evaluate_tick()
        return found

    def predict_next_tick(self) -> None:
        """Predict the next tick, the second half of one."""
        most = self._predict_next_tick()
        if most + 2 > self.rows.shape[1]:
            self.grow()

    @classmethod
    def from_places(cls, places: Sequence[LegPlace]) -> LegBatch:
        """Move legs of equal libraries into one batch."""
        first = places[0].batch
        batch = cls(
            [leg for place in places for leg in [place.batch.described[place.row]]], first.library,
            [place.leg.quantum for place in places], int(first.legs["period_ns"][0]),
            max_step=float(first.legs["max_step"][0]),
        )  # fmt: skip
        for row, place in enumerate(places):
            place.move(batch, row)
        return batch

    def alike(self, other: LegBatch) -> bool:
        """Return whether rows of another batch fit into this one, and mean the same."""
        ours, theirs = self.library, other.library
        return ours is theirs or ours == theirs

    def kept(self, row: int, most: int = KEPT) -> LegMotion:
        """Return the newest samples of a leg.

        Args:
            row: of the leg.
            most: number of samples.
        """
        count = int(self.legs["kept_n"][row])
        at = np.arange(max(count - most, 0), count) % KEPT
        # Indexed, it takes five times as long.
        t_ns, seq, phases = self.kept_stamps[row].take(at, axis=0).T
        measured, desired = np.split(self.kept_angles[row].take(at, axis=0), 2, axis=1)
        swing = None if (phases == UNKNOWN).any() else phases == 1
        # Counted from the first, as numbers of any size are.
        return LegMotion(t_ns, seq - seq[:1], measured, desired, swing)

    def adopt(self, row: int, other: LegBatch, of: int) -> None:
        """Copy a row of another batch: what fits, where its library is another."""
        whole = self.alike(other)
        while self.rows.shape[1] < other.rows.shape[1]:
            self.grow()
        if whole:
            self.make_room(other.index.shape[2])
        for name, mine in vars(self).items():
            theirs = vars(other).get(name)
            if not isinstance(mine, np.ndarray) or name in _OF_NO_LEG or theirs is None:
                continue
            if name in _OF_ROWS or name in _OF_TERMS:
                if whole:
                    mine[row][tuple(slice(n) for n in theirs.shape[1:])] = theirs[of]
            elif mine.shape[1:] == theirs.shape[1:] and (whole or name not in _OF_MODEL):
                mine[row] = theirs[of]

    def grow(self) -> None:
        """Make room for longer swings."""
        for name in _OF_ROWS:
            kept = getattr(self, name)
            grown = np.concatenate([kept, np.zeros_like(kept)], axis=1)
            setattr(self, name, records(grown) if name == "rows" else grown)
        self._gather()

    def make_room(self, terms: int) -> None:
        """Make room for the covariance of so many terms of each joint."""
        more = terms - self.index.shape[2]
        if more > 0:
            for name in _OF_TERMS:
                kept = getattr(self, name)
                setattr(self, name, np.pad(kept, [(0, 0)] * 2 + [(0, more)] * (kept.ndim - 2)))
            self._gather()

    def forget_past(self, row: int) -> None:
        """Forget a row's past under its last model, as another begins."""
        for name in _OF_MODEL:
            getattr(self, name)[row] = 0
        leg = scalars_of(self.legs, row)
        for name in ("filled", "impossible", "unsure", "refused_n", "reach_ticks", "values_n"):
            setattr(leg, name, 0)
        for name in ("usable", "thetas_n", "root_n"):
            setattr(leg, name, 0)
        leg.predicted = leg.bad = leg.seen = False
        leg.sound, leg.reading_variance = True, 1.0


# What is made of the arrays, and belongs to no other process.
_BOUND: Final = ("_evaluate_tick", "_predict_next_tick", "accepted", *PLACES)
_OF_ROWS: Final = ("rows", "row_values")
_OF_TERMS: Final = ("index", "per_scale", "root")
# Scratch, what is of all legs, and what is adopted by other names.
_OF_NO_LEG: Final = (*SHARED, "places", "accepted")
# What belongs to a model and to the past under it.
_OF_MODEL: Final = (
    "window", "history", "increment", "theta", "thetas", "began_window", "reach", "last_good",
    "last", "suspects", "stale", "refused", "values", "counts", "xi0", "coefficients", "index",
    "per_scale", "root", "domain",
)  # fmt: skip


_PHASES: Final = {None: -1, "stance": 0, "swing": 1}


def _bytes(array: NDArray[Any]) -> memoryview:
    """Return the bytes of a contiguous array, to be written to."""
    return array.reshape(-1).view(np.uint8).data


class LegPlace:
    """Locates a leg's arrays: a row of a batch.

    Attributes:
        batch: that has them.
        row: of the leg.
        leg: its scalars, read and written by name.
        record: the same, as compiled code takes them.
    """

    __slots__ = (
        "_judged_by", "_write_angles", "_write_free", "_write_sample", "batch", "leg", "record",
        "row",
    )  # fmt: skip

    def __init__(self, batch: LegBatch, row: int = 0) -> None:
        self._judged_by: FreeMotion | None = None
        self._locate(batch, row)

    def move(self, batch: LegBatch, row: int) -> None:
        """Move the arrays to a row of another batch."""
        batch.adopt(row, self.batch, self.row)
        self._locate(batch, row)

    def set_sample(self, sample: ServoSample, lost: int, restart: bool) -> None:
        """Write an accepted sample into the arrays of the next tick."""
        batch, row = self.batch, self.row
        missing = sample.valid is not None and not all(sample.valid)
        self._write_sample(
            sample.t_ns, sample.seq, lost, _PHASES[sample.phase], True, restart, missing
        )
        self._write_angles(*sample.measured, *sample.desired)
        if missing:
            batch.valid[row] = sample.valid
        if batch.preview:
            ahead = sample.preview or ()
            count = self.leg.preview_n = min(len(ahead), batch.preview)
            batch.preview_in[row, :count] = ahead[:count] if count else 0.0

    def drop_tick(self) -> None:
        """Drop the present tick."""
        self.leg.accepted = self.leg.unfinished = False
        self.leg.found = 0

    def drop_rows(self) -> None:
        """Drop what is held back of the present swing, which is not labelled then."""
        leg = self.leg
        leg.row_n = leg.lift_n = leg.commanded_n = 0
        leg.broken = True

    def restart_swing(self) -> None:
        """Forget the present swing, and whether the leg carries."""
        leg = self.leg
        for name in ("whole", "stood", "obstructed", "has_desired", "has_measured", "unresolved"):
            setattr(leg, name, False)
        for name in ("surface", "touch_at", "touch_before"):
            setattr(leg, name, -np.inf)
        for name in ("ticks", "after", "heights_n", "low_n", "low_next", "still", "lift_n"):
            setattr(leg, name, 0)
        leg.row_n = leg.commanded_n = 0
        leg.hole_ns, leg.apex = -1, -np.inf
        for name in ("swing_phase", "topped", "closed", "top_seen"):
            setattr(leg, name, False)
        for name in STATE:
            setattr(leg, name, BEGINNING.get(name, 0))
        leg.broken = True

    def begin(self, library: ChangeLibrary, sigma: Array, *, learning: bool) -> None:
        """Prepare the arrays for a model that takes over.

        Args:
            library: of the model.
            sigma: (J,) rad, deviation of its residuals at the start.
            learning: anything is learned at all.
        """
        leg, batch, row = self.leg, self.batch, self.row
        leg.has_model, leg.learning = True, learning
        batch.xi0[row], batch.sigma[row] = library.first, sigma
        self._judged_by = None

    def end(self) -> None:
        """Mark that no model is in force."""
        self.leg.has_model = False

    def set_free_motion(self, free: FreeMotion) -> None:
        """Write what is known of free motion into the arrays of the next ticks."""
        leg, batch, row, before = self.leg, self.batch, self.row, self._judged_by
        self._write_free(
            free.variance_scale, free.changed, free.covariance is not None, free.from_prior,
            free.sure, free.after_known,
        )  # fmt: skip
        if before is None or free.whiten is not before.whiten:
            batch.whiten[row] = free.whiten
        if before is None or free.thresholds is not before.thresholds:
            batch.limits[row] = free.thresholds
        if before is None or free.domain is not before.domain:
            leg.has_domain = free.domain is not None
            if free.domain is not None:
                reach = free.domain.reach
                batch.domain[row] = 0.0
                batch.domain[row, : len(reach), : len(reach)] = reach
        if free.covariance is not None:
            terms, per_scale, root = free.covariance
            n = leg.root_n = terms.shape[1]
            batch.make_room(n)
            batch.index[row, :, :n], batch.per_scale[row, :, :n] = terms, per_scale
            batch.root[row, :, :n, :n] = root
        batch.coefficients[row] = free.coefficients
        self._judged_by = free

    def predict_by(self, coefficients: Array) -> None:
        """Put a model's (p, J) coefficients in force; the rest of free motion is as it was."""
        self.batch.coefficients[self.row] = coefficients

    def __getstate__(self) -> tuple[LegBatch, int, FreeMotion | None]:
        return self.batch, self.row, self._judged_by

    def __setstate__(self, state: tuple[LegBatch, int, FreeMotion | None]) -> None:
        batch, row, self._judged_by = state
        self._locate(batch, row)

    def _locate(self, batch: LegBatch, row: int) -> None:
        self.batch, self.row, self.record = batch, row, batch.legs[row]
        self.leg: Any = scalars_of(batch.legs, row)
        joints = batch.measured.shape[1]
        scalars, floats = _bytes(batch.legs[row : row + 1]), _bytes(batch.vectors[0][row])
        self._write_sample = partial(SAMPLE.pack_into, scalars, 0)
        self._write_free = partial(FREE.pack_into, scalars, FREE_AT)
        self._write_angles = partial(struct.Struct(f"{2 * joints}d").pack_into, floats, 0)

    @property
    def free_rms(self) -> list[float]:
        """(J,) rad, root mean square of the newest free residuals; zeros without any."""
        kept = self.batch.free_ring[self.row]
        count = max(1, min(self.leg.free_n, len(kept)))
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
