"""Checks whether samples fit their robot's description, for ``robot check --live``.

Works on the samples of any source.  Where a robot walks, signs, order and zeros are judged from its
motion (:mod:`~adaptive_contact.checks.conventions.judge`).  Where it hangs or stands, its owner
moves one joint after the other by hand, and compares what he sees with what is said here: which
joint moved, and where the foot went by the description.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from typing import Final

import msgspec
import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.checks.conventions.judge import check_motion
from adaptive_contact.checks.findings import Fault, Finding, entries
from adaptive_contact.checks.legcheck import check_ids, check_leg
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.core.detect.stream import fault_of
from adaptive_contact.robot import AngleFrame, Angles, Leg, Mount, Robot, axis_text
from adaptive_contact.status import LegFacts
from adaptive_contact.wire import Rejected, ServoSample, decode, leg_of_key
from adaptive_contact.wire.received import Received

# Samples kept of a leg: two minutes at 50 Hz.
_KEPT: Final = 6000
# A joint that moved by less than this share of the one that moved most has only given way.
_GAVE_WAY: Final = 0.3
# Least number of feet that show a plane.
_LEAST_FEET: Final = 4


class JointView(msgspec.Struct, frozen=True, kw_only=True):
    """Describes one joint, in the description's angles."""

    joint: str
    axis: str  # `yaw`, `pitch`, `roll`, or a direction such as `0 1 0`
    # angle_rad, goal_rad: of the newest sample
    angle_rad: float
    goal_rad: float
    # low_rad, high_rad: least and largest reading
    low_rad: float
    high_rad: float
    limits_rad: tuple[float, float] | None  # of robot.toml
    direction: int  # of `[leg.angles]`, or of `[leg.servos]`, which the bridge has applied
    wire_rad: float  # the newest reading as the source sends it

    @property
    def outside(self) -> bool:
        """Return whether the newest reading is beyond the limits."""
        limits = self.limits_rad
        return limits is not None and not limits[0] <= self.angle_rad <= limits[1]


class LegView(msgspec.Struct, frozen=True, kw_only=True):
    """Describes one leg as it is now."""

    leg: str
    rate_hz: float | None  # by the source's stamps; None for too few
    joints: list[JointView]
    # height_m, reach_m: of the foot over the first axis, and away from it; None without lengths
    height_m: float | None = None
    reach_m: float | None = None
    # forward_m, left_m: of the foot from the middle of the body
    forward_m: float | None = None
    left_m: float | None = None
    # height of the foot over its command, of a leg at rest: negative for a leg that hangs, as
    # gravity pulls it down, positive for one that stands
    above_m: float | None = None


class Flatness(msgspec.Struct, frozen=True, kw_only=True):
    """Measures how flat the feet lie, for a robot that stands on a level floor."""

    # whose foot is furthest from the plane of the others; None with four legs, which do not show
    # whose it is
    leg: str | None
    off_m: float  # by how much it is above that plane


class LiveReport(msgspec.Struct, frozen=True, kw_only=True):
    """Holds the result of a live check."""

    seconds: float
    legs: list[LegView]  # those of the description that send samples
    moves: list[str]  # joints that were moved and came to rest, one line each
    # legs whose signs, and those not `by_hand` whose order and zeros, the motion confirms
    confirmed: list[str]
    open: list[str]  # legs of which the motion shows nothing
    # legs whose order and zeros no motion confirms, as their chain is not straight
    by_hand: list[str]
    flatness: Flatness | None  # of the feet, where all legs rest
    findings: list[Finding]  # what is wrong, the worst first

    @property
    def exit_code(self) -> int:
        """Return 0 where nothing is worse than a note, else 1."""
        return int(any(finding.level != "note" for finding in self.findings))


