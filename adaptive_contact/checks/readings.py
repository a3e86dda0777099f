"""Finds faults in a leg's readings, compared with its commands.

Works on the samples of a few seconds, or of a recording; needs no model.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.checks.findings import Fault
from adaptive_contact.checks.information import held_shares, survey
from adaptive_contact.checks.limits import Limits, find_limits
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.checks.position_step import STEP_TOLERANCE, position_step
from adaptive_contact.core.detect.stream import MAX_RUN, MAX_TIME_NS, MIN_RUN
from adaptive_contact.fit.recordings import stray_readings
from adaptive_contact.robot.description import ASSUMED_STEP_RAD
from adaptive_contact.wire import ServoSample
from adaptive_contact.wire.messages import MAX_PREVIEW_TICKS

Ticks = Ints  # seq

# A joint counts as commanded to move when its command travels this far, rad (3 degrees, 10 steps of
# an AX-12A), and as frozen when its reading then keeps one value.
_COMMANDED_RAD: Final = 0.05
# A joint stands if its command moves this far, rad, and its reading follows by less than a
# twentieth of that: only its encoder's last step flickers.
_WIDE_RAD: Final = 0.3
# Median of |measured - desired|, rad: an AX-12A lags some 0.1 rad in fast swings; 0.4 rad over
# seconds is a wrong zero, a wrong direction or a stalled joint.
_FAR_RAD: Final = 0.4
# Least number of ticks that compare a joint's motion with its command's.
_FEWEST_MOVING: Final = 50


# What the service expects of a sample's fields, and whether one of so many joints has it.
_FIELDS: Final[Mapping[str, tuple[str, Callable[[ServoSample, int], bool]]]] = {
    "t_ns": ("0 to 2^63 - 1", lambda s, _: 0 <= s.t_ns <= MAX_TIME_NS),
    "seq": ("0 to 2^63 - 1", lambda s, _: 0 <= s.seq <= MAX_TIME_NS),
    "run": ("a whole number of 64 bits", lambda s, _: s.run is None or MIN_RUN <= s.run <= MAX_RUN),
    "valid": ("one value per joint", lambda s, joints: s.valid is None or len(s.valid) == joints),
    "preview": (
        f"{MAX_PREVIEW_TICKS} ticks at most, of one number per joint",
        lambda s, joints: (
            len(s.preview or ()) <= MAX_PREVIEW_TICKS
            and all(len(row) == joints and all(map(math.isfinite, row)) for row in s.preview or ())
        ),
    ),
}


def check_fields(samples: Sequence[ServoSample], joints: int) -> Iterator[Fault]:
    """Name the fields for which the service refuses samples that it can read."""
    for name, (expected, is_right) in _FIELDS.items():
        wrong = [s for s in samples if not is_right(s, joints)]
        if wrong:
            count, total = len(wrong), len(samples)
            yield Fault.from_table(
                "field",
                f"{count} of {total}",
                count,
                name,
                total=total,
                name=name,
                expected=expected,
            )


def check_readings(
    samples: Sequence[ServoSample],
    names: Sequence[str],
    quantum_rad: float | None,
    limits_rad: Sequence[Sequence[float]] | None = None,
) -> Iterator[Fault]:
    """Judge one leg's readings and commands.

    Args:
        samples: all with as many joints.
        names: of the joints.
        quantum_rad: position step that they should have, None where it is unknown.
        limits_rad: lower and upper one of each joint, in the samples' angles, where they are known.
    """
    finite = [s for s in samples if all(map(math.isfinite, (*s.measured, *s.desired)))]
    spoilt, total = len(samples) - len(finite), len(samples)
    if spoilt:
        yield Fault.from_table("not_finite", f"{spoilt} of {total}", spoilt, total=total)
    motion = LegMotion.from_samples([s for s in finite if s.valid is None or all(s.valid)])
    if len(motion.seq) < 10:
        return
    measured, desired = motion.measured, motion.desired
    whole = (measured == np.round(measured)).all() and np.ptp(measured) > 2.0
    measured, jumps = _without_turns(measured)
    desired, told_jumps = _without_turns(desired)
    units = _units(measured, desired, names, "register steps" if whole else "degrees")
    if units is not None:
        yield units
        return
    motion = motion._replace(measured=measured, desired=desired)
    near = np.median(np.abs(measured - desired), axis=0) <= _FAR_RAD
    grids = [position_step(read) or 0.0 for read in measured.T]
    step_rad = quantum_rad or max(grids) or ASSUMED_STEP_RAD
    found = survey(motion, step_rad)
    for cause, joints in (("echo", found.copies), ("near_echo", found.unclear)):
        # A copy is near its command; a reading far from it has another fault.
        of_cause = [j for j in joints if near[j]]
        if of_cause:
            every = len(of_cause) == len(names)
            which = None if every else ", ".join(names[j] for j in of_cause)
            yield Fault.from_table(cause, which, key="" if every else "some")
            if cause == "echo":
                return
    if found.old:
        yield Fault.from_table("old")
        return
    for j, name in enumerate(names):
        turns = round(float(np.median(measured[:, j] - desired[:, j])) / math.tau)
        measured[:, j] -= turns * math.tau
        jumped = int(jumps[j] + told_jumps[j])
        if jumped or turns:
            detail = f"{name} jumps {jumped} times" if jumped else f"{name} reads {turns:+d} turns"
            yield Fault.from_table("turn", detail, float(jumped + abs(turns)))
    order = _order_of(measured, desired)
    if order is not None:
        moved = [i for i, of in enumerate(order) if of != i]
        follows = (f"{names[i]} follows the command of {names[order[i]]}" for i in moved)
        yield Fault.from_table("order", " and ".join(follows))
        return
    if quantum_rad is not None:
        # Steps coarser than described take a joint several ticks each.
        yield from _held(motion, names, [max(quantum_rad, grid) for grid in grids])
    begun = _begun(desired, 0.0)
    if not begun and max(np.ptp(measured, axis=0)) > _WIDE_RAD:
        by_rad = float(np.ptp(measured, axis=0).max())
        yield Fault.from_table("frozen-desired", f"by {by_rad:.2f} rad", by_rad, "desired")
    for j, name in enumerate(names):
        yield from _joint(measured[:, j], desired[:, j], name, begun)
        if quantum_rad and grids[j] and abs(grids[j] / quantum_rad - 1.0) > STEP_TOLERANCE:
            read = f"{name} steps by {grids[j]:.4g} rad"
            yield Fault.from_table("quantum", read, grids[j], quantum_rad=quantum_rad)
    none = Limits.none(len(names))
    said = none if limits_rad is None else Limits(*np.array(limits_rad).T)
    yield from _beyond_limits(measured, names, said)
    ends = find_limits(None, said, none, step_rad, measured, desired)
    reached = ends.reached(names, desired)
    if reached:
        yield Fault.from_table("goals", reached)


def _beyond_limits(measured: Array, names: Sequence[str], limits: Limits) -> Iterator[Fault]:
    """Name joints whose readings, (n, J) rad, are beyond their limits and not for a moment only."""
    beyond = np.maximum(limits.lower - measured, measured - limits.upper)
    for name, by in zip(names, beyond.T, strict=True):
        # Beyond its limits by this, rad, in most samples, is no overshoot.
        out = by > 0.05
        share = float(out.mean())
        if share > 0.5:
            far = math.degrees(float(np.median(by[out])))
            yield Fault.from_table(
                "limits", f"{name} in {share:.0%} of the samples, by {far:.0f}°", share
            )


def _units(measured: Array, desired: Array, names: Sequence[str], like: str) -> Fault | None:
    # The 99th percentile of each joint's absolute angle.
    far_out = np.quantile(np.abs([measured, desired]), 0.99, axis=1, method="lower")
    largest = far_out.max(axis=0)
    j = int(np.argmax(largest))
    # An encoder that counts turns may be a few off, both of readings and of commands.
    # No joint of a leg goes beyond a turn; radians do not either.  An encoder that counts turns may
    # start a turn off.
    turns = largest[j] <= (8 * math.pi) and np.ptp(measured[:, j]) < math.pi
    if largest[j] <= (2 * math.pi + 0.1) or (turns and like == "degrees"):
        return None
    return Fault.from_table(
        "units", f"{names[j]} reaches {largest[j]:.4g}", float(largest[j]), like=like
    )


def _held(samples: LegMotion, names: Sequence[str], steps_rad: Sequence[float]) -> Iterator[Fault]:
    # Held for two ticks it is 0.5, for four 0.75, read every sixth tick 0.83; of the same motions
    # 0.24 at most.
    every = zip(names, held_shares(samples, np.array(steps_rad)).tolist(), strict=True)
    shares = {name: share for name, share in every if share > 0.4}
    if shares:
        most = max(shares.values())
        yield Fault.from_table("held", f"{', '.join(shares)} in up to {most:.0%} of ticks", most)


def _without_turns(angles: Array) -> tuple[Array, Ints]:
    """Remove jumps of whole turns from angles; return them and the jumps of each joint.

    Most stay as they are: the first may be one of those that are off.
    """
    steps = np.diff(angles, axis=0, prepend=angles[:1])
    turns = np.round(steps / math.tau)
    turns[np.abs(steps - math.tau * turns) >= 0.5] = 0.0
    off = np.cumsum(turns, axis=0)
    whole = angles - math.tau * (off - np.round(np.median(off, axis=0)))
    return whole, np.count_nonzero(turns, axis=0)


def _begun(desired: Array, rad: float) -> int:
    """Count ticks whose command, (n,) or any of (n, J), is further than ``rad`` from the first.

    A joint follows some ticks later; of a few, nothing is known.
    """
    away = np.abs(desired - desired[0]) > rad
    return int(np.count_nonzero(away if away.ndim == 1 else away.any(axis=1)))


def _order_of(measured: Array, desired: Array) -> tuple[int, ...] | None:
    """Return whose command every joint follows, if that is another joint's; else None."""
    joints = measured.shape[1]
    # Joints whose orders are all tried.
    if (
        not 2 <= joints <= 4
        or (np.ptp(desired, axis=0) < 2 * _COMMANDED_RAD).any()
        or min(_begun(commanded, _COMMANDED_RAD) for commanded in desired.T) < _FEWEST_MOVING
    ):
        return None
    apart = np.full((joints, joints), np.inf)
    for back in range(min(6, len(measured) - 1) + 1):
        off = measured[back:, :, None] - desired[: len(desired) - back, None, :]
        apart = np.minimum(apart, np.median(np.abs(off), axis=0))

    def far(order: tuple[int, ...]) -> float:
        return max(float(apart[i, of]) for i, of in enumerate(order))

    own = tuple(range(joints))
    best = min(itertools.permutations(own), key=far)
    # Readings that follow another joint's command: so much nearer than their own, and this near.
    return best if best != own and far(best) <= min(0.2, 0.35 * far(own)) else None


