r"""Judges whether a leg's readings carry information that its commands do not have.

An honest reading departs from every function of the commands: by load, by touches, by friction, by
its encoder's noise.  What a program makes of the commands does not.  With :math:`y` a joint's
readings and :math:`u` its commands, the least squares of

.. math:: y_k = c + \sum_{l=0}^{12} a_l u_{k-l} + \sum_p b_p (F_p u)_k

over two strides, :math:`F_p` low-passes, leave a copy of any delay, scale, offset or filter within
its rounding: a root mean square of 0.29 steps while the command moves.  Readings of other faults:

With noise a copy leaves more, but of one tick nothing of the next, while load and friction last:
where a leg has departed with a lag-1 autocorrelation r of :math:`y - \hat y` of 0.3 and more, and
all its joints leave little with r below 0.1, they are copies as well.

- *equal*: commands, to the last bit, in some ticks only, such as those of swings: a copy as well;
- *held*: a joint that moves reads the same as in the tick before, more often than not;
- *old*: the commands of the last 12 ticks explain less of the readings than those of a time before;
- *twin*: they are another leg's to the last bit, whose commands explain them better.

A leg that carries nothing may be a function of its commands, too.  Where it has never departed from
them it is *unproved*, not false.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided

from adaptive_contact.arrays import Array, Ints, Mask, scipy
from adaptive_contact.checks.motion import LegMotion

# Ticks from a command to its copy, and low-passes by the share of their past that they keep.
LAGS: Final = 13
POLES: Final = (0.6, 0.8, 0.9)
# A joint is a copy below so many steps.
# Rounding leaves 0.29, in 100 ticks up to 0.36.  Least of walking joints: 0.58 and more on two
# simulators (2,700 windows with noise of 0.3 steps and more), real legs 1.1 to 3; a robot arm's
# wrist in slow sines 0.36.
COPY_STEPS: Final = 0.40
COPY_STAYS: Final = 0.55  # until it leaves more
# A leg leaves white noise below the first mean lag-1 autocorrelation of its joints, of so many
# steps at most, until above the second, above which it is its own, shown in so many looks.  Copies
# with noise up to a step leave -0.06, more than 0.1 in 2 of 100 runs of three looks; walking legs
# 0.4 to 0.9, in none of 3,700 runs below 0.15; light legs that carry nothing 0.1, as ever.
WHITE: Final = 0.1
COLOURED: Final = 0.3
WHITE_STEPS: Final = 1.4
SHOWN_LOOKS: Final = 4
# Looks that do not tell a leg from a copy, and no more of the others, until it is unproved.
UNCLEAR_LOOKS: Final = 3
# Ticks in which the command moves, by half a step and more, and how its speed must vary, steps a
# tick: at one speed, a servo follows as exactly.
LEAST_MOVING: Final = 30
MOVING: Final = 0.5
LEAST_SPREAD: Final = 2.0
# A reading that goes less of its command's way is frozen, which others name.
LEAST_SHARE: Final = 0.05
# Two strides are judged, but no more ticks than the second number where one is as long; the first
# number is what the least squares need.
LEAST_TICKS: Final = 44
ENOUGH_TICKS: Final = 100
MOST_TICKS: Final = 600
# Ticks after which a low-pass has forgotten what was before; and what keeps least squares of
# commands that are alike from rounding errors, as a share of their squares.
SETTLE_TICKS: Final = 100
RIDGE: Final = 1e-11
# Readings that a bus has spoilt are left out, so many of them.
SPOILT: Final = 2
# Of ticks in which a joint goes a step a tick and more, the share that reads as the tick before:
# 0.67 where each reading is held for three ticks, 0.5 for two (which can be judged), at most 0.24
# by itself.
HELD_SHARE: Final = 0.58
HELD_AROUND: Final = 6
# Readings are old where recent commands leave so much of their variance, and earlier ones, up to
# so many ticks, so small a share of that: 0.25 at most for readings of a second before, 0.5 and
# more for walking legs.
OLD_REST: Final = 0.03
OLD_LOOK: Final = 0.02  # nothing is old where all functions of the commands leave less
OLD_RATIO: Final = 0.25
OLD_STAYS: Final = 0.9  # of what was old
OLD_MOST: Final = 0.15  # left by the earlier ones; a foot that is stopped is a function of none
OLD_TICKS: Final = 122
BAND: Final = 6
LEAST_TRAVEL_RAD: Final = 0.02
# What a look needs at most.
NEEDED_SAMPLES: Final = MOST_TICKS + LAGS + OLD_TICKS
# Of a recording with fewer beginnings and ends of swings, any ticks are judged.
LEAST_TURNS: Final = 8
# Readings are on a grid where so many are, to a tenth of its step.
GRID_SHARE: Final = 0.95
GRID_RAD: Final = 1e-5

# Readings that equal a command, rad, in so many ticks in which it moves, off the grid that the
# others lie on, by so much of its step: no servo stops there.  On the grid, two joints and more
# have to move, and all that do have to read their command in so many ticks in a row; in the last
# number of them to stay a copy: walking legs in 3 at most, copies in swings only in 6 and more.
GRID_PART: Final = 0.05
EQUAL_RAD: Final = 1e-6
EQUAL_TICKS: Final = 8
EQUAL_RUN: Final = 12
EQUAL_STAYS: Final = 5

Kind = Literal["copy", "held", "old", "twin"]


class Finding(NamedTuple):
    """Holds what is wrong with a leg's readings."""

    kind: Kind
    joints: tuple[int, ...]
    since: int  # samples before the newest for which it has been so


