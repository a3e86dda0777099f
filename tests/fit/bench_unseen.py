"""Fits of a real arm on motions and moments that they have not seen; a script, not a test.

    make unseen DATA=FOLDER UNSEEN_OPTIONS="[--splits halves,moments,motions] [--out FILE]"

FOLDER holds `.npz` recordings of github.com/isaac-sim2real/sage (`output/real/so101`), which touch
nothing.  Each split is fitted with `fit`'s own `learn`, all motions being free swings, and tried on
the rest twice:

- one-step RMS, beside that of the motion itself (naive) and of a ridge of 10⁻³ on scaled columns
  over each joint's own terms, the constant and gravity, fitted to the same rows; the ratio to that
  has a 95 % interval, by resampling what is held out;
- false alarms of a `ContactLearner` that learns on, as `serve` has it, at a target rate of 1 per
  robot-hour, with exact 95 % intervals (Garwood).

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
from threadpoolctl import threadpool_limits

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.fit.train import Stretch, learn
from adaptive_contact.model import Baseline, Library, leg_library, stack
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot, parse_robot
from adaptive_contact.score.summary import AlarmFigures
from real_logs import Recording, load_logs

Array = NDArray[np.float64]

QUANTUM_RAD = 0.001534  # 4096 steps a turn
RIDGE = 1e-3  # rows per row, of scaled columns
BLOCK_TICKS = 500
DEALS = 10
RESAMPLES = 1000
PERIOD_NS = 20_000_000


class Tried(NamedTuple):
    """Sums over the rows of one split."""

    rows: Array  # (m,) of each motion held out
    squares: Array  # (m, 3, J): fit, ridge, naive
    alarms: int
    ticks: int


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


def alarms(robot: Robot, baseline: Baseline, motions: Sequence[Recording]) -> tuple[int, int]:
    """Contacts reported of motions without any, and ticks judged."""
    learner = ContactLearner(robot, "arm", baseline)
    found = seq = ticks = 0
    for run, motion in enumerate(motions, start=1):
        for measured, desired in zip(motion.measured, motion.desired, strict=True):
            seq += 1
            event = learner.update(
                ServoSample(
                    t_ns=seq * PERIOD_NS, seq=seq, run=run, phase="swing",
                    measured=measured.tolist(), desired=desired.tolist(),
                )
            )  # fmt: skip
            found += event is not None and event.contact
            ticks += learner.judged() is not None
    return found, ticks


def tried(robot: Robot, fitted: Sequence[Recording], held: Sequence[Recording]) -> Tried:
    training = learn(robot, {"arm": [stretch(m) for m in fitted]}, origin="bench")
    library = leg_library(robot, robot.legs[0], "servo", None)
    ridge = own_ridge(library, *rows(library, fitted))
    model = training.baseline.legs["arm"].model.coefficients
    counts, squares = [], []
    for motion in held:
        theta, target = rows(library, [motion])
        errors = [target - theta @ c for c in (model, ridge, np.zeros_like(ridge))]
        squares.append([np.square(e).sum(axis=0) for e in errors])
        counts.append(len(target))
    return Tried(np.array(counts), np.array(squares), *alarms(robot, training.baseline, held))


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
    """(3,) degrees, mean over joints of the root mean square."""
    whole = squares.sum(axis=0) / counts.sum()
    return np.asarray(np.degrees(np.sqrt(whole)).mean(axis=1))


def figures(results: Sequence[Tried]) -> dict[str, Any]:
    counts = np.concatenate([r.rows for r in results])
    squares = np.concatenate([r.squares for r in results])
    fit, ridge, naive = errors_of(counts, squares).tolist()
    rng = np.random.default_rng(0)
    drawn = (rng.integers(0, len(counts), len(counts)) for _ in range(RESAMPLES))
    again = [errors_of(counts[of], squares[of]) for of in drawn]
    ratios = [e[0] / e[1] for e in again]
    rate = AlarmFigures.from_counts(sum(r.alarms for r in results), sum(r.ticks for r in results))
    return {
        "fit_deg": fit, "ridge_deg": ridge, "naive_deg": naive,
        "of_ridge": [fit / ridge, *np.quantile(ratios, [0.025, 0.975]).tolist()],
        "alarms": rate.false_alarms, "hours": rate.judged_ticks / ROBOT_HOUR_TICKS,
        "per_hour": [rate.per_hour, *rate.interval] if rate.judged_ticks else None,
    }  # fmt: skip


def line(name: str, found: dict[str, Any]) -> str:
    rate = found["per_hour"]
    said = "none judged" if rate is None else f"{rate[0]:.0f} ({rate[1]:.0f} to {rate[2]:.0f})"
    ratio, least, most = found["of_ridge"]
    return (
        f"{name:28} {found['fit_deg']:.4f} {found['ridge_deg']:.4f} {ratio:.2f} ({least:.2f} to "
        f"{most:.2f}) {found['naive_deg']:.3f} {found['alarms']:4d} in "
        f"{found['hours']:.2f} h: {said}"
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
