r"""Finds joints whose angles grow the other way than ``robot.toml`` says, from the motion.

Half of all robots count pitch angles downwards, and a leg described so is learned, judged and
driven wrong without any error.  Three facts of a robot's body show it, none of them a model:

1. *Feet that stand do not move against each other.*  With the legs' mounts known, the distance of
   two standing feet is constant while the body moves over them.  For every choice of signs

   .. math:: \rho^2 = \frac{\overline{(\Delta |p_i - p_j|)^2}}{\overline{|\Delta p|^2}}

   over ticks in which both stand; right geometry leaves some 0.07, one wrong sign 0.2 to 3.
2. *A foot that swings is higher than one that stands*, and a foot that stands is below the axis
   that pitches it.  Both turn round with the signs of all pitch joints of a leg.
3. *The ground pushes up.*  Where a leg stands, it is above its command in the direction
   :math:`\partial h/\partial q`.

Only commands are used for 1 and 2: they have no noise, and no drift of a servo changes them.  A
finding needs facts that a right description contradicts *and* another choice that explains them;
all else is no finding: a wrong accusation is worse than silence.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot.angles import AngleFrame, angles_text
from adaptive_contact.robot.description import Leg, Mount, Robot
from adaptive_contact.robot.geometry import foot, height_gradients
from adaptive_contact.wire import ServoSample

__all__ = ["ConventionFinding", "LegMotion", "Verdict", "control_ticks", "judge_motion"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Displacements are taken over this time, s: long against the jitter of a command's rounding, short
# against a stance.
LAG_S: Final = 0.08
# Feet of a slow gait go too little way in it: then it is so many times as long.
SLOW_LAGS: Final = 3
# After a touch a controller may press the foot down for this long, s, and before the lift a
# phase may be told late.
SETTLE_S: Final = 0.12
BEFORE_LIFT_S: Final = 0.06
# Of the ticks of a pair, the worst share is left out: feet that slip, and touches.
TRIMMED: Final = 0.3
# A pair of legs with fewer ticks in common tells nothing.
LEAST_ROWS: Final = 40
# Rows of a pair that are looked at; more add nothing, as they come from the same swings.
MOST_ROWS: Final = 120
# Standing feet must move by so much per LAG_S, m, for their distance to tell anything.
LEAST_WAY_M: Final = 0.002
# rho of feet that stand: 0.03 to 0.05 where the description is right.
RIGID: Final = 0.1
# rho of a description that is wrong, and how many times better (in squares) the right one must be.
LOOSE: Final = 0.12
BETTER: Final = 4.0
# A leg's foot counts as above its axis, or below, in this share of its ticks.
SURE_SHARE: Final = 0.9
# Swings of a leg before its phase is compared with its height.
LEAST_SWINGS: Final = 4
LEAST_RISE_M: Final = 0.004
# A tick is slow below this speed, rad/s: there a servo's lag is no longer that of motion.
SLOW_RAD_S: Final = 1.0
LEAST_SLOW: Final = 50
# Where stamps and seq grow by amounts this far apart, s, another run of the source begins: no loop
# is as late.
MOST_ADRIFT_S: Final = 1.0
MOST_SEQ: Final = 2**60
# rho² beyond which a pair is as bad as can be.
MOST: Final = 4.0
_UPSIDE_DOWN: Final = "the foot is above its axis, and comes down in its swings"
# Patterns of signs grow as powers of two, and choices of them with the legs.
MOST_FLIPS: Final = 5
MOST_CHOICES: Final = 300_000


@dataclasses.dataclass(frozen=True)
class ConventionFinding:
    """One leg whose angles do not mean what its description says.

    Attributes:
        leg: its id.
        joints: names of the joints concerned.
        message: what was seen, one line without the leg's name.
        advice: what to write into ``robot.toml``, one line.
        directions: (J,) to write as ``[leg.angles] directions``; those in force included.
        offsets_rad: (J,) likewise.
        certain: False where another choice explains the motion as well.
    """

    leg: str
    joints: tuple[str, ...]
    message: str
    advice: str
    directions: tuple[int, ...]
    offsets_rad: tuple[float, ...]
    certain: bool = True

    def servo_advice(self, leg: Leg) -> str:
        """The same for a leg that the bridge reads, whose signs stand in ``[leg.servos]``."""
        servos, joints = leg.servos, len(leg.joints)
        directions = (servos.directions if servos else None) or (1,) * joints
        offsets = (servos.offsets_rad if servos else None) or (0.0,) * joints
        return "write " + angles_text(
            [sign * d for sign, d in zip(self.directions, directions, strict=True)],
            [s * o + p for s, o, p in zip(self.directions, offsets, self.offsets_rad, strict=True)],
            "[leg.servos]",
        )


@dataclasses.dataclass(frozen=True)
class LegMotion:
    """One leg's samples, in the frame of its description.

    Attributes:
        t_ns: (n,) times.
        measured: (n, J) rad.
        desired: (n, J) rad.
        swing: (n,) the source's word; None where it does not tell.
        seq: (n,) the source's count of control ticks, from any number on; None where only stamps
            tell them apart.
    """

    t_ns: NDArray[np.int64]
    measured: Array
    desired: Array
    swing: Mask | None = None
    seq: NDArray[np.int64] | None = None

    def between(self, first_ns: int, last_ns: int) -> LegMotion:
        """The samples from one time up to another."""
        rows = (self.t_ns >= first_ns) & (self.t_ns < last_ns)
        swing = None if self.swing is None else self.swing[rows]
        seq = None if self.seq is None else self.seq[rows]
        return LegMotion(self.t_ns[rows], self.measured[rows], self.desired[rows], swing, seq)

    @staticmethod
    def of_samples(samples: Sequence[ServoSample]) -> LegMotion:
        """The motion of accepted samples, in order and in the frame of the leg's description."""
        told = all(sample.phase is not None for sample in samples)
        return LegMotion(
            np.array([sample.t_ns for sample in samples], dtype=np.int64),
            np.array([sample.measured for sample in samples], dtype=np.float64),
            np.array([sample.desired for sample in samples], dtype=np.float64),
            np.array([sample.phase == "swing" for sample in samples]) if told else None,
            np.array([_counted(sample.seq, samples[0].seq) for sample in samples], dtype=np.int64),
        )


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the motion so far says.

    Attributes:
        findings: legs that are described wrong, in the robot's order.
        fits: legs whose description the motion confirms.
    """

    findings: tuple[ConventionFinding, ...] = ()
    fits: tuple[str, ...] = ()


def judge_motion(robot: Robot, motions: Mapping[str, LegMotion]) -> Verdict:
    """Judge the signs of all legs that have lengths.

    Args:
        robot: its description, as the samples were turned by.
        motions: by leg.
    """
    ticks = control_ticks(motions, robot.period_s)
    legs = [
        _Signs(leg, motions[leg.id], ticks[leg.id], robot.period_s)
        for leg in robot.legs
        if leg.id in ticks and leg.lengths_m is not None and len(ticks[leg.id]) > 1
    ]
    legs = [leg for leg in legs if len(leg.flips) > 1]
    if not legs:
        return Verdict()
    chosen = _choose_rigid(legs, robot.period_s) if _mounts_told(robot) else {}
    findings, fits = [], []
    for leg in legs:
        pattern = chosen.get(leg.leg.id)
        found = leg.judge() if pattern is None else leg.flips[pattern]
        if found is None:
            continue
        if isinstance(found, ConventionFinding):
            findings.append(found)
        elif (found > 0).all():
            fits.append(leg.leg.id)
        else:
            told = (
                _UPSIDE_DOWN
                if leg.upside_down(0)
                else "feet that stand move against each other, as they are described"
            )
            findings.append(_sign_finding(leg.leg, found, told))
    return Verdict(tuple(findings), tuple(fits))


def control_ticks(
    motions: Mapping[str, LegMotion], period_s: float
) -> dict[str, NDArray[np.int64]]:
    """Number the control tick of every sample, alike for all legs.

    Within a run of the source a leg's ticks are counted by ``seq``, so that stamps that jitter
    shift none.  How the counts of two legs lie against each other is told by the median of their
    stamps over the time that both have.

    Args:
        motions: by leg.
        period_s: the control tick.

    Returns:
        (n,) per leg.
    """
    runs = {leg: _runs(motion, period_s) for leg, motion in motions.items() if len(motion.t_ns)}
    if not runs:
        return {}
    first = max(runs, key=lambda leg: len(motions[leg].t_ns))
    for run in runs[first]:
        run.ticks = run.count + round(run.phase(*run.span))
    for leg, own in runs.items():
        for run in own if leg != first else ():
            shared = max(runs[first], key=lambda other: other.overlap(run))
            low, high = max(run.span[0], shared.span[0]), min(run.span[1], shared.span[1])
            if shared.overlap(run) > 0:
                between = run.phase(low, high) - shared.phase(low, high)
                run.ticks = run.count + int(shared.ticks[0] - shared.count[0]) + round(between)
            else:
                run.ticks = run.count + round(run.phase(*run.span))
    return {leg: np.concatenate([run.ticks for run in own]) for leg, own in runs.items()}


class _Run:
    """Samples of one leg that one count goes through.

    Attributes:
        count: (n,) ticks from any number on.
        span: first and last stamp, ticks.
        ticks: (n,) ticks, alike for all legs, once they are known.
    """

    def __init__(self, stamps: Array, count: NDArray[np.int64]) -> None:
        self.count, self.ticks = count, count
        self._stamps = stamps
        self.span = float(stamps[0]), float(stamps[-1])

    def overlap(self, other: _Run) -> float:
        """Time that both have, ticks."""
        return min(self.span[1], other.span[1]) - max(self.span[0], other.span[0])

    def phase(self, low: float, high: float) -> float:
        """By how much the stamps of a time are ahead of the count, median, ticks."""
        rows = (self._stamps >= low) & (self._stamps <= high)
        rows = rows if rows.any() else np.ones_like(rows)
        return float(np.median(self._stamps[rows] - self.count[rows]))


def _runs(motion: LegMotion, period_s: float) -> list[_Run]:
    """A leg's samples, cut where its count begins anew."""
    stamps = motion.t_ns / (period_s * 1e9)
    if motion.seq is None:
        return [_Run(stamps, np.rint(stamps).astype(np.int64))]
    steps = np.diff(motion.seq)
    lost = np.abs(np.diff(stamps) - steps) > MOST_ADRIFT_S / period_s
    cuts = np.flatnonzero((steps <= 0) | lost) + 1
    return [
        _Run(part, count)
        for part, count in zip(np.split(stamps, cuts), np.split(motion.seq, cuts), strict=True)
    ]