class InformationCheck:
    """Follows whether one leg's readings carry information, look by look.

    Args:
        joints: J.
        step_rad: of the encoder; what lies on a finer grid is judged by that.

    Attributes:
        found: what is wrong, None where nothing is.
        suspicion: what one look alone has found, until the next agrees.
        suspected: whether the last look found a fault, or readings that may be copies.
        unproved: whether look after look has not told the readings from a copy.
        open_joints: those that the last such look did not tell from copies.
    """

    def __init__(self, joints: int, step_rad: float) -> None:
        self._step_rad = step_rad
        self.found: Finding | None = None
        self.suspicion: Finding | None = None
        self.suspected = False
        self.unproved = False
        self._unclear = 0  # looks that suspected and found nothing, less those that did not
        self.open_joints: tuple[int, ...] = ()
        self._strides = deque[int](maxlen=2)  # samples at which the last swings began
        self._agreed = 0  # looks in a row that say other than `found`
        self._white = self._shown = 0  # looks in a row that left white noise; looks that did not

    @property
    def copies(self) -> tuple[int, ...]:
        """Joints that are copies, if only by one look."""
        found = self.found or self.suspicion
        return found.joints if found is not None and found.kind == "copy" else ()

    def restart(self) -> None:
        """Forget the strides: what comes does not connect."""
        self._strides.clear()
        self._agreed = self._white = 0

    def check_strides(
        self,
        count: int,
        samples: LegMotion,
        *,
        begins: bool,
        predicted: bool | None = None,
        twin: LegMotion | None = None,
    ) -> bool:
        """Judge the last two strides.

        Args:
            count: samples since the source began.
            samples: the newest of them.
            begins: a swing begins with the newest; else one has ended.
            predicted: whether the leg's model predicted its last lifts: what it predicts may be the
                leg's own; None where no lift tells.
            twin: those of a leg that sends the same readings.

        Returns:
            Whether ``found`` is another now.
        """
        ticks = self._ticks(count)
        if begins:
            self._strides.append(count)
        if ticks < LEAST_TICKS or len(samples.seq) < ticks + LAGS:
            return False
        self.suspected, self.suspicion = False, None
        finding, decided = self._find_fault(samples, ticks, predicted=predicted, twin=twin)
        if not decided:
            return False
        unclear = self.suspected and finding is None and self.found is None
        self._unclear = min(max(self._unclear + (1 if unclear else -1), 0), UNCLEAR_LOOKS)
        # One less where the leg has never shown itself.
        most = UNCLEAR_LOOKS - (self._shown < SHOWN_LOOKS)
        self.unproved = self._unclear >= (1 if self.unproved else most)
        if (finding is None) == (self.found is None):
            self._agreed = self._agreed if unclear else 0
            return False
        self._agreed += 1
        # Looks in a row, two a stride, that find a fault, or none, before it counts.
        if self._agreed < 2:
            self.suspicion = finding
            return False
        self._agreed = 0
        self.found = finding
        return True

    def _ticks(self, count: int) -> int:
        """Ticks to judge: two strides, or one that is long."""
        if len(self._strides) < 2:
            return 0
        two, one = (count - at for at in self._strides)
        return min(two, max(ENOUGH_TICKS, one), MOST_TICKS)

    def _find_fault(
        self, samples: LegMotion, ticks: int, *, predicted: bool | None, twin: LegMotion | None
    ) -> tuple[Finding | None, bool]:
        """Judge so many ticks: what is wrong, and whether they show anything."""
        steps = steps_of(samples.measured[-MOST_TICKS:], self._step_rad)
        newest = samples.part(np.s_[-ticks:])
        held = np.flatnonzero(held_shares(newest, steps) > HELD_SHARE)
        if len(held):
            return Finding("held", tuple(held.tolist()), 2 * ticks), True
        off = departure(samples, ticks, steps)
        if off is None:
            return None, False
        before = self.copies
        copies = np.flatnonzero(off.rms < (COPY_STAYS if before else COPY_STEPS))
        self.suspected = bool(len(copies))
        still, self.open_joints = before or self.open_joints, tuple(copies.tolist())
        # Free motion is a function of the commands: where the leg's model predicts it, or nothing
        # was in evidence that the leg had to carry, these may be its own.
        enough = max(ticks, ENOUGH_TICKS)
        new = self.found is None
        light = new and predicted is not False and not carries(samples.part(np.s_[-enough:]), steps)
        open_ = light or (new and bool(predicted))
        if len(copies) and not open_:
            return Finding("copy", tuple(copies.tolist()), off.since(samples, copies, steps)), True
        if still and np.isnan(off.rms[list(still)]).all():
            self.open_joints = still
            return self.found, False  # joints that hardly move clear nothing
        run = EQUAL_STAYS if before else EQUAL_RUN
        equal, since = equal_to_commands(samples, ticks, self._step_rad, run)
        if equal:
            return Finding("copy", equal, since), True
        white, moving = self._is_white(off), np.flatnonzero(np.isfinite(off.rms))
        if white:
            self.suspected |= self._shown < SHOWN_LOOKS or open_
            if self._white > 1 and self._shown >= SHOWN_LOOKS and not open_:
                return Finding("copy", tuple(moving.tolist()), 2 * ticks), True
        own = None if twin is None else departure(twin, ticks, steps)
        # Readings are another leg's where its commands leave less than this share of what its own
        # leave.
        if own is not None and own.rest < 0.5 * off.rest:
            return Finding("twin", tuple(range(len(steps))), 2 * ticks), True
        was = self.found is not None and self.found.kind == "old"
        if (was or off.rest > OLD_LOOK) and is_old(samples, enough, was=was):
            found = None if light else Finding("old", tuple(range(len(steps))), 2 * ticks)
            return found, not light
        return None, bool(np.isfinite(off.rms).any())

    def _is_white(self, off: Departure) -> bool:
        """Whether a leg leaves white noise, as far as it shows it; counts looks that do."""
        moving = np.isfinite(off.rms)
        if not moving.any():
            return False
        lasting = float(off.lasting[moving].mean())
        limit = COLOURED if self.found is not None else WHITE
        white = moving.sum() > 1 and lasting < limit and off.rms[moving].max() < WHITE_STEPS
        self._white = self._white + 1 if white else 0
        if not white:
            self._shown = max(self._shown + (1 if lasting > COLOURED else -1), 0)
        return bool(white)


