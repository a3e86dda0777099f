r"""Follows the covariance and the tail of a leg's residuals.

A baseline's covariances and tails are of the day it was learned.  A joint that has grown noisier,
a reading that has become rougher, a model that fits one direction less well show in the confirmed
free ticks, and only there: a contact is never among them.  Two things follow, so that the
false-alarm rate stays put and not the threshold:

- the *shape* of the covariance.  With Z the whitened residuals of the buffer under the model in
  force, :math:`S = (Z^\top Z + n_0 s I) / (n + n_0)`, shrunk towards the baseline's and normed to
  a mean variance of one: how large it is on the whole, the drift monitor's level says;
- the *tail* of the statistic.  How often it passes the level at which the baseline's tail begins,
  and by how much, against what the baseline promised; on lifts only, which no ground can press on.

Where the baseline knows the leg's own free maxima (:mod:`adaptive_contact.model.peaks`), these set
the thresholds, up to those of the tail.  They follow the median of the last lifts' maxima: a joint
that reads more coarsely shows in the next lifts, a foot that strikes something in few of them.

The tail is never narrowed, nor the trace lowered: a leg with a baseline that fits better by chance
is not judged more strictly for it.  A leg that began with a prior takes its thresholds from its own
last lifts, descents and, where it hangs, ticks after the turn (decision 53).
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.compiled import compiled
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.model_file import thresholds_of
from adaptive_contact.model.noise import AFTER, DESCENT, LIFT, NoiseModel
from adaptive_contact.model.peaks import LEAST_TICKS, Peaks, beyond
from adaptive_contact.model.tail import Tail
from adaptive_contact.model.training_domain import Domain

# The baseline's covariance weighs like so many ticks; the buffer holds some 700 (decision 9).
SHRINK_TICKS: Final = 1000.0
# A residual further out than so many of its deviations counts as if it were there.
CLIP: Final = 3.0
# The baseline's tail weighs like so many exceedances.
PRIOR_EXCEEDANCES: Final = 50.0
# An exceedance counts for so many times the mean of the tail as it is known, at most: one tick of a
# touch that passed for a lift had made the threshold three times as high for twenty minutes.
MOST_EXCESS: Final = 5.0
# Beyond so many ticks, the older ones fade: some twenty minutes of a walking leg.
MEMORY_TICKS: Final = 20_000.0
# A foot that has not touched at its turn to stance is about to: 0.13 of those ticks begin
# a touch, 0.012 of those in swings (eight planned walks of 90 s).  At so many times the target
# rate, which is 1.3e-4 per tick, one alarm there in a thousand is false.
AWAITED: Final = 70.0
# What is recomputed is in force after a tick for so many segments, as results on record have it.
SEGMENTS_PER_TICK: Final = 12
# A tail this many times as frequent, or as wide, as the baseline's is no tail: the model is wrong,
# which the monitor has to say.
MOST: Final = 4.0
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
        self._tails = tails
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
        self._pooled = self._least = self._of_tails(tails)
        self.whiten: Array = noise.whiten
        self.thresholds: Array = self._in_force()
        self._factors = (1.0, 1.0)  # on the tails, by which the thresholds were computed
        self._next: Array | None = None  # whitening to come
        self._due = 0  # ticks until then
        # Of the statistic of one tick: ticks, those above the tail's level, and their excess.
        self._ticks = self._above = self._excess = 0.0

    def count(self, rows: Rows, domain: Domain | None = None, scale: float = 1.0) -> bool:
        """Count the exceedances in free rows of a leg whose lifts fit.

        Args:
            rows: of a lift, or of a descent; the latter count for a leg from a prior only, as soft
                ground may be among the last.
            domain: where the model in force has been; None if that is not known.
            scale: variance by which they were judged, over the baseline's.

        Returns:
            Whether the thresholds are others from here on.
        """
        if rows.lifting:
            self._count_tail(rows, domain)
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
        else:
            return False
        before, self.thresholds = self.thresholds, self._in_force()
        return not np.array_equal(before, self.thresholds)

    def _count_own(self, rows: Rows, direction: int, scale: float) -> None:
        if rows:
            ratio = float(np.fmax.reduce(rows.records["ratio"], initial=0.0))
            own = ratio * float(self._shares[direction]) * scale
            self._own[direction].append((own, len(rows)))

    def _count_tail(self, rows: Rows, domain: Domain | None) -> None:
        tail = self._tails[0]
        level = tail.level
        self._ticks += len(rows)
        for k, value in enumerate(rows.records["value"].tolist()):
            if not value > level:  # NaN is not
                continue
            # As for an alarm, and when the tail was fitted: what is extrapolated is no noise.
            spread = 0.0 if domain is None else float(domain.leverage(rows.theta[k]))
            value /= 1.0 + spread
            if value > level:
                most = MOST_EXCESS * self.tail_factors[1] * tail.scale / (1.0 - tail.shape)
                self._above += 1.0
                self._excess += min(value - level, most)
        if self._ticks > MEMORY_TICKS:
            fade = MEMORY_TICKS / self._ticks
            self._ticks *= fade
            self._above *= fade
            self._excess *= fade

    def refresh(self, residuals: Array, context: Ints) -> None:
        """Recompute covariances and thresholds at once.

        Args:
            residuals: (n, J) rad, of confirmed ticks of the leg as it is, by the model in force.
            context: (n,) by which their covariances were chosen.
        """
        self.begin_refresh(residuals, context, 0)
        self.go_on()

    def begin_refresh(self, residuals: Array, context: Ints, segments: int) -> None:
        """Recompute covariances, to be in force after some calls of :meth:`go_on`.

        Args:
            residuals: as of :meth:`refresh`.
            context: likewise.
            segments: that they are of.
        """
        self._next = turned_by(self._of_baseline, residuals, context)
        self._due = 1 + -(-segments // SEGMENTS_PER_TICK)

    @property
    def after_known(self) -> bool:
        """Whether the leg's noise after the turn to stance, in the air, is known."""
        if self._peaks is None:
            return len(self._own_after) >= LEAST_LIFTS
        return not bool(np.isnan(self._peaks.largest[AFTER]).any())

    @property
    def refreshing(self) -> bool:
        """Whether a refresh is under way, for :meth:`go_on`."""
        return self._next is not None

    def drop_refresh(self) -> None:
        """Drop a refresh under way: its ticks were dropped since."""
        self._next = None

    def go_on(self) -> bool:
        """Count a tick of a refresh under way; True where it is in force from here on."""
        if self._next is None:
            return False
        self._due -= 1
        if self._due:
            return False
        self.whiten, self._next = self._next, None
        factors = self.tail_factors
        if factors != self._factors:
            often, wide = self._factors = factors
            tails = tuple(
                dataclasses.replace(t, rate=min(often * t.rate, 0.5), scale=wide * t.scale)
                for t in self._tails
            )
            self._pooled = np.maximum(self._least, self._of_tails(tails))
            self.thresholds = self._in_force()
        return True

    def _of_tails(self, tails: tuple[Tail, ...]) -> Array:
        swing = thresholds_of(tails, self._target_rate)
        awaited = thresholds_of(tails, AWAITED * self._target_rate)
        return np.array([swing, swing, awaited])

    def _in_force(self) -> Array:
        """(directions, windows), of the leg's own peaks where they are known."""
        if self._peaks is None:
            return np.asarray(self._pooled * self._shares[:, None])
        rates = self._target_rate * np.array([1.0, 1.0, AWAITED])
        own = self._peaks.thresholds(rates) * (self._pooled / self._least)
        level = max(1.0, float(np.median(self._lifts)) / STRAY) if self._lifts else 1.0
        own[:AFTER] = np.fmin(level * own[:AFTER], self._pooled[:AFTER])
        return np.where(np.isnan(own), self._pooled, own)

    @property
    def _own(self) -> tuple[deque[tuple[float, int]], ...]:
        return self._own_lifts, self._own_descents, self._own_after

    def _share(self, scale: float) -> None:
        """Compute which share of the pooled thresholds the last lifts and descents ask for."""
        least, shares = 1.0, np.ones(3)
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
                share = min(max(share, lower), MOST_AFTER if direction == AFTER else 1.0)
            shares[direction] = least = share
        self._shares = shares

    @property
    def tail_factors(self) -> tuple[float, float]:
        """Factors on rate and mean excess of the baseline's tail, at least 1."""
        tail = self._tails[0]
        mean = tail.scale / (1.0 - tail.shape)
        above = PRIOR_EXCEEDANCES + self._above
        often = above / (PRIOR_EXCEEDANCES + tail.rate * self._ticks)
        wide = (PRIOR_EXCEEDANCES * mean + self._excess) / (above * mean)
        return min(max(often, 1.0), MOST), min(max(wide, 1.0), MOST)

    def snapshot(self) -> dict[str, Any]:
        """Return the counts of the tail and the last lifts, for :meth:`restore`."""
        saved: dict[str, Any] = {
            "ticks": self._ticks,
            "above": self._above,
            "excess": self._excess,
        }
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
        values = [saved.get(name) for name in ("ticks", "above", "excess")]
        known = [v for v in values if isinstance(v, float) and 0.0 <= v <= 2.0 * MEMORY_TICKS]
        if len(known) == len(values):
            self._ticks, self._above, self._excess = known
        lifts = saved.get("lifts")
        if isinstance(lifts, list) and all(isinstance(v, float) and 0.0 <= v < 1e6 for v in lifts):
            self._lifts.extend(lifts)
        for name, own in zip(OWN, self._own, strict=True):
            kept = saved.get(name)
            if isinstance(kept, list) and all(map(_is_lift, kept)):
                own.extend((ratio, ticks) for ratio, ticks in kept)
        self._share(scale)
        self.thresholds = self._in_force()