class LiveCheck:
    """Takes in what is on the wire, and judges it against a robot's description."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._legs = {leg.id: _LegCheck(leg, robot) for leg in robot.legs}
        self._strangers: set[str] = set()
        self.moves: list[str] = []  # joints that were moved and came to rest, one line each

    def process_message(self, received: Received) -> None:
        """Process one message; all but samples are ignored."""
        leg = leg_of_key(received.key)
        if leg is None or not received.key.endswith("/servo"):
            return
        sample = decode(received.payload, ServoSample, received.encoding)
        if leg not in self._legs:
            self._strangers.add(leg)
        elif isinstance(sample, Rejected):
            self._legs[leg].refused.append(sample)
        else:
            self.add_sample(leg, sample)

    def add_sample(self, leg_id: str, sample: ServoSample) -> None:
        """Process a sample of a leg of the description."""
        moved = self._legs[leg_id].update(sample)
        if moved is not None:
            self.moves.append(moved)

    def legs(self) -> list[LegView]:
        """Return every leg that sends samples, as it is now."""
        return [leg.view() for leg in self._legs.values() if leg.turned]

    def report(self, seconds: float) -> LiveReport:
        """Judge what was taken in within ``seconds``."""
        motions = {
            name: LegMotion.from_samples(leg.turned)
            for name, leg in self._legs.items()
            if len(leg.turned) > 1
        }
        verdict = check_motion(self._robot, motions)
        sending = [name for name, leg in self._legs.items() if leg.samples or leg.refused]
        published, known = sorted({*sending, *self._strangers}), self._robot.leg_ids
        faults: list[tuple[str | None, Fault]] = [
            (None, fault) for fault in check_ids(published, known, self._robot.name)
        ]
        for name, leg in self._legs.items():
            of_leg = check_leg(
                name,
                list(leg.samples),
                list(leg.refused),
                seconds=seconds,
                period_s=self._robot.period_s,
                facts=LegFacts.from_robot(self._robot, name),
            )
            faults += [(name, fault) for fault in of_leg]
            if wrong := verdict.get(name):
                signs = Fault.from_table(
                    "signs", wrong.line(leg.leg), level="error" if wrong.grave else "warning"
                )
                faults.append((name, signs))
        chains = {name: self._legs[name].leg.chain for name in motions}
        return LiveReport(
            seconds=seconds,
            legs=self.legs(),
            moves=self.moves,
            confirmed=[name for name, finding in verdict.items() if finding is None],
            open=[name for name in motions if name not in verdict],
            by_hand=[leg for leg, chain in chains.items() if chain and not chain.is_straight],
            flatness=_flatness({leg.leg: leg.last for leg in self._legs.values() if leg.rests}),
            findings=entries(faults),
        )


class _LegCheck:
    """Gathers the samples of one leg, converted to the angles of its description."""

    def __init__(self, leg: Leg, robot: Robot) -> None:
        self.leg = leg
        self.samples: deque[ServoSample] = deque(maxlen=_KEPT)
        self.turned: deque[ServoSample] = deque(maxlen=_KEPT)
        self.refused: deque[Rejected] = deque(maxlen=1000)
        self._frame = AngleFrame(leg)
        told = leg.angles or leg.servos or Angles()
        self._signs = told.directions or (1,) * len(leg.joints)
        # A leg rests when no joint has moved by two steps of an AX-12A for this long, s.
        self._rest_ticks = max(round(0.3 / robot.period_s), 2)
        self._rested: Array | None = None

    def update(self, sample: ServoSample) -> str | None:
        """Process a sample; return what was moved, once it rests again."""
        self.samples.append(sample)
        answered = sample.valid is None or all(sample.valid)
        if not answered or fault_of(sample, len(self.leg.joints)) is not None:
            return None
        self.turned.append(self._frame.sample(sample))
        if not self.rests:
            return None
        before, now = self._rested, self.last
        # 7 degrees: no move by hand.  A joint at rest creeps: a move is measured from where the
        # rest began.
        if before is not None and np.abs(now - before).max() < 0.12:
            return None
        self._rested = now
        return None if before is None else _moved(self.leg, before, now)

    @property
    def last(self) -> Array:
        """Return the newest reading, (J,) rad."""
        return np.array(self.turned[-1].measured)

    @property
    def rests(self) -> bool:
        rows = itertools.islice(reversed(self.turned), self._rest_ticks)
        recent = np.array([row.measured for row in rows])
        return len(recent) == self._rest_ticks and bool((np.ptp(recent, axis=0) < 0.011).all())

    def view(self) -> LegView:
        newest, leg = self.turned[-1], self.leg
        measured = np.array([sample.measured for sample in self.turned])
        limits = leg.limits
        joints = [
            JointView(
                joint=name,
                axis=axis_text(leg.joint_axes[j]),
                angle_rad=newest.measured[j],
                goal_rad=newest.desired[j],
                low_rad=float(measured[:, j].min()),
                high_rad=float(measured[:, j].max()),
                limits_rad=None if limits is None else (limits.lower_rad[j], limits.upper_rad[j]),
                direction=self._signs[j],
                wire_rad=self._frame.wire(newest.measured)[j],
            )
            for j, name in enumerate(leg.joints)
        ]
        view = LegView(leg=leg.id, rate_hz=self._rate_hz(), joints=joints)
        if leg.chain is None:
            return view
        place = leg.chain.foot(newest.measured)
        body = leg.on_body(place)
        known = leg.mount != Mount()
        commanded = leg.chain.foot(newest.desired)[2]
        return msgspec.structs.replace(
            view,
            above_m=float(place[2] - commanded) if self.rests else None,
            height_m=float(place[2]),
            reach_m=float(np.hypot(place[0], place[1])),
            forward_m=float(body[0]) if known else None,
            left_m=float(body[1]) if known else None,
        )

    def _rate_hz(self) -> float | None:
        rows = [row for row in self.turned if row.run == self.turned[-1].run]
        span_s = (rows[-1].t_ns - rows[0].t_ns) / 1e9
        return (len(rows) - 1) / span_s if span_s > 0 else None


def _moved(leg: Leg, before: Array, now: Array) -> str:
    """Describe which joints were moved, and where on the body the foot went by the description."""
    by = now - before
    most = np.abs(by).max()
    joints = ", ".join(
        f"{name} {np.degrees(by[j]):+.1f}°"
        for j, name in enumerate(leg.joints)
        if abs(by[j]) >= _GAVE_WAY * most
    )
    if leg.chain is None:
        return f"{leg.id}: {joints}"
    was, came = (leg.on_body(leg.chain.foot(q)) for q in (before, now))
    ahead, left, up = came - was
    ways = ((up, "up", "down"), (ahead, "forward", "back"), (left, "left", "right"))
    most = max(abs(way) for way, *_ in ways)
    parts = [
        f"{plus if way > 0 else minus} by {abs(way) * 1e3:.0f} mm"
        for way, plus, minus in ways
        if abs(way) >= _GAVE_WAY * most
    ]
    return f"{leg.id}: {joints}: the foot went {' and '.join(parts)}"


def _flatness(resting: Mapping[Leg, Array]) -> Flatness | None:
    """Measure how far the feet are from a plane; None if too few legs with mounts rest."""
    placed = {
        leg.id: leg.on_body(leg.chain.foot(q))
        for leg, q in resting.items()
        if leg.chain is not None and leg.mount != Mount()
    }
    names, points = list(placed), np.array(list(placed.values()))
    if len(names) < _LEAST_FEET:
        return None
    off = []
    for k in range(len(names)):
        rest = np.delete(points, k, axis=0)
        flat = np.column_stack([rest[:, :2], np.ones(len(rest))])
        plane = np.linalg.lstsq(flat, rest[:, 2], rcond=None)[0]
        left = float(np.abs(rest[:, 2] - flat @ plane).max())
        off.append((left, float(points[k, 2] - np.append(points[k, :2], 1.0) @ plane)))
    # The odd one out leaves the others flat; with four legs three always are.
    odd = min(range(len(names)), key=lambda k: off[k][0])
    return Flatness(leg=names[odd] if len(names) > _LEAST_FEET else None, off_m=off[odd][1])