def carries(samples: LegMotion, steps: Array) -> bool:
    """Whether a leg that walks had to carry: a quarter and more of its stance moved."""
    if samples.swing is None:
        return True
    moves = (np.abs(np.diff(samples.desired, axis=0)) > MOVING * steps).any(axis=1)
    stance = ~samples.swing[1:]
    return bool(4 * (moves & stance).sum() >= max(stance.sum(), 1))


def equal_to_commands(
    samples: LegMotion, ticks: int, step_rad: float, run: int = EQUAL_RUN
) -> tuple[tuple[int, ...], int]:
    """Find joints whose newest readings are commands that their encoder could not have read.

    Args:
        samples: as many as ticks, and :data:`LAGS` before them.
        ticks: that are judged.
        step_rad: of the encoder, as described.
        run: ticks in a row in which joints on the grid have to read their commands.

    Returns:
        The joints, and how many samples ago the first of these readings was.
    """
    read, told = samples.measured[-ticks:].T.copy(), samples.desired
    equal = np.abs(read[:, None] - _lagged(told)[:, :, -ticks:]) < EQUAL_RAD  # (J, lags, ticks)
    moved = np.abs(np.diff(told, axis=0, prepend=told[:1])).T
    ends = len(told) - np.arange(LAGS)
    copies = np.zeros(read.shape, dtype=np.bool_)
    off = off_grid(read, np.asarray(~equal.any(axis=1)), step_rad)
    for lag in np.flatnonzero((equal.sum(axis=2) >= EQUAL_TICKS).any(axis=0)):
        same = equal[:, lag] & off & (moved[:, ends[lag] - ticks : ends[lag]] > 0.0)
        copies |= same & (same.sum(axis=1, keepdims=True) >= EQUAL_TICKS)
    for lag in np.flatnonzero((equal.sum(axis=0) > 1).sum(axis=1) >= run):
        moving = moved[:, ends[lag] - ticks : ends[lag]] > 0.5 * step_rad
        whole = (equal[:, lag] | ~moving).all(axis=0) & (moving.sum(axis=0) > 1)
        copies |= equal[:, lag] & moving & in_runs(whole, run)
    first = int(copies.any(axis=0).argmax())
    return tuple(np.flatnonzero(copies.any(axis=1)).tolist()), ticks - first


