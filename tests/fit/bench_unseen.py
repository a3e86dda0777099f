"""Fits of a real arm on motions and moments that they have not seen; a script, not a test.

    make unseen DATA=FOLDER UNSEEN_OPTIONS="[--splits halves,moments,motions] [--out FILE]"

FOLDER holds `.npz` recordings of github.com/isaac-sim2real/sage (`output/real/so101`), which touch
nothing.  Each split is fitted with `fit`'s own `learn`, all motions being free swings, and tried on
the rest twice:

- one-step RMS, beside that of the motion itself (naive) and of a ridge of 10⁻³ on scaled columns
  over each joint's own terms, the constant and gravity, fitted to the same rows; the ratio to that
  has a 95 % interval, by resampling what is held out; `known` is of the same fit to all motions;
- false alarms of a `ContactLearner` that learns on, as `serve` has it, at a target rate of 1 per
  robot-hour, with exact 95 % intervals (Garwood); beside it the largest threshold of the
  statistic (some 20 to 30 on a leg in free motion), and the share of ticks in which the leverage
  raises that tenfold and more: there the leg sees next to nothing;
- each alarm by itself: motion and second, score, the joint whose residual is the largest for its
  noise, that residual, the expected movement and the last step of its command in position steps;
  whether a reading of the last ticks was replaced; and the score where a fit to all motions, the
  one held out among them, alarms as well (within three ticks): there no fit is free of it.

Splits: `halves` fits to every second motion, by name, and tries the others, then the reverse;
`motions` leaves out one motion at a time; `moments` leaves out every fifth block of ten seconds,
dealt ten times.  Of moments, alarms are counted per split.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Library
from adaptive_contact.model.library import leg_library
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.model.window import stack
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot, parse_robot
from real_logs import Recording, load_logs

Array = NDArray[np.float64]

QUANTUM_RAD = 0.001534  # 4096 steps a turn
RIDGE = 1e-3  # rows per row, of scaled columns
BLOCK_TICKS = 500
DEALS = 10
RESAMPLES = 1000
BLIND = 9.0  # leverage that raises a threshold tenfold
PERIOD_NS = 20_000_000


class Alarm(NamedTuple):
    """A contact reported where none is recorded."""

    motion: str
    tick: int
    score: float
    joint: int  # from 1
    residual: float  # position steps, as the next two
    expected: float
    step: float
    replaced: bool

    def line(self, known: Sequence[Alarm]) -> str:
        alike = [a for a in known if a.motion == self.motion and abs(a.tick - self.tick) <= 3]
        said = f"{alike[0].score:.2f}" if alike else "none"
        return (
            f"    {self.motion:28} {self.tick * PERIOD_NS / 1e9:6.2f} s score {self.score:.2f}, "
            f"joint {self.joint} {self.residual:+.1f} where {self.expected:+.1f} was expected, "
            f"command {self.step:+.1f}{', reading replaced' * self.replaced}; known: {said}"
        )


class Tried(NamedTuple):
    """Sums over the rows of one split."""

    rows: Array  # (m,) of each motion held out
    squares: Array  # (m, 4, J): fit, ridge, naive, fit to all
    alarms: list[Alarm]
    known: list[Alarm]  # of the fit to all
    ticks: int
    threshold: float
    blind: int


def arm(joints: int) -> Robot:
    """An arm on a turntable: the first joint yaws, the others pitch."""
    names = ", ".join(f'"joint{i + 1}"' for i in range(joints))
    axes = ", ".join('"pitch"' if i else '"yaw"' for i in range(joints))
    return parse_robot(
        f'[robot]\nname = "arm"\nperiod_s = 0.02\nquantum_rad = {QUANTUM_RAD}\n'
        f'[[leg]]\nid = "arm"\njoints = [{names}]\naxes = [{axes}]\n',
        source="arm",
    )


def stretch(motion: Recording) -> Stretch:
    always = np.ones(len(motion.measured), dtype=bool)
    return Stretch(motion.measured, motion.desired, always, always, always)


def rows(library: Library, motions: Sequence[Recording]) -> tuple[Array, Array]:
    cuts = [stack(m.measured, m.desired, library.window) for m in motions]
    theta = [library.evaluate(c.measured, c.desired, c.preview) for c in cuts]
    return np.concatenate(theta), np.concatenate([c.increment for c in cuts])


def own_ridge(library: Library, theta: Array, target: Array) -> Array:
    """(p, J) coefficients of each joint's own terms, the constant and gravity."""
    joints = len(library.joints)
    of_joints = {g.first + j for g in library.groups for j in range(joints)}
    common = [i for i in range(library.size) if i not in of_joints]
    coefficients = np.zeros((library.size, joints))
    for joint in range(joints):
        columns = sorted([*common, *(g.first + joint for g in library.groups)])
        part = theta[:, columns]
        scale = np.sqrt(np.square(part).mean(axis=0))
        scale[scale < 1e-12] = 1.0
        part = part / scale
        gram = part.T @ part / len(part) + RIDGE * np.eye(len(columns))
        found = np.linalg.solve(gram, part.T @ target[:, joint] / len(part))
        coefficients[columns, joint] = found / scale
    return coefficients


