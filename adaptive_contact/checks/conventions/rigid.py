r"""Tests whether standing feet keep their distances, whatever the body does over them.

With the legs' mounts known, the distance of two standing feet is constant.  How far commanded feet
break that is

.. math:: \rho^2 = \frac{\overline{(\Delta |p_i - p_j|)^2}}{\overline{|\Delta p|^2}}

over ticks in which both stand.  Where a description reads the angles right, it is 0.03 to 0.08,
and least: :func:`fit_readings` finds the order, the signs and the zeros for which it is least, from
starts all over their range.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.robot.description import Leg

# Displacements are taken over this time, s: long against the jitter of a command's rounding, short
# against a stance.
LAG_S: Final = 0.08
# After a touch a controller may press the foot down for this long, s, and before the lift a
# phase may be reported late.
SETTLE_S: Final = 0.12
BEFORE_LIFT_S: Final = 0.06
# A pair of legs with fewer ticks in common shows nothing.
LEAST_ROWS: Final = 40
# Rows of a pair that are looked at; more add nothing, as they come from the same swings.
MOST_ROWS: Final = 120
# Standing feet must move by so much per displacement, m, for their distance to show anything.
LEAST_WAY_M: Final = 0.002
# rho² beyond which a pair is as bad as can be.
MOST: Final = 4.0
# Starts of a search: steps of an offset, rad, by the number of pitch joints; more are not searched.
START_STEPS_RAD: Final = {1: math.pi / 8, 2: math.pi / 4, 3: math.pi / 2}
# rho of feet that stand: 0.03 to 0.08 where the description is right.
RIGID: Final = 0.1
# A foot that carries is above its command by these shares of the leg's reach.  Three to six of six
# simulated legs that walk are by 0.001 to 0.012; of a real robot that hangs, feet are by 0.0002 at
# most, or, where a joint does not follow, by 0.01 to 0.2.
CARRIED: Final = 0.001
LIMP: Final = 0.03
# How many times better (in squares) the right reading must be than any other.
BETTER: Final = 4.0
# Below this rho nothing but rounding and slip is left: what is below is as good.
FLOOR: Final = 0.03
# Errors of rows are not independent: their mean square is as sure as that of so many.
SWINGS: Final = 30
# Zeros are reported where their standard deviation is within this, rad.
SURE_RAD: Final = 0.05
_NUDGE_RAD: Final = 1e-3
_DAMPING, _MOST_DAMPING = 1e-4, 1e2


class Reading(NamedTuple):
    """How a source's angles are read: ``directions * angles[order] + offsets_rad``."""

    order: tuple[int, ...]  # (J,) which of the source's values is each joint's
    directions: tuple[int, ...]  # (J,) 1 or -1
    offsets_rad: tuple[float, ...]  # (J,) rad

    @staticmethod
    def plain(joints: int) -> Reading:
        """As they come."""
        return Reading(tuple(range(joints)), (1,) * joints, (0.0,) * joints)

    def angles(self, source: Array) -> Array:
        """(n, J) rad of the description for (n, J) rad of the source."""
        plain = self.order == tuple(range(len(self.order)))
        ordered = source if plain else source[:, list(self.order)]
        return np.asarray(ordered * np.array(self.directions) + np.array(self.offsets_rad))

    def shifted(self, by_rad: Sequence[float] | Array) -> Reading:
        """The same with zeros moved on."""
        moved = [float(o + d) for o, d in zip(self.offsets_rad, by_rad, strict=True)]
        return self._replace(offsets_rad=tuple(moved))


@dataclasses.dataclass(frozen=True)
class Stream:
    """What one leg was commanded."""

    leg: Leg  # its description, with geometry and mount
    desired: Array  # (n, J) rad
    grid: Ints  # (n,) control ticks
    swing: Mask | None  # (n,) as the source reports; None where it does not

    def place(self, reading: Reading, rows: Ints | None = None) -> Array:
        """(n, 3) m, the commanded foot in the leg's frame."""
        assert self.leg.chain is not None
        source = self.desired if rows is None else self.desired[rows]
        return self.leg.chain.foot(reading.angles(source))