def _lagged(commands: Array) -> Array:
    """Return (n, J) commands as of so many ticks before, (J, lags, n); before the first, itself."""
    before = np.concatenate([np.repeat(commands[:1], LAGS - 1, axis=0), commands]).T.copy()
    (row, tick), shape = before.strides, (len(before), LAGS, len(commands))
    return as_strided(before[:, LAGS - 1 :], shape, (row, -tick, tick), writeable=False)


def off_grid(read: Array, sure: Mask, step_rad: float) -> Mask:
    """Select readings off the grid that those which are certain show; none where they show none.

    Args:
        read: (J, n) rad.
        sure: (J, n) readings that are certainly the encoder's.
        step_rad: of the grid; where it begins is read off.
    """
    turns = read / step_rad
    zeros = np.angle((np.exp(2j * np.pi * turns) * sure).sum(axis=1, keepdims=True))
    turns -= zeros / (2.0 * np.pi)
    off: Mask = np.abs(turns - np.rint(turns)) > GRID_PART
    count = sure.sum(axis=1)
    known = (count >= LEAST_MOVING) & ((~off & sure).sum(axis=1) >= GRID_SHARE * count)
    return np.asarray(off & known[:, None])


def in_runs(of: Mask, least: int) -> Mask:
    """Select the ticks of an (n,) mask that are in a row of so many and more."""
    begins = np.convolve(of, np.ones(least), "valid") == least
    return np.asarray(np.convolve(begins, np.ones(least)) > 0.0)