def _is_lift(saved: object) -> bool:
    match saved:
        case [float(ratio), int(ticks)]:
            return 0.0 <= ratio < 1e6 and 0 < ticks < 1e6
    return False


@compiled
def whiten_rows(whiten, context, residuals, z, size):
    """Fill (n, J) whitened residuals of single ticks, and their (n,) root mean squares."""
    joints = residuals.shape[1]
    for i in range(len(residuals)):
        square = 0.0
        for r in range(joints):
            total = 0.0
            for c in range(joints):
                total += whiten[context[i], 0, r, c] * residuals[i, c]
            z[i, r] = total
            square += total * total
        size[i] = math.sqrt(square / joints)


@compiled
def turn(whiten, z, size, usual, shape, turned):
    """Turn and stretch whitening by the scatter of whitened residuals.

    Args:
        whiten: (contexts, windows, J, J) of the baseline.
        z: (n, J) residuals, whitened by it.
        size: (n,) of each, by which it is clipped.
        usual: their median.
        shape: (J, J) scratch.
        turned: (contexts, windows, J, J), filled; as it was where the residuals have no scatter.

    Returns:
        Whether it was.
    """
    n, joints = z.shape
    shape[:] = 0.0
    for i in range(n):
        within = min(1.0, CLIP * usual / max(size[i], 1e-12))
        for r in range(joints):
            for c in range(r + 1):
                shape[r, c] += within * z[i, r] * (within * z[i, c])
    trace = 0.0
    for r in range(joints):
        trace += shape[r, r]
    by = joints / (trace * (1.0 + SHRINK_TICKS / n))
    if not (trace > 0.0 and 0.0 < by < np.inf):
        return False
    for r in range(joints):
        shape[r, r] += SHRINK_TICKS * trace / joints / n
    # Its Cholesky factor, in place; then what that factor turns into the baseline's whitening.
    for r in range(joints):
        for c in range(r + 1):
            total = shape[r, c] * by
            for k in range(c):
                total -= shape[r, k] * shape[c, k]
            shape[r, c] = math.sqrt(total) if r == c else total / shape[c, c]
    for context in range(whiten.shape[0]):
        for width in range(whiten.shape[1]):
            for r in range(joints):
                for c in range(joints):
                    total = whiten[context, width, r, c]
                    for k in range(r):
                        total -= shape[r, k] * turned[context, width, k, c]
                    turned[context, width, r, c] = total / shape[r, r]
    return True


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
    z, size = np.empty_like(residuals), np.empty(n)
    whiten_rows(whiten, context, residuals, z, size)
    # np.median(), which takes five times as long.
    half = np.partition(size, n // 2)[: n // 2 + 1]
    usual = half[-1] if n % 2 else 0.5 * (half[:-1].max() + half[-1])
    turned = np.empty_like(whiten)
    found = turn(whiten, z, size, max(usual, 1e-12), np.empty((joints, joints)), turned)
    return turned if found else whiten
