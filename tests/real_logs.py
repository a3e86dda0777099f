"""Recordings of real servos, of an arm and of a pendulum; neither touches anything.

``.npz``: keys ``MOTION/t`` (s), ``MOTION/goal`` and ``MOTION/pos`` (n, J) rad, any number of
motions (github.com/isaac-sim2real/sage).  ``.json``: one run of one servo, ``entries[]`` with
``timestamp`` s, ``goal_position`` and ``position`` rad, ``torque_enable``; beside them ``kp`` and
``trajectory`` (github.com/Rhoban/bam).
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
PERIOD_S = 0.02
MIN_ROWS = 50  # shorter than this says nothing
GAP_S = 0.1  # a hole in the time stamps ends a stretch
MAX_STEP_RAD = 0.6  # in a tick; a bus that returns -π has had no answer


@dataclass(frozen=True, eq=False)
class Recording:
    """One motion without a gap, 50 Hz."""

    name: str
    measured: Array  # (n, J) rad
    desired: Array  # (n, J) rad, the command written at the tick
    gain: float = 0.0  # proportional, of a pendulum's servo
    trajectory: str = ""  # what a pendulum was driven along


def load_logs(folder: Path) -> list[Recording]:
    """All recordings below a folder, in the order of their files."""
    found: list[Recording] = []
    for file in sorted(folder.rglob("*")):
        if file.suffix == ".npz":
            with np.load(file) as data:
                for name in sorted({key.rsplit("/", 1)[0] for key in data.files}):
                    t, goal, pos = (data[f"{name}/{part}"] for part in ("t", "goal", "pos"))
                    found += stretches(t, pos, goal, name=name)
        elif file.suffix == ".json":
            table = json.loads(file.read_text(encoding="utf-8"))
            rows = [e for e in table["entries"] if e.get("torque_enable", True)]
            t = np.array([e["timestamp"] for e in rows])
            goal, pos = (np.array([[e[k]] for e in rows]) for k in ("goal_position", "position"))
            driven = str(table["trajectory"])
            told = {"name": driven, "trajectory": driven, "gain": float(table["kp"])}
            found += stretches(t, pos, goal, **told)
    return found


def stretches(t: Array, pos: Array, goal: Array, **told: Any) -> Iterator[Recording]:
    """Gapless parts of one motion, at 50 Hz, of 50 rows and more."""
    forward = np.concatenate(([True], np.diff(t) > 0))
    t, pos, goal = t[forward], pos[forward], goal[forward]
    begins = np.concatenate(([0], np.flatnonzero(np.diff(t) > GAP_S) + 1, [len(t)]))
    for first, last in itertools.pairwise(begins.tolist()):
        if last - first < 2:
            continue
        repaired = repair(np.unwrap(pos[first:last], axis=0))
        goals = np.unwrap(goal[first:last], axis=0)
        measured, desired = resample(t[first:last], repaired, goals)
        if len(measured) >= MIN_ROWS:
            yield Recording(measured=measured, desired=desired, **told)


def repair(pos: Array) -> Array:
    """Readings that leap away and come back within a reading, replaced by a straight line."""
    out = pos.copy()
    for column in out.T:
        leap = np.abs(np.diff(column)) > MAX_STEP_RAD
        for k in np.flatnonzero(leap[:-1] & leap[1:]) + 1:
            if abs(column[k + 1] - column[k - 1]) < MAX_STEP_RAD:
                column[k] = 0.5 * (column[k - 1] + column[k + 1])
    return out


def resample(t: Array, pos: Array, goal: Array) -> tuple[Array, Array]:
    """To 50 Hz: readings by interpolation, commands by holding the last one written."""
    if abs(np.median(np.diff(t)) / PERIOD_S - 1.0) < 0.05:
        return pos, goal
    grid = np.arange(t[0], t[-1], PERIOD_S)
    measured = np.stack([np.interp(grid, t, column) for column in pos.T], axis=1)
    return measured, goal[np.searchsorted(t, grid, side="right") - 1]