class Departure(NamedTuple):
    """Holds how far readings are off a function of their commands."""

    rms: Array  # (J,) steps, while the command moves; NaN where it moves too little to say
    lasting: Array  # (J,) lag-1 autocorrelation of what is left
    rest: float  # share of the readings' variance that is no function of the commands
    coefficients: Array  # (J, p)
    constants: Array  # (J,) rad

    def since(self, samples: LegMotion, joints: Ints, steps: Array) -> int:
        """Count the samples up to the newest of which the same function holds for joints."""
        off = samples.measured - self.constants
        off -= np.einsum("jtp,jp->tj", basis(samples.desired), self.coefficients)
        # Steps by which a tick before may be off and belong to the fault.
        beyond = np.flatnonzero((np.abs(off) > 2.0 * steps)[:, joints].any(axis=1))
        # A single reading that a bus has spoilt is no beginning.
        beyond = beyond[1:][np.diff(beyond) <= 2]
        return len(off) - (int(beyond[-1]) + 1 if len(beyond) else 0)


def departure(samples: LegMotion, ticks: int, steps: Array) -> Departure | None:
    """Compute how far the readings of the last ticks are off any function of the commands.

    Args:
        samples: as many, and those before that are known.
        ticks: to judge.
        steps: (J,) rad, of the encoders.

    Returns:
        None where too few ticks know the commands before them.
    """
    first = max(len(samples.seq) - ticks - LAGS - SETTLE_TICKS, 0)
    seq, desired = samples.seq[first:], samples.desired[first:]
    use = np.zeros(len(seq), dtype=np.bool_)
    use[max(len(seq) - ticks, LAGS) :] = True
    for at in (np.flatnonzero(np.diff(seq) != 1) + 1).tolist():
        use[at : at + LAGS] = False
    if use.sum() < LEAST_TICKS:
        return None
    # numpy is three times as fast along rows.
    y, told = samples.measured[first:][use].T.copy(), desired.T.copy()
    speeds = (np.diff(told, prepend=told[:, :1]) / steps[:, None])[:, use]
    coefficients, constants, off, worst, about_mean = _fit(basis(desired)[:, use], y)
    square = (off * off).sum(axis=1)
    moving = np.abs(speeds) > MOVING
    # Few ticks that move are what the coefficients were fitted to.
    moves = moving.sum(axis=1)
    moves_out = moving[np.arange(len(worst))[:, None], worst].sum(axis=1)
    free = np.maximum(moves - moves_out - coefficients.shape[1] - 1, 1.0)
    rms = np.sqrt((off * off * moving).sum(axis=1) / free) / steps
    told_rad = np.ptp(told[:, use], axis=1)
    still = np.ptp(y, axis=1) < LEAST_SHARE * told_rad
    steady = speeds.std(axis=1) < LEAST_SPREAD
    rms[(moves < LEAST_MOVING) | steady | still] = np.nan
    travels = told_rad > LEAST_TRAVEL_RAD
    rest = square / np.maximum(about_mean, 1e-12)
    share = float(rest[travels].mean()) if travels.any() else 0.0
    lasting = (off[:, 1:] * off[:, :-1]).sum(axis=1) / np.maximum(square, 1e-12)
    return Departure(rms, lasting, share, coefficients, constants)


