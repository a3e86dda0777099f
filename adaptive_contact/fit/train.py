"""Learns a baseline from recorded free motion.

Every figure that a threshold rests on comes from residuals of swings the model was not fitted to:
swings are dealt into folds, each fold is predicted by a model of the others, and λ, covariances and
tails are taken from those predictions.  The model that is kept is then fitted to all of them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.core.detect.swing import AFTER_TICKS
from adaptive_contact.core.detect.swing_labels import LAST_TICKS
from adaptive_contact.errors import IdentificationError, TooLittleDataError
from adaptive_contact.fit.held_out import HeldOut, Manner, strength_of, swept
from adaptive_contact.fit.outliers import inliers, untouched
from adaptive_contact.fit.sparse_regression import Fit, FitSettings, fit_sparse
from adaptive_contact.model.glr import stream_statistic
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library, LibraryName, leg_library
from adaptive_contact.model.model_file import Baseline, LegBaseline
from adaptive_contact.model.noise import (
    AFTER,
    MIN_TICKS,
    SPEEDS,
    WINDOWS,
    context,
    fit_noise,
    lagged,
)
from adaptive_contact.model.peaks import Peaks
from adaptive_contact.model.tail import fit_tail, tail_ticks
from adaptive_contact.model.window import Window, stack
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.gait_phase import LIFT_OFF_TICKS, directions

FOLDS: Final = 5
# Swings of one fold in a row, so that neighbours, which share posture and drift, stay together.
FOLD_SWINGS: Final = 10
# Where there are too few swings for that: each is a fold, or part of it.
MOST_FOLDS: Final = 10
# λ in units of the residual's own root mean square: a term that moves the prediction by less
# than a fiftieth of the noise cannot be distinguished from none; one that moves it by all is law.
SWEEP: Final = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Holds one leg's samples without a gap."""

    measured: Array  # (n, J) rad
    desired: Array  # (n, J) rad
    swing: Mask  # (n,) in swing
    free: Mask  # (n,) known, or assumed, to touch nothing
    sound: Mask  # (n,) all readings of the tick are good
    certain: bool = True  # free is known; else it is assumed, and some of it may have touched


@dataclasses.dataclass(frozen=True)
class LegFigures:
    """Holds the figures of how well one leg was learned."""

    rows: int  # free ticks used, and `outliers` left out of them
    outliers: int
    swings: int  # they come from
    touched: int  # of these, in which the foot touched, by what stands out; 0 where free is known
    threshold: float  # λ that was chosen, in units of the residual
    held_out_rms: tuple[float, ...]  # (J,) rad at that λ
    naive_rms: tuple[float, ...]  # (J,) rad of predicting no motion
    terms: tuple[int, ...]  # (J,) kept, of `library_size`
    library_size: int
    # how firmly the fit holds on to what is known of any leg; None where nothing is (`prior`)
    strength: float | None = None
    determined: bool = True  # by the motions, all terms


@dataclasses.dataclass(frozen=True)
class Training:
    """Holds a learned baseline and how good it is."""

    baseline: Baseline  # of the legs that could be learned
    figures: dict[str, LegFigures]  # by leg
    # legs that were recorded but could not be learned, and why
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Rows:
    """Holds the free ticks of one leg, stretches end to end; ``position`` is where a row sits."""

    theta: Array  # (n, p)
    target: Array  # (n, J)
    where: Ints  # (n,) context
    swing: Ints  # (n,) number, from 1 over all stretches
    position: Ints  # (n,) tick, with gaps of at least 3 between swings
    judged: Mask  # (n,) what a detector would judge in a swing: not its first ticks
    after: Mask  # (n,) after the turn to stance
    swings: int
    outliers: int = 0  # left out, and in how many swings the foot touched
    touched: int = 0

    @property
    def usable(self) -> Ints:
        """(n,) of those judged, how many windows end there: lags are missing from some lag on."""
        histories = _histories(self.target[self.judged], self.position[self.judged])
        return np.asarray(np.isfinite(histories).all(axis=2).sum(axis=1))

    def where_true(self, keep: Mask) -> Rows:
        """Select rows by an (n,) mask."""
        names = ("theta", "target", "where", "swing", "position", "judged", "after")
        return dataclasses.replace(self, **{name: getattr(self, name)[keep] for name in names})


