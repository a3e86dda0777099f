"""What a leg's servo stream looks like from outside, and what is wrong with it.

Works on the samples of a few seconds; needs no service and no model.  Each finding says what
was seen, what was expected, and what to do.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.service.status import LegFacts
from adaptive_contact.wire import Rejected, ServoSample

__all__ = ["Finding", "Level", "check_leg"]

Level = Literal["error", "warning", "note"]
Array = NDArray[np.float64]

# A rate further off than this is not jitter: 50 Hz that is really 45 shifts every velocity.
_RATE_TOLERANCE: Final = 0.05
# A joint counts as told to move when its command travels this far, rad (3 degrees, 10 steps of
# an AX-12A), and as frozen when its reading then keeps one value.
_COMMANDED_RAD: Final = 0.05
_FROZEN_SAMPLES: Final = 25
# Median of |measured - desired|, rad: an AX-12A lags some 0.1 rad in fast swings; 0.4 rad over
# seconds is a wrong zero, a wrong direction or a stalled joint.
_FAR_RAD: Final = 0.4
# No joint of a leg goes beyond a turn; radians do not either.
_BEYOND_RAD: Final = 2 * math.pi + 0.1
_INVALID_SHARE: Final = 0.05
_LOSS_SHARE: Final = 0.002
_FEWEST: Final = 10
# A source that is restarted by hand starts once or twice in the seconds looked at.
_MANY_STARTS: Final = 4
_BACKWARDS_CORRELATION: Final = -0.7

_Item = tuple[Level, str, str]


class Finding(NamedTuple):
    """One thing that is wrong, and what to do; ``leg`` is None for the whole robot.

    A ``note`` is worth knowing and no fault.
    """

    level: Level
    leg: str | None
    what: str
    remedy: str


def check_leg(
    leg: str,
    samples: Sequence[ServoSample],
    refused: Sequence[Rejected],
    *,
    seconds: float,
    period_s: float | None = None,
    facts: LegFacts | None = None,
) -> list[Finding]:
    """Judge one leg's stream.

    Args:
        leg: its id.
        samples: as they arrived within the time looked at.
        refused: why payloads on its key could not be read.
        seconds: time looked at.
        period_s: control tick the service expects, None where no service tells.
        facts: what the service knows of the leg, None where it does not.

    Returns:
        Findings, the worst first; empty where all is well.
    """
    if not samples:
        silent: _Item = (
            "error",
            f"no usable sample on robot/leg/{leg}/servo in {seconds:.0f} s",
            "start the bridge or `adaptive-contact sim`; compare the leg's id and --namespace",
        )
        only = list(_refusals(refused)) or [silent]
        return [Finding(level, leg, what, remedy) for level, what, remedy in only]
    joints = Counter(len(sample.measured) for sample in samples).most_common(1)[0][0]
    found: list[_Item] = [
        *_refusals(refused),
        *_shape(samples, joints, facts),
        *_publishers(samples),
        *_order(samples, period_s),
    ]
    usable = [s for s in samples if len(s.measured) == len(s.desired) == joints]
    if len(usable) >= _FEWEST:
        names = facts.joints if facts is not None and len(facts.joints) == joints else None
        found += _values(
            np.array([s.measured for s in usable], dtype=np.float64),
            np.array([s.desired for s in usable], dtype=np.float64),
            names or [f"joint {i + 1}" for i in range(joints)],
        )
    ranks: dict[Level, int] = {"error": 0, "warning": 1, "note": 2}
    found.sort(key=lambda item: ranks[item[0]])
    return [Finding(level, leg, what, remedy) for level, what, remedy in found]


def _refusals(refused: Sequence[Rejected]) -> Iterator[_Item]:
    if refused:
        reason, times = Counter(item.reason for item in refused).most_common(1)[0]
        detail = next(item.detail for item in refused if item.reason == reason)
        yield (
            "error",
            f"{len(refused)} payloads cannot be read; {reason} {times} times: {detail}",
            "publish msgpack or JSON maps as docs/messages.md has them, with the encoding to match",
        )


def _shape(samples: Sequence[ServoSample], joints: int, facts: LegFacts | None) -> Iterator[_Item]:
    if facts is not None and not facts.described:
        yield (
            "warning",
            "the leg is not in the service's robot.toml",
            "add a [[leg]] with this id, or correct the id that the source publishes",
        )
    elif facts is not None and joints != len(facts.joints):
        yield (
            "error",
            f"samples have {joints} joints, robot.toml has {len(facts.joints)} "
            f"({', '.join(facts.joints)})",
            "correct `joints` of this leg in robot.toml, or what the source publishes",
        )
    odd = sum(len(s.measured) != joints or len(s.desired) != joints for s in samples)
    if odd:
        yield (
            "error",
            f"{odd} of {len(samples)} samples have unequal numbers of joints in measured and "
            "desired, or fewer than the others",
            "publish one value per joint in both; use `valid` for a servo that did not answer",
        )
    if facts is not None and not facts.lengths and all(s.phase is None for s in samples):
        yield (
            "warning",
            "samples carry no phase, and robot.toml has no lengths_m to infer it from",
            "add lengths_m to this leg in robot.toml, or publish phase from the gait controller",
        )
    invalid = sum(s.valid is not None and not all(s.valid) for s in samples)
    if invalid > _INVALID_SHARE * len(samples):
        yield (
            "warning",
            f"{invalid / len(samples):.0%} of the samples have readings marked invalid",
            "look for servos that do not answer: cable, power, ids, baud rate",
        )


def _publishers(samples: Sequence[ServoSample]) -> Iterator[_Item]:
    runs = [s.run for s in samples]
    changes = sum(a != b for a, b in pairwise(runs))
    if changes > len(set(runs)):
        yield (
            "error",
            f"{len(set(runs))} publishers take turns (run values {sorted(map(str, set(runs)))})",
            "stop all but one; only the one started last is used",
        )
    elif changes >= _MANY_STARTS:
        yield (
            "error",
            f"`run` changes {changes} times in {len(samples)} samples",
            "set `run` once, when the source starts: every change of it is a new start",
        )


def _order(samples: Sequence[ServoSample], period_s: float | None) -> Iterator[_Item]:
    # Within one run only: a restart may begin anew.
    pairs = [(a, b) for a, b in pairwise(samples) if a.run == b.run]
    if not pairs:
        return
    backwards = sum(b.t_ns <= a.t_ns for a, b in pairs)
    repeated = sum(b.seq == a.seq for a, b in pairs)
    lost = sum(max(0, b.seq - a.seq - 1) for a, b in pairs)
    if backwards:
        yield (
            "error",
            f"t_ns does not increase in {backwards} of {len(pairs)} samples",
            "use a monotonic clock at the source, and set a new `run` at each of its starts",
        )
    if repeated:
        yield (
            "error",
            f"{repeated} samples repeat the seq before them",
            "count seq up by one per control tick; look for two publishers of this leg",
        )
    if lost > _LOSS_SHARE * len(samples):
        yield (
            "warning",
            f"{lost} samples are lost ({lost / (lost + len(samples)):.1%}), by gaps in seq",
            "look for an overloaded machine or network, or a source that skips ticks",
        )
    steps = np.array([(b.t_ns - a.t_ns) / (b.seq - a.seq) for a, b in pairs if b.seq > a.seq])
    if len(steps) >= _FEWEST and period_s is not None:
        yield from _rate(float(np.median(steps)) / 1e9, period_s)


def _rate(step_s: float, period_s: float) -> Iterator[_Item]:
    if step_s <= 0 or abs(step_s / period_s - 1) <= _RATE_TOLERANCE:
        return
    for unit, factor in (("microseconds", 1e3), ("milliseconds", 1e6), ("seconds", 1e9)):
        if abs(step_s * factor / period_s - 1) <= _RATE_TOLERANCE:
            yield (
                "error",
                f"t_ns grows by {step_s * 1e9:.3g} per tick; it seems to be in {unit}",
                "publish t_ns in nanoseconds, as an integer",
            )
            return
    yield (
        "error",
        f"ticks are {step_s * 1e3:.1f} ms apart ({1 / step_s:.1f} Hz); robot.toml says "
        f"{period_s * 1e3:.1f} ms ({1 / period_s:.1f} Hz)",
        "correct period_s in robot.toml, or the rate of the control loop",
    )


def _values(measured: Array, desired: Array, names: Sequence[str]) -> Iterator[_Item]:
    finite = np.logical_and.reduce(np.isfinite(np.hstack([measured, desired])), axis=1)
    if not finite.all():
        yield (
            "error",
            f"{int((~finite).sum())} of {finite.size} samples hold NaN or infinity",
            "publish the last reading with valid = false for a servo that did not answer",
        )
    measured, desired = measured[finite], desired[finite]
    if len(measured) < _FEWEST:
        return
    for j, name in enumerate(names):
        yield from _joint(measured[:, j], desired[:, j], name)


def _joint(measured: Array, desired: Array, name: str) -> Iterator[_Item]:
    largest = float(max(np.abs(measured).max(), np.abs(desired).max()))
    if largest > _BEYOND_RAD:
        yield (
            "error",
            f"{name} reaches {largest:.1f}, more than a turn in radians",
            "publish radians; these look like degrees or register steps",
        )
        return
    told = float(np.ptp(desired))
    if told > _COMMANDED_RAD and np.ptp(measured) == 0.0 and len(measured) >= _FROZEN_SAMPLES:
        yield (
            "error",
            f"{name} reads {measured[0]:.3f} rad all the time while its command moves by "
            f"{told:.2f} rad",
            "the servo does not answer or has no torque; check cable, power and id",
        )
        return
    off = float(np.median(np.abs(measured - desired)))
    if _runs_backwards(measured, desired):
        yield (
            "error",
            f"{name} moves against its command",
            "turn its sign: servos.directions in robot.toml for the bridge",
        )
    elif off > _FAR_RAD:
        yield (
            "error",
            f"{name} is {off:.2f} rad from its command, in the median",
            "check zero and direction of the servo (servos.offsets_rad, servos.directions)",
        )


def _runs_backwards(measured: Array, desired: Array) -> bool:
    """Whether positions go down where commands go up; only for a joint that moves a good deal."""
    if min(np.ptp(measured), np.ptp(desired)) < 2 * _COMMANDED_RAD:
        return False
    return float(np.corrcoef(measured, desired)[0, 1]) < _BACKWARDS_CORRELATION