def _fit(x: Array, y: Array) -> tuple[Array, Array, Array, Ints, Array]:
    """Fit (J, n) readings by (J, n, p) columns, which are centred in place, and a constant.

    Without the readings that are furthest off, the normal equations about the means of the others
    are those of all less what these add: with sums s of m centred rows that are left out, of n, the
    means move by -s / (n - m), and the products fall by theirs and by n - m times the move's.

    Returns:
        (J, p) coefficients; (J,) constants, rad; (J, n) rad, what is left, 0 of those left out;
        (J, SPOILT) those left out; (J,) rad², sum of squares of the others about their mean.
    """
    each_tick = np.full(y.shape[1], 1.0 / y.shape[1])
    means, level = each_tick @ x, y @ each_tick
    x -= means[:, None]
    z = y - level[:, None]
    gram, to = x.transpose(0, 2, 1) @ x, (z[:, None] @ x)[:, 0]
    off = z - (x @ _solved(gram, to)[:, :, None])[:, :, 0]
    each = np.arange(len(z))[:, None]
    worst = np.argpartition(np.abs(off), -SPOILT, axis=1)[:, -SPOILT:]
    x_out, z_out = x[each, worst], z[each, worst]
    count = z.shape[1] - SPOILT
    move, rise = -x_out.sum(axis=1) / count, -z_out.sum(axis=1) / count
    gram -= x_out.transpose(0, 2, 1) @ x_out + count * move[:, :, None] * move[:, None]
    to -= (z_out[:, None] @ x_out)[:, 0] + count * rise[:, None] * move
    coefficients = _solved(gram, to)
    above = rise - (move * coefficients).sum(axis=1)  # of the constant, by the move
    constants = level + above - (means * coefficients).sum(axis=1)
    off = z - (x @ coefficients[:, :, None])[:, :, 0] - above[:, None]
    off[each, worst] = 0.0
    square = (z * z).sum(axis=1) - (z_out * z_out).sum(axis=1) - count * rise**2
    return coefficients, constants, off, worst, square


def _solved(gram: Array, to: Array) -> Array:
    """Solve (J, p, p) normal equations; columns that are alike share what they explain."""
    held = gram.copy()
    diagonal = np.einsum("jpp->jp", held)
    diagonal += RIDGE * diagonal.sum(axis=1, keepdims=True) + 1e-300
    return np.asarray(np.linalg.solve(held, to[:, :, None])[:, :, 0])


def basis(commands: Array) -> Array:
    """Compute (J, n, p) functions of (n, J) commands: the last ones, and low-passes."""
    n, joints = commands.shape
    columns = np.empty((joints, LAGS + len(POLES), n))
    columns[:, :LAGS] = _lagged(commands)
    columns[:, LAGS:] = low_pass(commands, POLES).transpose(2, 0, 1)
    return columns.transpose(0, 2, 1)


def low_pass(commands: Array, poles: Sequence[float]) -> Array:
    """Compute the low-passes of (n, J) commands that keep such shares of their past in a tick.

    Returns:
        (poles, n, J).
    """
    # f_k - pole f_(k-1) = (1 - pole) u_k is solved from the first on.
    away, bands, passed = commands - commands[0], np.ones((2, len(commands))), []
    for pole in poles:
        bands[1] = -pole
        passed.append(scipy.linalg.lapack.dtbtrs(bands, (1.0 - pole) * away, uplo="L")[0])
    return np.asarray(np.stack(passed) + commands[0])


def held_shares(samples: LegMotion, steps: Array) -> Array:
    """Compute the shares of ticks, of those in which a joint moves, that read as the one before.

    Args:
        samples: n.
        steps: (J,) rad, of the encoders.

    Returns:
        (J,), 0 where there are too few such ticks.
    """
    y, u, seq, around = samples.measured, samples.desired, samples.seq, HELD_AROUND
    moves = np.abs(y[2 * around :] - y[: -2 * around]) > 2 * around * steps
    moves &= (seq[2 * around :] - seq[: -2 * around] == 2 * around)[:, None]
    before, now = slice(around - 1, -around - 1), slice(around, -around)
    moves &= np.abs(u[now] - u[before]) > steps
    count = moves.sum(axis=0)
    held = (moves & (y[now] == y[before])).sum(axis=0)
    return np.where(count >= LEAST_MOVING, held / np.maximum(count, 1), 0.0)