def learn(
    robot: Robot,
    streams: Mapping[str, Sequence[Stretch]],
    *,
    origin: str,
    library: LibraryName = "servo",
    window: Window | None = None,
    threshold: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Training:
    """Learn every leg that has samples.

    Args:
        robot: its description.
        streams: by leg.
        origin: one line on where the samples come from.
        library: the terms to choose from.
        window: past and future to look at.
        threshold: λ, in units of the residual; chosen on held-out swings where absent.
        progress: called with each leg as it begins.

    Raises:
        IdentificationError: no leg has enough to learn from.
    """
    legs: dict[str, LegBaseline] = {}
    figures: dict[str, LegFigures] = {}
    skipped: dict[str, str] = {}
    short: list[TooLittleDataError] = []
    statistics: list[Array] = []
    gathered: dict[str, tuple[Library, Rows]] = {}
    for leg in robot.legs:
        stretches = streams.get(leg.id)
        if not stretches:
            continue
        terms = leg_library(robot, leg, library, window)
        try:
            gathered[leg.id] = terms, gather_rows(leg, terms, stretches, robot.quantum(leg.id))
        except TooLittleDataError as error:  # a leg that only stood, perhaps
            skipped[leg.id] = str(error)
            short.append(error)
    if gathered:  # said before a minute of fits
        usable = np.concatenate([rows.usable for _, rows in gathered.values()])
        tail_ticks(int(np.count_nonzero(usable == len(WINDOWS))))
    for leg_id, (terms, rows) in gathered.items():
        progress(leg_id)
        try:
            legs[leg_id], figures[leg_id], values = learn_leg(
                robot.leg(leg_id), terms, rows, robot.quantum(leg_id), threshold
            )
        except IdentificationError as error:
            skipped[leg_id] = str(error)
            continue
        statistics.append(values)
    if short and not legs:
        worst = max(short, key=lambda error: error.needed / max(error.have, 1))
        raise TooLittleDataError(_describe_skipped(skipped), worst.have, worst.needed)
    if not legs:
        raise IdentificationError(
            _describe_skipped(skipped)
            or "no leg has two samples in a row; expected robot/leg/*/servo of "
            + ", ".join(robot.leg_ids)
        )
    pooled = np.concatenate(statistics)
    tails = tuple(fit_tail(pooled[:, w]) for w in range(len(WINDOWS)))
    baseline = Baseline(robot.name, origin, robot.quantum_rad, legs, tails)
    return Training(baseline, figures, skipped)


def _describe_skipped(skipped: Mapping[str, str]) -> str:
    """Describe in one line why no leg could be learned; legs of one reason together."""
    legs_of: dict[str, list[str]] = {}
    for leg, why in skipped.items():
        legs_of.setdefault(why.replace(f"leg '{leg}': ", ""), []).append(leg)
    return "; ".join(f"leg {', '.join(legs)}: {why}" for why, legs in legs_of.items())


def gather_rows(
    leg: Leg, library: Library, stretches: Sequence[Stretch], quantum_rad: float
) -> Rows:
    """Gather the free ticks of one leg; what stands out is left out.

    Args:
        leg: its description.
        library: the terms to choose from.
        stretches: its samples.
        quantum_rad: position step of its servos.

    Raises:
        TooLittleDataError: there is too little to learn from.
    """
    rows = free_rows(leg, library, stretches, quantum_rad)
    _check_enough(leg, library, rows)
    keep = inliers(library, rows.theta, rows.target, rows.position, quantum_rad)
    touched = 0
    if not all(stretch.certain for stretch in stretches):
        keep[keep], touched = untouched(
            rows.theta[keep], rows.target[keep], rows.position[keep], quantum_rad, tail=True
        )
    outliers = int(np.count_nonzero(~keep))
    rows = dataclasses.replace(rows.where_true(keep), outliers=outliers, touched=touched)
    _check_enough(leg, library, rows)
    return rows


def learn_leg(
    leg: Leg, library: Library, rows: Rows, quantum_rad: float, threshold: float | None
) -> tuple[LegBaseline, LegFigures, Array]:
    """Learn one leg.

    Args:
        leg: its description.
        library: the terms to choose from.
        rows: its free ticks.
        quantum_rad: position step of its servos.
        threshold: λ in units of the residual; chosen on held-out swings where None.

    Returns:
        What is known then, how good it is, and (n, windows) of the statistic on free ticks.

    Raises:
        IdentificationError: they cannot be learned from.
    """
    # After the turn the drive comes to rest, which says little of how it moves: those ticks have a
    # noise, and the coefficients are of the swings alone.
    swinging = rows.where_true(~rows.after)
    held = HeldOut(swinging.theta, swinging.target, _folds(swinging))
    naive = _rms(swinging.target)
    still: Mask = naive < quantum_rad  # the readings of such joints may be constant
    rounding = quantum_rad / 12**0.5
    plain = _checked(leg, fit_sparse(held.whole, FitSettings()), still)
    manner = Manner(library, quantum_rad, tuple(np.maximum(plain.rms, rounding).tolist()))
    lambdas = SWEEP if threshold is None else (threshold,)
    strength, determined = strength_of(held, manner, still, rounding)
    if strength is not None:
        manner = manner.holding(held, strength)
    best = swept(held, manner, lambdas, still, rounding)
    if best is None:
        raise IdentificationError(
            f"leg '{leg.id}': λ = {threshold} removes every term of a joint; give a smaller one"
        )
    fit = manner.fit(held.whole, best.threshold)
    fit = _checked(leg, fit, still)
    model = LegModel(library, fit.coefficients)

    # Noise and statistic from the ticks, and the windows, that a detector would judge.
    judged = rows.judged | rows.after
    residual = rows.target - rows.theta @ fit.coefficients
    residual[~rows.after] = best.certain
    residual = residual[judged]
    position, where, after = rows.position[judged], rows.where[judged], rows.after[judged]
    histories = _histories(residual, position)
    noise = fit_noise(histories, where, quantum_rad)
    motion = _histories(rows.target[judged] - residual, position)
    usable = np.isfinite(histories).all(axis=2).sum(axis=1)
    values = stream_statistic(histories, motion, where, usable, noise)
    figures = LegFigures(
        rows=len(swinging.target),
        outliers=rows.outliers,
        swings=rows.swings,
        touched=rows.touched,
        threshold=best.threshold,
        held_out_rms=tuple(_rms(best.residual).tolist()),
        naive_rms=tuple(naive.tolist()),
        terms=tuple(int(n) for n in model.support.sum(axis=0)),
        library_size=library.size,
        strength=manner.strength,
        determined=determined,
    )
    scale = held.whole.scale()
    known = LegBaseline(model, noise, scale, len(swinging.target), manner.domain(held.whole))
    peaks = Peaks.from_values(values, where // SPEEDS)
    return dataclasses.replace(known, peaks=peaks), figures, values[~after]


def _check_enough(leg: Leg, library: Library, rows: Rows) -> None:
    """Refuse what is too little for the terms, or for the noise."""
    whole = int(np.count_nonzero(rows.usable == len(WINDOWS)))
    for ticks, least, what in (
        (int(np.count_nonzero(~rows.after)), 4 * library.size, f"{library.size} terms"),
        (whole, MIN_TICKS, f"the noise of sums over {len(WINDOWS)} ticks"),
    ):
        if ticks < least:
            raise TooLittleDataError(
                f"leg '{leg.id}': {ticks} free swing ticks for {what}; expected at least {least}: "
                "record more swings",
                ticks,
                least,
            )


def free_rows(leg: Leg, library: Library, stretches: Sequence[Stretch], quantum_rad: float) -> Rows:
    """Gather the free ticks of one leg, as :func:`gather_rows`, with what stands out."""
    parts: list[tuple[Array | Ints | Mask, ...]] = []  # of the rows, in the order of `Rows`
    swings = 0
    offset = 0
    for stretch in stretches:
        cut = stack(stretch.measured, stretch.desired, library.window)
        turned = swing_ticks(~stretch.swing)  # ticks after the turn
        # What a leg does after the turn is learned where it is known to touch nothing there.
        after = stretch.certain & (turned > 0) & (turned <= AFTER_TICKS)
        use = (stretch.swing | after) & stretch.free & stretch.sound
        sound = np.ones(len(cut.tick), dtype=bool)
        for lag in range(library.window.length):
            sound &= stretch.sound[cut.tick - lag]
        rows = np.flatnonzero(sound & use[cut.tick] & use[cut.tick + 1])
        number = swings + np.cumsum(np.diff(stretch.swing.astype(int), prepend=0) == 1)
        swings = int(number[-1]) if len(number) else swings
        heading = directions(stretch.desired, leg)
        tick = cut.tick[rows]
        before = stretch.desired[np.maximum(tick - 1, 0)]
        # The row of tick k predicts tick k + 1, which is what would be judged.
        heading = np.where(turned[tick + 1] > 1, AFTER, heading[tick])
        parts.append(
            (
                library.evaluate(cut.measured[rows], cut.desired[rows], cut.preview[rows]),
                cut.increment[rows],
                context(stretch.desired[tick], before, heading, quantum_rad),
                number[tick],
                offset + tick,
                swing_ticks(stretch.swing)[tick + 1] > LIFT_OFF_TICKS,
                turned[tick + 1] > 1,
            )
        )
        offset += len(stretch.measured) + len(WINDOWS)
    theta, target, where, swing, position, judged, later = map(
        np.concatenate, zip(*parts, strict=True)
    )
    return Rows(theta, target, where, swing, position, judged, later, swings)


def swing_ticks(swing: Mask) -> Ints:
    """Count (n,) ticks of the swing at every tick, 1 at the first, 0 in stance."""
    ticks = np.arange(len(swing))
    last_stance = np.maximum.accumulate(np.where(swing, -1, ticks))
    return np.asarray(np.where(swing, ticks - last_stance, 0))


def cautious(swing: Mask) -> Mask:
    """Select the part of every swing that is free with some certainty, without truth.

    Args:
        swing: (n,).

    Returns:
        (n,) True but for the first ticks of each swing (foot still loaded) and its last ones (a
        touch may have ended it).
    """
    from_start = swing_ticks(swing)
    to_end = swing_ticks(swing[::-1])[::-1]
    return np.asarray(swing & (from_start > LIFT_OFF_TICKS) & (to_end > LAST_TICKS))


def _folds(rows: Rows) -> Ints:
    """(n,) fold of each row."""
    if rows.swings >= FOLDS * FOLD_SWINGS:
        return np.asarray(rows.swing // FOLD_SWINGS % FOLDS)
    # Few swings, and long: each for itself, cut where there are too few to hold some out.
    part = rows.swing - 1
    pieces = -(-MOST_FOLDS // max(rows.swings, 1))
    if pieces > 1:
        part = part * pieces
        for swing in range(1, rows.swings + 1):
            inside = np.flatnonzero(rows.swing == swing)
            part[inside] += np.arange(len(inside)) * pieces // max(len(inside), 1)
    return np.asarray(part % MOST_FOLDS)


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt(np.square(values).mean(axis=0)))


def _histories(values: Array, position: Ints) -> Array:
    """(n, J) to (n, windows, J), lag 0 first, NaN where the tick before is not there."""
    out = lagged(values, len(WINDOWS))
    for lag in range(1, len(WINDOWS)):
        apart = np.ones(len(values), dtype=bool)
        apart[lag:] = position[lag:] - position[:-lag] != lag
        out[apart, lag:] = np.nan
    return out


def _checked(leg: Leg, fit: Fit, still: Mask) -> Fit:
    if not fit.usable(still):
        raise IdentificationError(
            f"leg '{leg.id}': the fit ended with '{fit.status}' on {fit.rows:.0f} rows; "
            "record more, and more varied, free swings"
        )
    return fit