def on_body(leg: Leg, place: Array) -> Array:
    """(n, 3) m in the body's frame, of places in the leg's."""
    yaw = leg.mount.yaw_rad
    turn = np.array(
        [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
    )
    return np.asarray(place @ turn.T + np.array(leg.mount.xyz_m))


def standing(stream: Stream, height: Array, lag: int, period_s: float) -> Mask:
    """(n,) ticks in which the foot stands, and has for ``lag`` ticks.

    Args:
        stream: of the leg.
        height: (n,) m of its foot; used where the source does not report the phase.
        lag: ticks of a displacement.
        period_s: the control tick.
    """
    if stream.swing is not None:
        down = ~stream.swing
    else:  # by its height, the lower half of its range
        low, high = np.quantile(height, (0.05, 0.95))
        down = height < (low + high) / 2
    count = np.concatenate([[0], np.cumsum(down)])
    n = len(down)
    settle = round(SETTLE_S / period_s) + lag
    first = np.maximum(np.arange(n) - settle, 0)
    last = np.minimum(np.arange(n) + round(BEFORE_LIFT_S / period_s) + 1, n)
    steady = count[last] - count[first] == last - first
    steady[:settle] = False
    steady[lag:] &= stream.grid[lag:] - stream.grid[:-lag] == lag
    return np.asarray(steady)


def pushed_up(reach_m: float, commanded: Array, read: Array) -> bool:
    """Whether a foot that stands is above its command, as the ground holds it up.

    Args:
        reach_m: of the leg.
        commanded: (m,) m, its height in the ticks in which it stands.
        read: (m,) m, by the readings of these ticks.
    """
    up = float(np.median(read - commanded)) if len(read) else 0.0
    return CARRIED * reach_m < up < LIMP * reach_m


def rigidity(p: Array, q: Array) -> float:
    """rho² of two feet; infinite where they hardly move.

    Args:
        p: (m, 2, 3) m, where one is and was.
        q: (m, 2, 3) m, likewise.
    """
    change, way2 = _changes(p, q)
    kept = _least(change)
    way = float(way2[kept].mean())
    return float(np.square(change[kept]).mean() / way) if way >= LEAST_WAY_M**2 else np.inf


def _changes(p: Array, q: Array) -> tuple[Array, Array]:
    """(m,) m by which the feet's distance changes, and (m,) m² of their way."""
    between = np.linalg.norm(p - q, axis=2)
    both = np.stack([p, q])
    way2 = np.square(both[:, :, 0] - both[:, :, 1]).sum(axis=2).mean(axis=0)
    return between[:, 0] - between[:, 1], way2


def _least(change: Array) -> Ints:
    """Rows without the worst."""
    # Of the ticks of a pair, the worst share is left out: feet that slip, and touches.
    return np.argsort(np.abs(change))[: math.ceil((1 - 0.3) * len(change))]


class Meeting(NamedTuple):
    """Two streams and their rows of the same control ticks."""

    i: int
    j: int
    rows: Ints  # (m,) of stream i
    columns: Ints  # (m,) of stream j


def meetings(streams: Sequence[Stream]) -> list[Meeting]:
    """Rows of every two streams in which both have a sample."""
    found = []
    for i, j in itertools.combinations(range(len(streams)), 2):
        grids = streams[i].grid, streams[j].grid
        _, rows, columns = np.intersect1d(*grids, return_indices=True)
        found.append(Meeting(i, j, rows, columns))
    return found


class _Pair(NamedTuple):
    """Two legs and the places of their common rows in each leg's."""

    i: int
    j: int
    rows: Ints
    columns: Ints
    weight: float


class _Foot(NamedTuple):
    """A leg's commanded foot by one reading."""

    reading: Reading
    place: Array  # (2, 3, m) m in the body's frame, where it is and was
    way2: Array  # (m,) m²


class _Compared(NamedTuple):
    """Two feet, and what became of their distance."""

    feet: tuple[_Foot, _Foot]
    change: Array  # (m,) m
    way2: Array  # (m,) m², mean of both


class Feet:
    """Feet that stand, to be read in many ways.

    Args:
        streams: of three legs or more.
        lag: ticks of a displacement.
        period_s: the control tick.
        readings: by which the height shows which legs stand, where the source does not.
        met: :func:`meetings` of the streams, where they are known.
    """

    def __init__(
        self,
        streams: Sequence[Stream],
        lag: int,
        period_s: float,
        readings: Sequence[Reading],
        met: Sequence[Meeting] | None = None,
    ) -> None:
        self.streams = streams
        stands = []
        for stream, reading in zip(streams, readings, strict=True):
            height = stream.place(reading)[:, 2]
            stands.append(standing(stream, height, lag, period_s))
        pairs: list[_Pair] = []
        used: list[list[Ints]] = [[] for _ in streams]
        for i, j, rows, columns in meetings(streams) if met is None else met:
            both = stands[i][rows] & stands[j][columns]
            a, b = rows[both], columns[both]
            if len(a) < LEAST_ROWS:
                continue
            step = -(-len(a) // MOST_ROWS)
            a, b = a[::step], b[::step]
            used[i].append(a)
            used[j].append(b)
            # Legs that stand by turns meet in few ticks, those of a touch and a lift.
            pairs.append(_Pair(i, j, a, b, float(len(a) * step) ** 2))
        looked_at = [np.unique(np.concatenate(own)) if own else np.arange(0) for own in used]
        self._pairs = [
            pair._replace(
                rows=np.searchsorted(looked_at[pair.i], pair.rows),
                columns=np.searchsorted(looked_at[pair.j], pair.columns),
            )
            for pair in pairs
        ]
        self._desired = [
            stream.desired[np.concatenate([own, own - lag])]
            for stream, own in zip(streams, looked_at, strict=True)
        ]
        # Of the readings asked for last: a search moves one leg, or asks for rows, then for errors.
        self._feet: list[_Foot | None] = [None] * len(streams)
        self._last: list[_Compared | None] = [None] * len(pairs)

    def _foot(self, k: int, reading: Reading) -> _Foot:
        """A leg's foot by a reading; kept for the next time."""
        known = self._feet[k]
        if known is None or known.reading != reading:
            leg = self.streams[k].leg
            assert leg.chain is not None
            both = on_body(leg, leg.chain.foot(reading.angles(self._desired[k])))
            place = np.ascontiguousarray(both.reshape(2, -1, 3).transpose(0, 2, 1))
            known = self._feet[k] = _Foot(reading, place, _squared(place[0] - place[1]))
        return known

    def _compared(self, readings: Sequence[Reading]) -> Iterator[tuple[_Pair, Array, Array]]:
        """Every pair with the changes of its distance, (m,) m, and its ways squared, (m,) m²."""
        feet = [self._foot(k, reading) for k, reading in enumerate(readings)]
        for k, pair in enumerate(self._pairs):
            mine, theirs = feet[pair.i], feet[pair.j]
            known = self._last[k]
            if known is None or known.feet[0] is not mine or known.feet[1] is not theirs:
                apart = mine.place[:, :, pair.rows] - theirs.place[:, :, pair.columns]
                now, then = (np.sqrt(_squared(one)) for one in apart)
                way2 = (mine.way2[pair.rows] + theirs.way2[pair.columns]) / 2.0
                known = self._last[k] = _Compared((mine, theirs), now - then, way2)
            yield pair, known.change, known.way2

    def costs(self, readings: Sequence[Reading], least_partners: int = 2) -> Array:
        """(n,) rho² of every leg with the others; infinite where it stands with too few of them."""
        total, weight = np.zeros(len(self.streams)), np.zeros(len(self.streams))
        partners = np.zeros(len(self.streams))
        for pair, change, way2 in self._compared(readings):
            kept = _least(change)
            way = float(way2[kept].mean())
            if way < LEAST_WAY_M**2:
                continue
            for k in (pair.i, pair.j):
                total[k] += pair.weight * np.square(change[kept]).mean() / way
                weight[k] += pair.weight
                partners[k] += 1
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(partners >= least_partners, total / weight, np.inf)

    def kept(self, readings: Sequence[Reading]) -> list[Ints]:
        """Rows of every pair that are not left out as its worst."""
        return [_least(change) for _, change, _ in self._compared(readings)]

    def errors(self, readings: Sequence[Reading], kept: Sequence[Ints]) -> Array:
        """(m,) changes of distance over each pair's way, weighed: their squares add to rho²."""
        whole = sum(pair.weight for pair in self._pairs)
        parts = [
            change[rows]
            * math.sqrt(pair.weight / whole / len(rows) / max(way2[rows].mean(), LEAST_WAY_M**2))
            for (pair, change, way2), rows in zip(self._compared(readings), kept, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros(0)


def _squared(vectors: Array) -> Array:
    """(m,) squared lengths of (3, m) vectors."""
    return np.asarray(np.square(vectors).sum(axis=0))


class Refined(NamedTuple):
    """Zeros near a start for which the feet are most rigid."""

    moved_rad: Array  # (n, J) rad by which the zeros of every leg have moved
    # the largest standard deviation of a parameter, rad: where the motion does not show a zero, as
    # that of feet that go to and fro in a line, it is large
    spread_rad: float


def refine(feet: Feet, readings: Sequence[Reading], moved: Sequence[Sequence[int]]) -> Refined:
    """Find the zeros near a start for which the feet are most rigid, by Gauss-Newton.

    Args:
        feet: that stand.
        readings: (n,) of the legs, to start from.
        moved: of every leg, the parameter that shifts each joint's zero, -1 for none; legs that
            share a parameter are shifted alike.
    """
    count = 1 + max(max(own) for own in moved)

    def at(x: Array) -> list[Reading]:
        padded = np.append(x, 0.0)
        return [r.shifted(padded[list(own)]) for r, own in zip(readings, moved, strict=True)]

    def cost(x: Array) -> float:
        read = at(x)
        return float(np.square(feet.errors(read, feet.kept(read))).sum())

    def linear(x: Array) -> tuple[Array, Array]:
        read = at(x)
        kept = feet.kept(read)
        base = feet.errors(read, kept)
        slopes = [feet.errors(at(x + nudge), kept) - base for nudge in _NUDGE_RAD * np.eye(count)]
        jacobian = np.stack(slopes, axis=1) / _NUDGE_RAD
        return jacobian.T @ jacobian, jacobian.T @ base

    x, damping = np.zeros(count), _DAMPING
    least = cost(x)
    normal, slope = linear(x)
    for _ in range(12):
        scale = damping * (np.trace(normal) / count + _DAMPING)
        step = -np.linalg.solve(normal + scale * np.eye(count), slope)
        tried = cost(x + step)
        if tried >= least:
            if damping > _MOST_DAMPING:
                break
            damping *= 10
            continue
        x, least, damping = x + step, tried, damping / 10
        normal, slope = linear(x)
        if np.abs(step).max() < 1e-3:
            break
    weakest = float(np.linalg.eigvalsh(normal)[0])
    floor = max(least, FLOOR**2) / SWINGS
    padded = np.append(x, 0.0)
    return Refined(
        np.stack([padded[list(own)] for own in moved]),
        math.sqrt(floor / weakest) if weakest > 0 else math.inf,
    )


def fit_readings(
    streams: Sequence[Stream], lag: int, period_s: float, sane: Callable[[int, Reading], bool]
) -> Reading | None:
    """Find the signs and zeros, the same for all legs, for which standing feet are rigid.

    Args:
        streams: of three straight legs or more, with the same axes.
        lag: ticks of a displacement.
        period_s: the control tick.
        sane: whether a leg, by its place, may move so.

    Returns:
        The only reading that explains the motion; None for none, or more than one.
    """
    axes = streams[0].leg.joint_axes
    pitched = [j for j, axis in enumerate(axes) if axis == "pitch"]
    step = START_STEPS_RAD.get(len(pitched))
    if step is None or any(stream.leg.joint_axes != axes for stream in streams):
        return None
    legs = len(streams)
    # Rows of a leg that show whether a start is worth a search, and the share that must be below
    # the axis there; a start is not yet the answer.
    glanced = [np.arange(0, len(s.grid), max(len(s.grid) // 60, 1)) for s in streams]
    phase_given = all(stream.swing is not None for stream in streams)
    plain = Reading.plain(len(axes))
    met = meetings(streams)
    shared = Feet(streams, lag, period_s, [plain] * legs, met) if phase_given else None
    angles = np.arange(-math.pi, math.pi - _NUDGE_RAD, step)
    starts = []
    for directions in itertools.product((1, -1), repeat=len(axes)):
        for zeros in itertools.product(angles, repeat=len(pitched)):
            offsets = [0.0] * len(axes)
            for j, zero in zip(pitched, zeros, strict=True):
                offsets[j] = float(zero)
            reading = Reading(plain.order, directions, tuple(offsets))
            if any(
                np.mean(s.place(reading, rows)[:, 2] < 0.0) < 0.8
                for s, rows in zip(streams, glanced, strict=True)
            ):
                continue
            feet = shared or Feet(streams, lag, period_s, [reading] * legs, met)
            cost = float(np.minimum(feet.costs([reading] * legs), MOST).mean())
            starts.append((cost, reading, feet))
    starts.sort(key=lambda start: start[0])
    found: list[tuple[float, float, Reading]] = []
    for _, reading, feet in starts[:6]:
        refined = refine(feet, [reading] * legs, [range(len(axes))] * legs)
        best = _near_zero(reading.shifted(refined.moved_rad[0]))
        if not all(sane(k, best) for k in range(legs)):
            continue
        if not phase_given:
            feet = Feet(streams, lag, period_s, [best] * legs, met)
        cost = float(np.minimum(feet.costs([best] * legs), MOST).max())
        found.append((max(cost, FLOOR**2), refined.spread_rad, best))
    if not found:
        return None
    found.sort(key=lambda each: each[0])
    least, spread, best = found[0]
    rivals = [cost for cost, _, reading in found[1:] if not _alike(reading, best)]
    if spread > SURE_RAD or least >= RIGID**2 or any(cost < BETTER * least for cost in rivals):
        return None
    return best


def _near_zero(reading: Reading) -> Reading:
    """The same with offsets within half a turn."""
    return reading._replace(
        offsets_rad=tuple(math.remainder(offset, math.tau) for offset in reading.offsets_rad)
    )


def _alike(one: Reading, other: Reading) -> bool:
    """Whether two readings are the same but for what a fit leaves open."""
    apart = [a - b for a, b in zip(one.offsets_rad, other.offsets_rad, strict=True)]
    same = one.order == other.order and one.directions == other.directions
    # Two fits whose zeros are closer are the same, rad.
    return same and all(abs(math.remainder(d, math.tau)) < 0.15 for d in apart)