def is_old(samples: LegMotion, ticks: int, *, was: bool = False) -> bool:
    """Whether earlier commands explain the readings that recent ones do not.

    Args:
        samples: as many as ticks, and those before them, up to :data:`OLD_TICKS`, that are known.
        ticks: to judge.
        was: they have been old, and are so until recent commands explain them about as well.
    """
    u, y = samples.desired, samples.measured[-ticks:]
    joints = np.ptp(u[-ticks:], axis=0) > LEAST_TRAVEL_RAD
    # Commands of every second tick before; a band is of seven.
    count = max(min(OLD_TICKS, len(u) - ticks), 0) // 2
    first = np.arange(LAGS // 2 + 1, count - BAND, 3)
    if not (joints.any() and len(first)):
        return False
    u, y = u[:, joints], y[:, joints]
    lagged = np.stack([u[len(u) - ticks - 2 * k :][:ticks] for k in range(count)], axis=1)
    x, z = (lagged - lagged.mean(axis=0)).transpose(2, 0, 1), (y - y.mean(axis=0)).T[:, :, None]
    gram, to = x.transpose(0, 2, 1) @ x, (x.transpose(0, 2, 1) @ z)[:, :, 0]
    band = np.concatenate([[0], first])[:, None] + np.arange(BAND + 1)
    of_band, to_band = gram[:, band[:, :, None], band[:, None, :]], to[:, band]
    ridge = RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None, None] * np.eye(BAND + 1)
    fitted = np.linalg.solve(of_band + ridge + 1e-300 * np.eye(BAND + 1), to_band[..., None])
    explained = (fitted[..., 0] * to_band).sum(axis=2)
    square = np.maximum((z[:, :, 0] ** 2).sum(axis=1), 1e-12)
    rest = (1.0 - explained / square[:, None]).mean(axis=0)
    limit = OLD_STAYS * rest[0] if was else min(OLD_RATIO * rest[0], OLD_MOST)
    return bool(rest[0] > OLD_REST and rest[1:].min() < limit)


def steps_of(readings: Array, described_rad: float) -> Array:
    """Compute the steps of the grids that (n, J) readings lie on, where finer than described."""
    values = np.sort(readings.T, axis=1)
    gaps = values[:, 1:] - values[:, :-1]
    own = np.where(gaps > GRID_RAD, gaps, np.inf).min(axis=1, initial=np.inf)
    phases = (values[:, 1:] - values[:, :1]) / own[:, None]
    new = gaps > 0.0  # each value once, and the first
    on_grid = 1 + ((np.abs(phases - np.rint(phases)) < 0.1) & new).sum(axis=1)
    found = np.isfinite(own) & (on_grid >= GRID_SHARE * (1 + new.sum(axis=1)))
    return np.where(found, np.minimum(own, described_rad), described_rad)


class Survey(NamedTuple):
    """Holds what the looks at a recording have found."""

    copies: tuple[int, ...]  # joints that are copies, by the newest look that says so
    unclear: tuple[int, ...]  # joints that were, for some strides, or are not told from copies
    old: bool


def survey(samples: LegMotion, step_rad: float) -> Survey:
    """Look at a whole recording as the tick does.

    Args:
        samples: all; where few swings are known, half of :data:`ENOUGH_TICKS` passes for a stride,
            and where none is, a leg for one that carries nothing.
        step_rad: of the encoder.
    """
    swings, n = samples.swing, len(samples.seq)
    check, seen, old = InformationCheck(samples.measured.shape[1], step_rad), set[int](), False
    turns = () if swings is None else np.flatnonzero(np.diff(swings.astype(np.int8))).tolist()
    looks = {at + 2: bool(swings[at + 1]) for at in turns} if swings is not None else {}
    if len(turns) < LEAST_TURNS:
        every = ENOUGH_TICKS // 2
        looks = dict.fromkeys(range(n % every or every, n + 1, every), True)
    for count, begins in looks.items():
        newest = samples.part(np.s_[max(count - NEEDED_SAMPLES, 0) : count])
        check.check_strides(count, newest, begins=begins, predicted=None if turns else True)
        old |= check.found is not None and check.found.kind == "old"
        seen |= set(check.copies)
    seen |= set(check.open_joints if check.unproved else ())
    return Survey(check.copies, tuple(sorted(seen - set(check.copies))), old)