def _counted(seq: int, first: int) -> int:
    """``seq`` from the first one on, within what an array holds."""
    return max(-MOST_SEQ, min(seq - first, MOST_SEQ))


def _mounts_told(robot: Robot) -> bool:
    return sum(leg.mount != Mount() for leg in robot.legs) >= 2


class _Signs:
    """One leg under every pattern of signs.

    Attributes:
        flips: (F, J) 1 or -1; the description's is the first.
        grid: (n,) number of every sample's control tick.
    """

    def __init__(
        self, leg: Leg, motion: LegMotion, grid: NDArray[np.int64], period_s: float
    ) -> None:
        self.leg, self.motion, self.grid = leg, motion, grid
        self.pitch = np.array([axis == "pitch" for axis in leg.joint_axes])
        told = self.pitch.copy()
        if len(told) <= MOST_FLIPS:
            told |= ~self.pitch
        free = np.flatnonzero(told)[:MOST_FLIPS]
        self.flips = np.ones((2 ** len(free), len(leg.joints)))
        for row, signs in zip(
            self.flips, itertools.product((1.0, -1.0), repeat=len(free)), strict=True
        ):
            row[free] = signs
        self._settle = round(SETTLE_S / period_s)
        self._leave = round(BEFORE_LIFT_S / period_s)
        self._slow = SLOW_RAD_S * period_s
        self._places: dict[int, Array] = {}

    def place(self, pattern: int) -> Array:
        """(n, 3) m, the commanded foot in the leg's frame."""
        if pattern not in self._places:
            assert self.leg.lengths_m is not None
            turned = self.motion.desired * self.flips[pattern]
            self._places[pattern] = foot(turned, self.leg.lengths_m, self.leg.joint_axes)
        return self._places[pattern]

    def height(self, pattern: int) -> Array:
        """(n,) m of it."""
        return self.place(pattern)[:, 2]

    # -- alone -----------------------------------------------------------------------------------

    def rises(self, pattern: int) -> float | None:
        """Share of swings in which the commanded foot is higher than in the stance before."""
        swing = self.motion.swing
        if swing is None:
            return None
        edges = np.flatnonzero(np.diff(swing.astype(np.int8)))
        parts = np.split(self.height(pattern), edges + 1)
        if len(parts) < 3:
            return None
        first_swings = bool(swing[0])
        levels = [float(np.median(part)) for part in parts]
        pairs = [
            levels[i] - levels[i - 1] for i in range(1, len(levels)) if (i % 2 == 0) == first_swings
        ]
        told = [rise for rise in pairs if abs(rise) > LEAST_RISE_M]
        if len(told) < LEAST_SWINGS:
            return None
        return sum(rise > 0 for rise in told) / len(told)

    def below(self, pattern: int) -> float:
        """Share of ticks in which the commanded foot is below its first pitch axis."""
        return float(np.mean(self.height(pattern) < 0.0))

    def sane(self, pattern: int) -> bool:
        """Whether a leg that walks may move so."""
        rises = self.rises(pattern)
        return self.below(pattern) >= SURE_SHARE and (rises is None or rises >= SURE_SHARE)

    def insane(self, pattern: int) -> bool:
        """Whether a leg that walks cannot move so; not the opposite of :meth:`sane`."""
        rises = self.rises(pattern)
        return self.below(pattern) < 0.5 or (rises is not None and rises < 0.5)

    def upside_down(self, pattern: int) -> bool:
        """Whether a leg that walks moves the other way round."""
        rises = self.rises(pattern)
        return (
            self.below(pattern) <= 1 - SURE_SHARE
            and rises is not None
            and (rises <= 1 - SURE_SHARE)
        )

    def load_m(self, pattern: int) -> float | None:
        """How far above its command the foot is on slow ticks, median, m; None for too few."""
        motion, leg = self.motion, self.leg
        assert leg.lengths_m is not None
        moved = np.abs(np.diff(motion.measured, axis=0)).max(axis=1)
        next_tick = np.diff(self.grid) == 1
        slow = np.flatnonzero((moved < self._slow) & next_tick)
        if len(slow) < LEAST_SLOW:
            return None
        flip = self.flips[pattern]
        ahead = (motion.measured[slow + 1] - motion.desired[slow]) * flip
        at = motion.measured[slow + 1] * flip
        rise = height_gradients(at, leg.lengths_m, leg.joint_axes)
        first = int(np.flatnonzero(self.pitch)[0])
        return float(np.median(rise[:, first] * ahead[:, first]))

    def judge(self) -> ConventionFinding | None:
        """What this leg shows by itself; None for nothing that is sure."""
        wrong = self.upside_down(0)
        told = _UPSIDE_DOWN
        if not wrong and self.motion.swing is None and self.below(0) <= 1 - SURE_SHARE:
            load = self.load_m(0)
            wrong = load is not None and load < 0
            told = "the foot is above its axis, and the ground pushes it down"
        if not wrong:
            return None
        pitched = [k for k, flip in enumerate(self.flips) if (flip[~self.pitch] > 0).all()]
        left = [k for k in pitched if not self.insane(k) and self._within(k)]
        # That all of them are turned round is the usual case: half of all robots are.
        left.sort(key=lambda k: not (self.flips[k][self.pitch] < 0).all())
        best = next((k for k in left if self.sane(k)), None)
        if best is None:
            return None
        others = [self.flips[k] for k in left if k != best]
        return _sign_finding(self.leg, self.flips[best], told, others)

    def _within(self, pattern: int) -> bool:
        """Whether commands stay within the joints' limits, where there are any."""
        limits = self.leg.limits
        if limits is None:
            return True
        turned = self.motion.desired * self.flips[pattern]
        inside = (turned >= limits.lower_rad) & (turned <= limits.upper_rad)
        return bool(inside.all(axis=1).mean() >= SURE_SHARE)

    # -- with others -----------------------------------------------------------------------------

    def on_body(self, pattern: int) -> Array:
        """(n, 3) m, the commanded foot in the body's frame."""
        yaw = self.leg.mount.yaw_rad
        turn = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]]
        )
        return np.asarray(self.place(pattern) @ turn.T + np.array(self.leg.mount.xyz_m))

    def stands(self, pattern: int, lag: int) -> Mask:
        """(n,) ticks in which the foot stands, and has for ``lag`` ticks."""
        if self.motion.swing is not None:
            down = ~self.motion.swing
        else:  # by its height, the lower half of its range
            low, high = np.quantile(self.height(pattern), (0.05, 0.95))
            down = self.height(pattern) < (low + high) / 2
        count = np.concatenate([[0], np.cumsum(down)])
        n = len(down)
        settle = self._settle + lag
        first = np.maximum(np.arange(n) - settle, 0)
        last = np.minimum(np.arange(n) + self._leave + 1, n)
        steady = count[last] - count[first] == last - first
        steady[:settle] = False
        steady[lag:] &= self.grid[lag:] - self.grid[:-lag] == lag
        return np.asarray(steady)