def _joint(measured: Array, desired: Array, name: str, begun: int) -> Iterator[Fault]:
    """Judge one joint by its command; ``begun``: ticks since any of its leg's commands changed."""
    commanded = float(np.ptp(desired))
    followed = _begun(desired, _COMMANDED_RAD) >= _FEWEST_MOVING
    moved = float(np.ptp(measured))
    still = moved == 0.0 if commanded < _WIDE_RAD else moved < 0.05 * commanded
    if followed and still:
        within = "" if moved == 0.0 else f" within {moved:.3f} rad"
        yield Fault.from_table(
            "frozen",
            f"{name} reads {np.median(measured):.3f} rad all the time{within}, its command moves "
            f"by {commanded:.2f} rad",
            commanded,
        )
        return
    off = float(np.median(np.abs(measured - desired)))
    far_enough = min(moved, commanded) >= 2 * _COMMANDED_RAD
    # Positions fall while commands rise.
    if followed and far_enough and np.corrcoef(measured, desired)[0, 1] < -0.7:
        yield Fault.from_table("backwards", name, moved)
    elif off > _FAR_RAD and not begun:
        yield Fault.from_table("far-still", f"{name} by {off:.2f} rad", off, "still")
    elif off > _FAR_RAD and begun >= _FEWEST_MOVING:
        yield Fault.from_table("far", f"{name} by {off:.2f} rad in the median", off)
    glitches = measured[stray_readings(measured[:, None])[:, 0]]
    if len(glitches):
        usual = float(np.median(glitches))
        count = f"{name} {len(glitches)} of {len(measured)}, to {usual:.3f} rad in the median"
        yield Fault.from_table("glitches", count, len(glitches), total=len(measured))
