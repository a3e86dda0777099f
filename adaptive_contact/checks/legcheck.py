"""Finds faults in a leg's stream of servo samples.

Works on the samples of a few seconds, or of a recording; needs no service and no model.  Each fault
says what was seen, what was expected, and what to do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from adaptive_contact.checks.findings import Fault, Finding, entries, many, name_legs
from adaptive_contact.checks.position_step import position_step
from adaptive_contact.checks.readings import check_fields, check_readings
from adaptive_contact.checks.source_watch import NOTED_JITTER, RateWatch
from adaptive_contact.robot import Robot
from adaptive_contact.robot.description import ASSUMED_STEP_RAD
from adaptive_contact.status import LegFacts
from adaptive_contact.wire import Reject, Rejected, ServoSample

# A rate further off than this is not jitter: 50 Hz that is really 45 shifts every velocity.
_RATE_TOLERANCE: Final = 0.05
# No leg is controlled faster, s: 5 kHz.
_SHORTEST_S: Final = 2e-4
# Stamps with a standard deviation of NOTED_JITTER periods or more are reported, as by the learner.
# A loop on a timer is off by 0.01 to 0.05 at 50, 100 and 200 Hz (two cores, ten
# processes waiting to run); one that sleeps for a period by 0.04 to 0.07 at 50 Hz, 0.1 to 0.3 at
# 100; the loop times of a Raspberry Pi 5 (issue 27) by 0.36.
_FEWEST_STAMPS: Final = 25
_FEWEST: Final = 10
# Servos with coarser steps than 1.1 degrees are not made for legs; a step in degrees is.
MOST_QUANTUM_RAD: Final = 0.02


def check_leg(
    leg: str,
    samples: Sequence[ServoSample],
    refused: Sequence[Rejected],
    *,
    seconds: float,
    period_s: float | None = None,
    facts: LegFacts | None = None,
) -> list[Fault]:
    """Judge one leg's stream.

    Args:
        leg: its id.
        samples: as they arrived within the time looked at.
        refused: why payloads on its key could not be read.
        seconds: time looked at.
        period_s: control tick the service expects, None without a service's word.
        facts: what the service knows of the leg, None where it does not.

    Returns:
        Faults; empty where all is well.
    """
    refusals = list(_refusals(refused, len(samples) + len(refused)))
    if not samples:
        key = "" if facts is None or facts.described else leg
        return refusals or [Fault.from_table("silent", key=key, seconds=seconds)]
    joints = Counter(len(sample.measured) for sample in samples).most_common(1)[0][0]
    found = [
        *refusals,
        *_shape(samples, joints, facts),
        *_publishers(samples),
        *_order(samples, period_s),
        *check_fields(samples, joints),
    ]
    usable = [s for s in samples if len(s.measured) == len(s.desired) == joints]
    quantum = None if facts is None else facts.quantum_rad
    if quantum is not None and quantum > MOST_QUANTUM_RAD:
        found.append(_coarse(quantum))
        quantum = None
    if len(usable) >= _FEWEST:
        known = facts if facts is not None and len(facts.joints) == joints else None
        names = [f"joint {i + 1}" for i in range(joints)] if known is None else known.joints
        causes = {"time_unit", "seq", "time_backwards"}
        if facts is None and causes.isdisjoint(fault.cause for fault in found):
            found += _undeclared(samples, usable)
        elif known is not None and known.described and known.quantum_rad is None:
            step_rad = max(_grids(usable), default=0.0)
            if step_rad > ASSUMED_STEP_RAD:
                found.append(
                    Fault.from_table("undeclared-step", f"of {step_rad:.3g} rad", step_rad)
                )
        limits = None if known is None else known.limits_rad
        found += check_readings(usable, names, quantum, limits)
    return found


def check_recording(
    robot: Robot,
    samples: Mapping[str, Sequence[ServoSample]],
    refused: Mapping[str, Sequence[Rejected]],
) -> list[Finding]:
    """Judge the streams of a recording as ``doctor`` judges live ones.

    Args:
        robot: that they are taken for.
        samples: by leg, in the recording's order; a leg without any is not judged.
        refused: why payloads of a leg could not be read.
    """
    faults = [
        (leg, fault)
        for leg in robot.leg_ids
        if samples.get(leg) or refused.get(leg)
        for fault in check_leg(
            leg,
            samples.get(leg, ()),
            refused.get(leg, ()),
            seconds=0.0,
            period_s=robot.period_s,
            facts=LegFacts.from_robot(robot, leg),
        )
    ]
    return entries([*faults, *check_twins(samples)])


def check_twins(samples: Mapping[str, Sequence[ServoSample]]) -> Iterator[tuple[str, Fault]]:
    """Find legs that send another leg's readings, to the last bit.

    Yields:
        A fault of each such leg, with its id.
    """
    # What a leg reads while it moves this far in a tick, rad.  Of legs that walk alike, on
    # servos of 0.3 degrees, less than one such reading in a hundred is another leg's.
    moving = {
        leg: {
            tuple(row.measured)
            for before, row in pairwise(rows)
            if any(
                abs(new - old) > 0.01
                for new, old in zip(row.measured, before.measured, strict=False)
            )
        }
        for leg, rows in samples.items()
    }
    for leg, mine in moving.items():
        alike = [
            other
            for other, theirs in moving.items()
            if len(mine & theirs) >= max(_FEWEST, 0.8 * min(len(mine), len(theirs)))
        ]
        if len(alike) > 1:  # more than itself
            yield leg, Fault.from_table("twins", key=" ".join(sorted(alike)))


def check_ids(published: Sequence[str], described: Sequence[str], robot: str) -> Iterator[Fault]:
    """Compare the legs that a source publishes with those of a robot's description.

    Yields:
        A fault of the whole robot where both have legs that the other lacks.
    """
    strangers = [leg for leg in published if leg not in described]
    missing = [leg for leg in described if leg not in published]
    if strangers and missing:
        yield Fault.from_table(
            "leg_ids", robot=robot, strangers=name_legs(strangers), missing=name_legs(missing)
        )


def _refusals(refused: Sequence[Rejected], total: int) -> Iterator[Fault]:
    """Yield faults of payloads that could not be read; ``total`` is the number of all."""
    parts: dict[str, list[Rejected]] = {}
    for item in refused:
        whole = item.reason in (Reject.MALFORMED, Reject.TOO_LARGE)
        name = "unreadable" if whole else "unreadable-fields"
        parts.setdefault("time_type" if "$.t_ns" in item.detail else name, []).append(item)
    for name, items in parts.items():
        reason, number = Counter(item.reason for item in items).most_common(1)[0]
        detail = next(item.detail for item in items if item.reason == reason)
        found = f"{len(items)} refused; {reason} {number} times: {detail}"
        yield Fault.from_table(name, found, len(items), reason, total=total)


def _shape(samples: Sequence[ServoSample], joints: int, facts: LegFacts | None) -> Iterator[Fault]:
    if facts is not None and not facts.described:
        yield Fault.from_table("undescribed")
    elif facts is not None and joints != len(facts.joints):
        yield Fault.from_table(
            "joints", joints=joints, count=len(facts.joints), names=", ".join(facts.joints)
        )
    odd = sum(len(s.measured) != joints or len(s.desired) != joints for s in samples)
    if odd:
        yield Fault.from_table(
            "joints-odd", f"{odd} of {len(samples)}", odd, "odd", total=len(samples)
        )
    if facts is not None and not facts.lengths and all(s.phase is None for s in samples):
        yield Fault.from_table("phase")
    yield from _phases(samples)
    share = sum(s.valid is not None and not all(s.valid) for s in samples) / len(samples)
    if share > 0.05:
        yield Fault.from_table("invalid", f"{share:.0%} of them", share)


def _phases(samples: Sequence[ServoSample]) -> Iterator[Fault]:
    """Yield a fault where ``phase`` never changes although the leg must have swung or stood."""
    # No swing takes so many samples in a row: two seconds at 50 Hz.
    phases = {s.phase for s in samples} if len(samples) >= 100 else ()
    if phases == {"swing"}:
        yield Fault.from_table("phase-swing", f"{len(samples)} samples", key="swing")
    elif phases == {"stance"} and _goes_to_and_fro(samples):
        yield Fault.from_table("phase-stance", f"{len(samples)} samples", key="stance")


def _goes_to_and_fro(samples: Sequence[ServoSample]) -> bool:
    """Return whether the joint with the widest command passes its middle four times or more."""
    joints = len(samples[0].desired)
    desired = np.array([s.desired for s in samples if len(s.desired) == joints], dtype=np.float64)
    # A leg that walks: its widest joint travels so far, rad.
    low, high = desired.min(axis=0), desired.max(axis=0)
    above = (desired > (low + high) / 2.0)[:, np.argmax(high - low)]
    return bool((high - low).max() > 0.3 and np.count_nonzero(np.diff(above)) >= 4)


def _publishers(samples: Sequence[ServoSample]) -> Iterator[Fault]:
    runs = [s.run for s in samples]
    changes = sum(a != b for a, b in pairwise(runs))
    if changes > len(set(runs)):
        values = f"run values {', '.join(sorted(map(str, set(runs)))[:3])}"
        yield Fault.from_table("two_publishers", values, publishers=len(set(runs)))
    # A source that is restarted by hand starts once or twice in the seconds looked at; `run` lasts
    # for seconds.
    elif changes >= 4 and len(samples) < 50 * (changes + 1):
        yield Fault.from_table("run", f"{changes} times in {len(samples)} samples", changes)


def _order(samples: Sequence[ServoSample], period_s: float | None) -> Iterator[Fault]:
    # Within one run only: after a restart the source may count from 0.
    if not (pairs := [(a, b) for a, b in pairwise(samples) if a.run == b.run]):
        return
    total = len(pairs)
    backwards = sum(b.t_ns <= a.t_ns and b.seq > a.seq for a, b in pairs)
    repeated = sum(b.seq == a.seq for a, b in pairs)
    back = [(a, b) for a, b in pairs if b.seq < a.seq]
    usual = _usual_step(pairs)
    lost = sum(max(0, round((b.seq - a.seq) / usual) - 1) for a, b in pairs)
    if backwards:
        yield Fault.from_table(
            "time_backwards", f"in {backwards} of {total} samples", backwards, total=total
        )
    if repeated:
        yield Fault.from_table("seq", f"{repeated} of {total}", repeated, total=total)
    if usual > 1:
        yield Fault.from_table("seq-step", size=total, key="step", step=usual, lost=usual - 1)
    steps = _steps_s(pairs, usual)
    if back:
        times = f"{len(back)} times, such as {back[-1][0].seq} to {back[-1][1].seq}"
        wraps = None if steps is None else _wraps_at(back, usual, steps[1])
        if wraps is not None:
            yield Fault.from_table("seq-wrap", times, len(back), "wrap", wraps=wraps)
        else:
            yield Fault.from_table("seq-back", times, len(back), "back", total=total)
    if many(lost, len(samples)):
        yield Fault.from_table("loss", f"{lost} ({lost / (lost + len(samples)):.1%})", lost)
    if steps is None:
        return
    mean_s, middle_s = steps
    if period_s is None and middle_s < _SHORTEST_S:
        yield Fault.from_table("time_unit", step=middle_s * 1e9, unit="not to be in nanoseconds")
    elif period_s is not None and (
        # A pause bends the mean, jitter the median: the rate is wrong where both are.
        min(_off(mean_s, period_s), _off(middle_s, period_s)) > _RATE_TOLERANCE
    ):
        yield _rate(middle_s, period_s)
    elif not backwards and not back and usual == 1:
        yield from _jitter(samples, mean_s if period_s is None else period_s)


def _wraps_at(
    back: Sequence[tuple[ServoSample, ServoSample]], usual: int, period_s: float
) -> int | None:
    """Return the number at which ``seq`` wraps to 0 while time goes on; None if it does not."""
    ends = set()
    for a, b in back:
        ticks = round((b.t_ns - a.t_ns) / (1e9 * period_s))
        # Ticks that may be lost where seq begins again at 0.
        ends.add(a.seq + ticks * usual - b.seq if 1 <= ticks <= 3 else None)
    return ends.pop() if len(ends) == 1 else None


def _usual_step(pairs: Sequence[tuple[ServoSample, ServoSample]]) -> int:
    """Return the step of ``seq`` between most samples; 1 where no step is usual."""
    steps = [b.seq - a.seq for a, b in pairs if b.seq > a.seq]
    usual = round(float(np.median(steps))) if steps else 1
    alike = sum(abs(step - usual) <= usual / 4 for step in steps)
    return usual if len(steps) >= _FEWEST and alike > len(steps) / 2 else 1


def _steps_s(
    pairs: Sequence[tuple[ServoSample, ServoSample]], usual: int = 1
) -> tuple[float, float] | None:
    """Return mean and median time per usual step of ``seq``, s; None from too few samples."""
    ahead = [(a, b) for a, b in pairs if b.seq > a.seq and b.t_ns > a.t_ns]
    if len(ahead) < _FEWEST:
        return None
    ticks = sum(b.seq - a.seq for a, b in ahead)
    mean_ns = sum(b.t_ns - a.t_ns for a, b in ahead) / ticks
    middle_ns = float(np.median([(b.t_ns - a.t_ns) / (b.seq - a.seq) for a, b in ahead]))
    return mean_ns * usual / 1e9, middle_ns * usual / 1e9


def _undeclared(samples: Sequence[ServoSample], usable: Sequence[ServoSample]) -> Iterator[Fault]:
    """Yield rate and position step measured from the samples, for a robot.toml to be written."""
    steps_s = _steps_s([(a, b) for a, b in pairwise(samples) if a.run == b.run])
    if steps_s is None:
        return
    grids = _grids(usable)
    words = f"samples come every {steps_s[1] * 1e3:.1f} ms ({1 / steps_s[1]:.1f} Hz)"
    if grids and grids[-1] > MOST_QUANTUM_RAD:
        yield _coarse(grids[-1], "readings step by")
    elif grids:
        words += f", readings step by {grids[len(grids) // 2]:.3g} rad"
    yield Fault.from_table("undeclared", words)


def _grids(usable: Sequence[ServoSample]) -> list[float]:
    """Return the position steps of the joints that show one, rad, in ascending order."""
    measured = np.array([s.measured for s in usable], dtype=np.float64)
    found = [position_step(column[np.isfinite(column)]) for column in measured.T]
    return sorted(step for step in found if step is not None)


def _off(step_s: float, period_s: float) -> float:
    return abs(step_s / period_s - 1.0)


def _rate(step_s: float, period_s: float) -> Fault:
    for unit, factor in (("microseconds", 1e3), ("milliseconds", 1e6), ("seconds", 1e9)):
        if _off(step_s * factor, period_s) <= _RATE_TOLERANCE:
            return Fault.from_table("time_unit", step=step_s * 1e9, unit=f"to be in {unit}")
    found = f"found {step_s * 1e3:.1f} ms ({1 / step_s:.1f} Hz)"
    return Fault.from_table(
        "period", found, _off(step_s, period_s), ms=period_s * 1e3, hz=1 / period_s
    )


def _jitter(samples: Sequence[ServoSample], period_s: float) -> Iterator[Fault]:
    """Yield a fault where stamps of the longest run jitter, as the tick follows them, or burst."""
    run = Counter(s.run for s in samples).most_common(1)[0][0]
    rate, seen = RateWatch(round(period_s * 1e9)), list[float]()
    for row in (s for s in samples if s.run == run):
        rate.update(row.t_ns, row.seq, restart=not seen)
        seen.append(rate.jitter)
    jitter = float(np.median(seen[_FEWEST_STAMPS:] or [0.0]))
    if rate.burst:
        yield Fault.from_table("jitter-bursts", ticks=rate.burst)
    elif jitter > NOTED_JITTER:
        by = f"by {jitter * period_s * 1e3:.1f} ms (root mean square; {jitter:.0%} of a tick)"
        yield Fault.from_table("jitter", by, jitter)


def _coarse(quantum_rad: float, who: str = "robot.toml says quantum_rad =") -> Fault:
    return Fault.from_table(
        "quantum-coarse", key="coarse", who=who, quantum_rad=quantum_rad, most=MOST_QUANTUM_RAD
    )