def alarms(
    robot: Robot, baseline: Baseline, motions: Sequence[Recording]
) -> tuple[list[Alarm], int, float]:
    """Contacts reported of motions without any, ticks judged, and the largest threshold."""
    learner = ContactLearner(robot, "arm", baseline)
    noise = baseline.legs["arm"].noise.rms
    found: list[Alarm] = []
    seq = ticks = 0
    threshold = 0.0
    for run, motion in enumerate(motions):
        for tick, (measured, desired) in enumerate(
            zip(motion.measured, motion.desired, strict=True)
        ):
            seq += 1
            event = learner.update(
                ServoSample(
                    t_ns=seq * PERIOD_NS, seq=seq, run=run + 1, phase="swing",
                    measured=measured.tolist(), desired=desired.tolist(),
                )
            )  # fmt: skip
            if event is not None and event.contact:
                j = int(np.argmax(np.abs(event.residual) / noise))
                steps = (
                    event.residual[j], learner.place.increments[0, j],
                    motion.desired[tick - 1, j] - motion.desired[tick - 2, j],
                )  # fmt: skip
                of_joint = [float(step) / QUANTUM_RAD for step in steps]
                replaced = float(learner.place.record["inflation"]) > 1.0
                found.append(Alarm(motion.name, tick, event.score, j + 1, *of_joint, replaced))
            judged = learner.judged()
            if judged is not None:
                ticks += 1
                threshold = max(threshold, float(judged.thresholds.max()))
    return found, ticks, threshold


def tried(
    robot: Robot, fitted: Sequence[Recording], held: Sequence[Recording], known: Baseline
) -> Tried:
    training = learn(robot, {"arm": [stretch(m) for m in fitted]}, origin="bench")
    library = leg_library(robot, robot.legs[0], "servo", None)
    ridge = own_ridge(library, *rows(library, fitted))
    model, of_all = (b.legs["arm"].model.coefficients for b in (training.baseline, known))
    domain = training.baseline.legs["arm"].domain
    counts, squares, blind = [], [], 0
    for motion in held:
        theta, target = rows(library, [motion])
        errors = [target - theta @ c for c in (model, ridge, np.zeros_like(ridge), of_all)]
        squares.append([np.square(e).sum(axis=0) for e in errors])
        counts.append(len(target))
        if domain is not None:
            blind += int(np.count_nonzero(domain.leverage(theta) >= BLIND))
    found, ticks, threshold = alarms(robot, training.baseline, held)
    again = alarms(robot, known, held)[0]
    return Tried(np.array(counts), np.array(squares), found, again, ticks, threshold, blind)


def blocks(motion: Recording) -> list[Recording]:
    n = len(motion.measured)
    edges = [*range(0, max(n - BLOCK_TICKS + 1, 1), BLOCK_TICKS), n]
    return [
        dataclasses.replace(
            motion,
            name=f"{motion.name}+{a * PERIOD_NS / 1e9:.0f}s",
            measured=motion.measured[a:b],
            desired=motion.desired[a:b],
        )
        for a, b in pairwise(edges)
    ]


