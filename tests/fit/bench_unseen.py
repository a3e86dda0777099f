"""Fits of a real arm on motions and moments that they have not seen; a script, not a test.

    python tests/fit/bench_unseen.py FOLDER [--splits halves,moments,motions] [--out FILE]

FOLDER holds `.npz` recordings of github.com/isaac-sim2real/sage (`output/real/so101`), which touch
nothing.  Each split is fitted with `fit`'s own `learn`, all motions being free swings, and tried on
the rest twice:

- one-step RMS, beside that of the motion itself (naive) and of a ridge of 10⁻³ on scaled columns
  over each joint's own terms, the constant and gravity, fitted to the same rows;
- false alarms of a `ContactLearner` that learns on, as `serve` has it, at a target rate of 1 per
  robot-hour, with exact 95 % intervals (Garwood); beside it the largest threshold of the
  statistic (some 20 to 30 on a leg in free motion), and the share of ticks in which the leverage
  raises that tenfold and more: there the leg sees next to nothing.

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
from adaptive_contact.errors import RecordingError
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Library
from adaptive_contact.model.library import leg_library
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.model.window import stack
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot, parse_robot
from adaptive_contact_studies.paper.log_files import Recording, load_logs

Array = NDArray[np.float64]

QUANTUM_RAD = 0.001534  # 4096 steps a turn
RIDGE = 1e-3  # rows per row, of scaled columns
BLOCK_TICKS = 500
DEALS = 10
BLIND = 9.0  # leverage that raises a threshold tenfold
PERIOD_NS = 20_000_000


class Tried(NamedTuple):
    """Sums over the rows of one split."""

    rows: int
    squares: Array  # (3, J): fit, ridge, naive
    alarms: int
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
) -> tuple[int, int, float]:
    """Contacts reported of motions without any, ticks judged, and the largest threshold."""
    learner = ContactLearner(robot, "arm", baseline)
    count = seq = ticks = 0
    threshold = 0.0
    for run, motion in enumerate(motions):
        for measured, desired in zip(motion.measured, motion.desired, strict=True):
            seq += 1
            event = learner.update(
                ServoSample(
                    t_ns=seq * PERIOD_NS, seq=seq, run=run + 1, phase="swing",
                    measured=measured.tolist(), desired=desired.tolist(),
                )
            )  # fmt: skip
            count += event is not None and event.contact
            judged = learner.judged()
            if judged is not None:
                ticks += 1
                threshold = max(threshold, float(judged.thresholds.max()))
    return count, ticks, threshold


def tried(robot: Robot, fitted: Sequence[Recording], held: Sequence[Recording]) -> Tried:
    training = learn(robot, {"arm": [stretch(m) for m in fitted]}, origin="bench")
    library = leg_library(robot, robot.legs[0], "servo", None)
    ridge = own_ridge(library, *rows(library, fitted))
    theta, target = rows(library, held)
    known = training.baseline.legs["arm"]
    model = known.model.coefficients
    errors = [target - theta @ model, target - theta @ ridge, target]
    squares = np.array([np.square(e).sum(axis=0) for e in errors])
    blind = 0
    if known.domain is not None:
        blind = int(np.count_nonzero(known.domain.leverage(theta) >= BLIND))
    return Tried(len(target), squares, *alarms(robot, training.baseline, held), blind)


def blocks(motion: Recording) -> list[Recording]:
    n = len(motion.measured)
    edges = [*range(0, max(n - BLOCK_TICKS + 1, 1), BLOCK_TICKS), n]
    return [
        dataclasses.replace(motion, measured=motion.measured[a:b], desired=motion.desired[a:b])
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


def figures(results: Sequence[Tried]) -> dict[str, Any]:
    squares = sum(r.squares for r in results) / sum(r.rows for r in results)
    fit, ridge, naive = np.degrees(np.sqrt(squares)).mean(axis=1).tolist()
    count, ticks = sum(r.alarms for r in results), sum(r.ticks for r in results)
    hours = ticks / ROBOT_HOUR_TICKS
    low = chi2.ppf(0.025, 2 * count) / 2 if count else 0.0
    high = chi2.ppf(0.975, 2 * count + 2) / 2
    return {
        "fit_deg": fit, "ridge_deg": ridge, "naive_deg": naive, "of_ridge": fit / ridge,
        "alarms": count, "hours": hours,
        "per_hour": [count / hours, low / hours, high / hours] if hours else None,
        "threshold": max(r.threshold for r in results),
        "blind": sum(r.blind for r in results) / sum(r.rows for r in results),
    }  # fmt: skip


def line(name: str, found: dict[str, Any]) -> str:
    rate = found["per_hour"]
    said = "none judged" if rate is None else f"{rate[0]:.0f} ({rate[1]:.0f} to {rate[2]:.0f})"
    return (
        f"{name:28} {found['fit_deg']:.4f} {found['ridge_deg']:.4f} {found['of_ridge']:5.2f} "
        f"{found['naive_deg']:.3f} {found['alarms']:4d} in {found['hours']:.2f} h: {said}; "
        f"threshold {found['threshold']:.0f}, blind {100 * found['blind']:.2f} %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--splits", default="halves,moments,motions")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    chosen = parser.parse_args()
    try:
        motions = [r for r in load_logs(chosen.folder).recordings if r.kind == "arm"]
    except RecordingError as error:
        parser.error(str(error))
    if len(motions) < 2:
        parser.error(f"{chosen.folder}: {len(motions)} motions of an arm, expected at least 2")
    motions.sort(key=lambda motion: motion.name)
    robot = arm(motions[0].measured.shape[1])
    print("split                        fit °  ridge ° ratio naive ° alarms", flush=True)
    tree: dict[str, Any] = {}
    with threadpool_limits(1):
        for kind in chosen.splits.split(","):
            results = []
            for name, fitted, held in splits(kind, motions):
                began = time.monotonic()
                results.append(tried(robot, fitted, held))
                tree.setdefault(kind, {})[name] = figures(results[-1:])
                took = f"  [{time.monotonic() - began:.0f} s]"
                print(line(name, tree[kind][name]) + took, flush=True)
            tree[kind]["all"] = figures(results)
            print(line(f"{kind}: all", tree[kind]["all"]), flush=True)
    if chosen.out:
        chosen.out.write_text(json.dumps(tree, indent=1))


if __name__ == "__main__":
    main()
