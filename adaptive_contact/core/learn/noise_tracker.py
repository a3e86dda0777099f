r"""Follows the covariance of a leg's residuals, and its thresholds.

A baseline's covariances and thresholds are of the day it was learned.  A joint that has grown
noisier, a reading that has become rougher, a model that fits one direction less well show in the
confirmed free ticks, and only there: a contact is never among them.

The *shape* of the covariance follows.  With Z the whitened residuals of the buffer under the model
in force, :math:`S = (Z^\top Z + n_0 s I) / (n + n_0)`, shrunk towards the baseline's and normed to
a mean variance of one: how large it is on the whole, the drift monitor's level says.

Thresholds follow where the baseline knows the leg's own free maxima
(:mod:`adaptive_contact.model.peaks`), up to those of its tail: by the median of the last lifts'
maxima.  A joint that reads more coarsely shows in the next lifts, a foot that strikes something in
few of them.

Neither is ever narrowed: a leg with a baseline that fits better by chance is not judged more
strictly for it.  A leg that began with a prior takes its thresholds from its own last lifts,
descents and, where it hangs, ticks after the turn (decision 53).
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.model_file import thresholds_of
from adaptive_contact.model.noise import AFTER, DESCENT, LIFT, NoiseModel
from adaptive_contact.model.peaks import LEAST_TICKS, Peaks, beyond
from adaptive_contact.model.tail import Tail

# The baseline's covariance weighs like so many ticks; the buffer holds some 700 (decision 9).
SHRINK_TICKS: Final = 1000.0
# A residual further out than so many of its deviations counts as if it were there.
CLIP: Final = 3.0
# A foot that has not touched at its turn to stance is about to: 0.13 of those ticks begin
# a touch, 0.012 of those in swings (eight planned walks of 90 s).  At so many times the target
# rate, which is 1.3e-4 per tick, one alarm there in a thousand is false.
AWAITED: Final = 70.0
# Lifts whose maxima are looked at: half of them decide.
RECENT_LIFTS: Final = 8
# Their median strays by as much on a leg that has not changed.
STRAY: Final = 1.3
# The largest of fewer ticks says nothing.
LEAST_ROWS: Final = 3
# Names of the largest test ratios in a saved state.
OWN: Final = ("own", "own_descents", "own_after")
# Of a leg from a prior the last so many lifts say how far below its thresholds it stays, once
# there are so many; but no lower than to this share, which is what noise of a fifth asks for.
OWN_LIFTS, LEAST_LIFTS = 40, 15
LEAST_SHARE: Final = 0.2
# Of a leg that hangs, which no ground can have pressed on, they may ask for so many times more.
MOST_HUNG: Final = 4.0
# After the turn a leg that hangs may stray further than the prior's noise, up to so many times.
MOST_AFTER: Final = 25.0


class NoiseTracker:
    """Follows covariances and thresholds of one leg, from a baseline and confirmed free ticks.

    Args:
        noise: of the baseline.
        tails: (windows,) of the baseline's statistic.
        peaks: of its free ticks, where those are known.
        false_alarms_per_hour: target rate.

    Attributes:
        whiten: (contexts, windows, J, J).
        thresholds: (directions, windows) of the statistic.
    """

    def __init__(
        self,
        noise: NoiseModel,
        tails: tuple[Tail, ...],
        false_alarms_per_hour: float,
        peaks: Peaks | None = None,
    ) -> None:
        self._of_baseline = np.array(noise.whiten, order="C")
        self._target_rate = false_alarms_per_hour
        self._peaks = peaks
        self._of_prior = tails[0].ticks == 0
        self._lifts = deque[float](maxlen=RECENT_LIFTS)  # how large their maxima were
        # Of a leg from a prior: the largest test ratios of its lifts and of its descents, by the
        # pooled thresholds and the prior's noise, each with its ticks.
        self._own_lifts = deque[tuple[float, int]](maxlen=OWN_LIFTS)
        self._own_descents = deque[tuple[float, int]](maxlen=OWN_LIFTS)
        self._own_after = deque[tuple[float, int]](maxlen=OWN_LIFTS)
        self._shares = np.ones(3)  # of the pooled thresholds that these ask for, by direction
        self._pooled = self._thresholds_from_tails(tails)
        self.whiten: Array = noise.whiten
        self.thresholds: Array = self._compute_thresholds()

    def count(self, rows: Rows, scale: float = 1.0) -> None:
        """Count the largest statistics in free rows of a leg whose lifts fit.

        Args:
            rows: of a lift, or of a descent; the latter count for a leg from a prior only, as soft
                ground may be among the last.
            scale: variance by which they were judged, over the baseline's.
        """
        if self._peaks is None and self._of_prior:
            after = rows.records["after"]
            self._count_own(rows[~after], LIFT if rows.lifting else DESCENT, scale)
            if (after & ~rows.records["high"]).any():  # of a leg that hangs
                self._count_own(rows[after], AFTER, scale)
            self._share(scale)
        elif (
            rows.lifting
            and len(rows) >= LEAST_ROWS
            and self._peaks is not None
            and self._peaks.ticks[LIFT] >= LEAST_TICKS
        ):
            largest = float(np.fmax.reduce(rows.records["value"], initial=0.0))
            self._lifts.append(self._peaks.excess(largest, len(rows)))
        self.thresholds = self._compute_thresholds()

    def _count_own(self, rows: Rows, direction: int, scale: float) -> None:
        if rows:
            ratio = float(np.fmax.reduce(rows.records["ratio"], initial=0.0))
            own = ratio * float(self._shares[direction]) * scale
            self._own[direction].append((own, len(rows)))

    def refresh(self, residuals: Array, context: Ints) -> None:
        """Recompute covariances and thresholds.

        Args:
            residuals: (n, J) rad, of confirmed ticks of the leg as it is, by the model in force.
            context: (n,) by which their covariances were chosen.
        """
        self.whiten = turned_by(self._of_baseline, residuals, context)

    @property
    def after_known(self) -> bool:
        """Whether the leg's noise after the turn to stance, in the air, is known."""
        if self._peaks is None:
            return len(self._own_after) >= LEAST_LIFTS
        return not bool(np.isnan(self._peaks.largest[AFTER]).any())

    def _thresholds_from_tails(self, tails: tuple[Tail, ...]) -> Array:
        swing = thresholds_of(tails, self._target_rate)
        awaited = thresholds_of(tails, AWAITED * self._target_rate)
        return np.array([swing, swing, awaited])

    def _compute_thresholds(self) -> Array:
        """(directions, windows), of the leg's own peaks where they are known."""
        if self._peaks is None:
            return np.asarray(self._pooled * self._shares[:, None])
        rates = self._target_rate * np.array([1.0, 1.0, AWAITED])
        own = self._peaks.thresholds(rates)
        level = max(1.0, float(np.median(self._lifts)) / STRAY) if self._lifts else 1.0
        own[:AFTER] = np.fmin(level * own[:AFTER], self._pooled[:AFTER])
        return np.where(np.isnan(own), self._pooled, own)

    @property
    def _own(self) -> tuple[deque[tuple[float, int]], ...]:
        return self._own_lifts, self._own_descents, self._own_after

    def _share(self, scale: float) -> None:
        """Compute which share of the pooled thresholds the last lifts and descents ask for."""
        least, shares = 1.0, np.ones(3)
        most = MOST_HUNG if len(self._own_after) >= LEAST_LIFTS else 1.0
        for direction, own in enumerate(self._own):  # descents: not less than lifts
            least = 1.0 if direction == AFTER else least
            share = least
            if len(own) >= LEAST_LIFTS:
                # The second largest: one of them may have struck something.  A leg that hangs
                # rarely does.
                largest = sorted(ratio for ratio, _ in own)[-1 if direction == AFTER else -2]
                ticks = sum(ticks for _, ticks in own)
                share = largest / scale * float(beyond(self._target_rate, 0.5 * ticks))
                lower = LEAST_SHARE if direction == LIFT else least
                share = min(max(share, lower), MOST_AFTER if direction == AFTER else most)
            shares[direction] = least = share
        self._shares = shares

    def snapshot(self) -> dict[str, Any]:
        """Return the last lifts, for :meth:`restore`."""
        saved: dict[str, Any] = {}
        for name, own in zip(OWN, self._own, strict=True):
            if own:
                saved[name] = [list(swing) for swing in own]
        if self._lifts:
            saved["lifts"] = list(self._lifts)
        return saved

    def restore(self, saved: Any, scale: float = 1.0) -> None:
        """Take over saved counts; what is not usable is left."""
        if not isinstance(saved, dict):
            return
        lifts = saved.get("lifts")
        if isinstance(lifts, list) and all(isinstance(v, float) and 0.0 <= v < 1e6 for v in lifts):
            self._lifts.extend(lifts)
        for name, own in zip(OWN, self._own, strict=True):
            kept = saved.get(name)
            if isinstance(kept, list) and all(map(_is_lift, kept)):
                own.extend((ratio, ticks) for ratio, ticks in kept)
        self._share(scale)
        self.thresholds = self._compute_thresholds()


def _is_lift(saved: object) -> bool:
    match saved:
        case [float(ratio), int(ticks)]:
            return 0.0 <= ratio < 1e6 and 0 < ticks < 1e6
    return False


def turned_by(whiten: Array, residuals: Array, context: Ints) -> Array:
    """Turn and stretch a baseline's whitening by the scatter of confirmed ticks.

    Args:
        whiten: (contexts, windows, J, J) the baseline's.
        residuals: (n, J) rad.
        context: (n,) of each.

    Returns:
        (contexts, windows, J, J).
    """
    n, joints = residuals.shape
    if not n:
        return whiten
    z = np.einsum("nij,nj->ni", whiten[context, 0], residuals)
    size = np.sqrt(np.square(z).mean(axis=1))
    within = np.minimum(1.0, CLIP * np.median(size) / np.maximum(size, 1e-12))
    z *= within[:, None]
    shape = z.T @ z
    trace = float(shape.trace())
    by = joints / (trace * (1.0 + SHRINK_TICKS / n)) if trace > 0.0 else 0.0
    if not 0.0 < by < np.inf:  # no scatter
        return whiten
    shape += SHRINK_TICKS * trace / joints / n * np.eye(joints)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(by * shape), whiten))