def splits(
    kind: str, motions: list[Recording]
) -> Iterator[tuple[str, list[Recording], list[Recording]]]:
    if kind == "halves":
        yield "even names", motions[::2], motions[1::2]
        yield "odd names", motions[1::2], motions[::2]
    elif kind == "motions":
        for i, motion in enumerate(motions):
            yield f"without {motion.name}", motions[:i] + motions[i + 1 :], [motion]
    else:
        parts = [block for motion in motions for block in blocks(motion)]
        for deal in range(DEALS):
            fold = np.random.default_rng(deal).permutation(len(parts)) % 5
            inside = [p for p, f in zip(parts, fold, strict=True) if f == 0]
            yield f"deal {deal}", [p for p, f in zip(parts, fold, strict=True) if f], inside


def errors_of(counts: Array, squares: Array) -> Array:
    """(4,) degrees, mean over joints of the root mean square."""
    whole = squares.sum(axis=0) / counts.sum()
    return np.asarray(np.degrees(np.sqrt(whole)).mean(axis=1))


def figures(results: Sequence[Tried]) -> dict[str, Any]:
    counts = np.concatenate([r.rows for r in results])
    squares = np.concatenate([r.squares for r in results])
    fit, ridge, naive, known = errors_of(counts, squares).tolist()
    rng = np.random.default_rng(0)
    drawn = (rng.integers(0, len(counts), len(counts)) for _ in range(RESAMPLES))
    again = [errors_of(counts[of], squares[of]) for of in drawn]
    ratios = [e[0] / e[1] for e in again]
    count, ticks = sum(len(r.alarms) for r in results), sum(r.ticks for r in results)
    hours = ticks / ROBOT_HOUR_TICKS
    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    high = chi2.ppf(0.975, 2 * count + 2) / 2
    return {
        "fit_deg": fit, "ridge_deg": ridge, "naive_deg": naive, "known_deg": known,
        "of_ridge": [fit / ridge, *np.quantile(ratios, [0.025, 0.975]).tolist()],
        "alarms": count, "hours": hours,
        "per_hour": [count / hours, low / hours, high / hours] if hours else None,
        "threshold": max(r.threshold for r in results),
        "blind": sum(r.blind for r in results) / int(counts.sum()),
    }  # fmt: skip


def line(name: str, found: dict[str, Any]) -> str:
    rate = found["per_hour"]
    said = "none judged" if rate is None else f"{rate[0]:.0f} ({rate[1]:.0f} to {rate[2]:.0f})"
    ratio, least, most = found["of_ridge"]
    return (
        f"{name:28} {found['fit_deg']:.4f} {found['ridge_deg']:.4f} {ratio:.2f} ({least:.2f} to "
        f"{most:.2f}) {found['naive_deg']:.3f} {found['known_deg']:.4f} {found['alarms']:4d} in "
        f"{found['hours']:.2f} h: {said}; threshold {found['threshold']:.0f}, "
        f"blind {100 * found['blind']:.2f} %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splits", default="halves,moments,motions")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    chosen = parser.parse_args()
    motions = [r for r in load_logs(chosen.folder) if not r.gain]
    if len(motions) < 2:
        parser.error(f"{chosen.folder}: {len(motions)} motions of an arm, expected at least 2")
    motions.sort(key=lambda motion: motion.name)
    robot = arm(motions[0].measured.shape[1])
    print("split                        fit °  ridge ° ratio naive ° known ° alarms", flush=True)
    tree: dict[str, Any] = {}
    with threadpool_limits(1):
        known = learn(robot, {"arm": [stretch(m) for m in motions]}, origin="bench").baseline
        for kind in chosen.splits.split(","):
            results = []
            for name, fitted, held in splits(kind, motions):
                began = time.monotonic()
                results.append(tried(robot, fitted, held, known))
                tree.setdefault(kind, {})[name] = figures(results[-1:])
                took = f"  [{time.monotonic() - began:.0f} s]"
                print(line(name, tree[kind][name]) + took, flush=True)
                for alarm in results[-1].alarms:
                    print(alarm.line(results[-1].known), flush=True)
            tree[kind]["all"] = figures(results)
            print(line(f"{kind}: all", tree[kind]["all"]), flush=True)
    if chosen.out:
        chosen.out.write_text(json.dumps(tree, indent=1))


if __name__ == "__main__":
    main()