class _Pairs:
    """rho² of pairs of legs, by the patterns of both, as it is asked for.

    Args:
        legs: those that are compared.
        lag: ticks of a displacement.
    """

    def __init__(self, legs: Sequence[_Signs], lag: int) -> None:
        self.legs, self._lag = legs, lag
        self._standing: dict[tuple[int, int], tuple[Array, NDArray[np.int64]]] = {}
        self._known: dict[tuple[int, int, int, int], tuple[float, float]] = {}

    def cost(self, chosen: Sequence[int], i: int) -> float:
        """rho² of a leg with the others, weighed by how often they stand together.

        Infinite where it stands with less than two.
        """
        found = [self._pair(i, j, chosen[i], k) for j, k in enumerate(chosen) if j != i]
        told = [(weight, ratio) for weight, ratio in found if weight > 0]
        if len(told) < 2:
            return np.inf
        return sum(w * r for w, r in told) / sum(w for w, _ in told)

    def rigid(self, chosen: Sequence[int]) -> bool:
        """Whether every leg that stands keeps its distances from the others."""
        return all(self.cost(chosen, i) < RIGID**2 for i in range(len(chosen)))

    def best(self, among: Sequence[Sequence[int]]) -> list[int]:
        """The choice of one of its patterns for each leg under which rho² is least, on average."""
        n = len(among)
        weighed = [np.zeros([1] * n) for _ in range(n)]
        weights = [np.zeros([1] * n) for _ in range(n)]
        for i, j in itertools.combinations(range(n), 2):
            found = np.array([[self._pair(i, j, a, b) for b in among[j]] for a in among[i]])
            shape = [len(among[k]) if k in (i, j) else 1 for k in range(n)]
            weight = found[..., 0].reshape(shape)
            share = np.where(weight > 0, weight * np.minimum(found[..., 1].reshape(shape), MOST), 0)
            for k in (i, j):
                weighed[k] = weighed[k] + share
                weights[k] = weights[k] + weight
        with np.errstate(invalid="ignore"):
            total = np.nan_to_num(
                np.stack([a / b for a, b in zip(weighed, weights, strict=True)]).sum(axis=0),
                nan=np.inf,
            )
        place = np.unravel_index(int(np.argmin(total)), total.shape)
        return [among[i][int(k)] for i, k in enumerate(place)]

    def _pair(self, i: int, j: int, a: int, b: int) -> tuple[float, float]:
        if i > j:
            return self._pair(j, i, b, a)
        key = (i, j, a, b)
        if key not in self._known:
            self._known[key] = self._compare(*key)
        return self._known[key]

    def _stands(self, i: int, pattern: int) -> tuple[Array, NDArray[np.int64]]:
        """Ticks in which a leg stands: (m, 2, 3) m where its foot is and was, (m,) their number."""
        key = (i, pattern)
        if key not in self._standing:
            leg = self.legs[i]
            rows = np.flatnonzero(leg.stands(pattern, self._lag))
            place = leg.on_body(pattern)
            both = np.stack([place[rows], place[rows - self._lag]], axis=1)
            self._standing[key] = both, leg.grid[rows]
        return self._standing[key]

    def _compare(self, i: int, j: int, a: int, b: int) -> tuple[float, float]:
        """(weight, rho²) of legs i and j with patterns a and b; weight 0 where it cannot be told.

        Legs that stand by turns meet in few ticks, those of a touch and a lift, which tell little:
        the weight is the square of the number of ticks.
        """
        (p, mine), (q, theirs) = self._stands(i, a), self._stands(j, b)
        _, rows, columns = np.intersect1d(mine, theirs, return_indices=True)
        count = len(rows)
        if count < LEAST_ROWS:
            return 0.0, np.inf
        step = -(-count // MOST_ROWS)
        p, q = p[rows[::step]], q[columns[::step]]
        between = np.linalg.norm(p - q, axis=2)
        apart = np.abs(between[:, 0] - between[:, 1])
        way2 = np.square(np.stack([p, q])[:, :, 0] - np.stack([p, q])[:, :, 1]).sum(axis=2).mean(0)
        kept = np.argsort(apart)[: math.ceil((1 - TRIMMED) * len(apart))]
        way = float(way2[kept].mean())
        if way < LEAST_WAY_M**2:
            return 0.0, np.inf
        return float(count) ** 2, float(np.square(apart[kept]).mean() / way)


def _choose_rigid(legs: Sequence[_Signs], period_s: float) -> dict[str, int]:
    """Patterns of signs under which the standing feet keep their distances; empty for none.

    Legs that stay out are those that no choice, or more than one, explains.
    """
    if len(legs) < 3:
        return {}
    described = [0] * len(legs)
    ticks = max(round(LAG_S / period_s), 1)
    for lag in (ticks, SLOW_LAGS * ticks):
        pairs = _Pairs(legs, lag)
        if all(np.isfinite(pairs.cost(described, i)) for i in range(len(legs))):
            break
    if pairs.rigid(described) and all(leg.sane(0) for leg in legs):
        return dict.fromkeys((leg.leg.id for leg in legs), 0)
    sane = [[k for k in range(len(leg.flips)) if leg.sane(k)] for leg in legs]
    if not all(sane) or math.prod(map(len, sane)) > MOST_CHOICES:
        return {}
    best = pairs.best(sane)
    if not pairs.rigid(best):
        return {}
    chosen = {}
    for i, leg in enumerate(legs):
        # Every other pattern of this leg must be worse, or nothing is said of it.
        least = BETTER * pairs.cost(best, i)
        others = [pairs.cost([*best[:i], k, *best[i + 1 :]], i) for k in sane[i] if k != best[i]]
        if all(cost > max(least, LOOSE**2) for cost in others):
            chosen[leg.leg.id] = best[i]
    return chosen


def _sign_finding(
    leg: Leg, flip: Array, told: str, others: Sequence[Array] = ()
) -> ConventionFinding:
    """The finding of wrong signs, with what to write; directions in force are taken along."""
    frame = AngleFrame(leg)
    signs = [int(sign) for sign in flip]
    joints = tuple(name for name, sign in zip(leg.joints, signs, strict=True) if sign < 0)
    directions = tuple(s * d for s, d in zip(signs, frame.directions, strict=True))
    offsets = tuple(s * o + 0.0 for s, o in zip(signs, frame.offsets_rad, strict=True))
    advice = "write " + angles_text(directions, offsets, "[leg.angles]")
    for other in others:
        turned = [int(s) * d for s, d in zip(other, frame.directions, strict=True)]
        advice += f"; if that does not help, directions = {turned}"
    message = f"the angles of {_listed(joints)} grow the wrong way: {told}"
    return ConventionFinding(
        leg.id, joints, message, advice, directions, offsets, certain=not others
    )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
