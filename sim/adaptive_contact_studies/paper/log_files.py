"""Recordings of real servos in the two formats that are read.

``.npz``: keys ``MOTION/t`` (s), ``MOTION/goal`` and ``MOTION/pos`` (n, J) rad, any number of
motions (github.com/isaac-sim2real/sage).  ``.json``: one run of one servo, ``entries[]`` with
``timestamp`` s, ``goal_position`` and ``position`` rad, ``torque_enable``; beside them ``kp`` and
``trajectory`` (github.com/Rhoban/bam).

Angles are unwrapped, and rows without torque left out.  A file or motion that cannot be used is
reported with its reason instead of being dropped in silence.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import RecordingError
from adaptive_contact.service.recording.reader import MAX_CHUNK_BYTES, MAX_RATIO

PERIOD_S: Final = 0.02
# Shorter than this says nothing.
_MIN_ROWS: Final = 50
# A hole in the time stamps ends a stretch.
_GAP_S: Final = 0.1
# More joints make the paper's library larger than memory.
_MAX_JOINTS: Final = 12
# How much of an error's own words is shown, and of how many files where none is of use.
_SAID: Final = 160
_FILES: Final = 3
# What reading a file that is something else, or is damaged, may end with.
_UNREADABLE: Final = (
    ValueError, LookupError, TypeError, AttributeError, ArithmeticError, OSError, EOFError,
    NotImplementedError, RecursionError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
# Buses that return -π for "no answer", and readings no servo could have made in a tick.
_MAX_STEP_RAD: Final = 0.6


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """One motion without a gap, 50 Hz."""

    name: str  # of the motion or the run
    kind: Literal["arm", "pendulum"]  # ``arm`` or ``pendulum``
    # measured, desired: (n, J) rad; desired is the command written at the tick
    measured: Array
    desired: Array
    gain: float | None = None  # proportional gain, where it is given
    repaired: int = 0  # readings that were no angle of the servo, replaced by a straight line
    trajectory: str = ""  # what was driven, where it is given; several runs may share it


@dataclasses.dataclass(frozen=True)
class LogSet:
    """What a path held."""

    recordings: list[Recording]  # that can be used
    skipped: list[tuple[str, str]]  # file or motion, and why not


def load_logs(path: Path) -> LogSet:
    """Read a file, or all files of both formats below a folder.

    Raises:
        RecordingError: there is no such path, no file of either format, or none of use.
    """
    if path.is_dir():
        files = sorted(p for p in path.rglob("*") if p.suffix in (".npz", ".json") and p.is_file())
    elif path.exists():
        files = [path]
    else:
        raise RecordingError(f"{path}: no such file or folder; give recordings of real servos")
    if not files:
        raise RecordingError(f"{path}: holds no .npz or .json file; see docs/paper.md for formats")
    found = LogSet([], [])
    for file in files:
        name = str(file.relative_to(path)) if path.is_dir() else file.name
        try:
            parts = list(_arm(file) if file.suffix == ".npz" else _pendulum(file))
        except _UNREADABLE as error:
            said = " ".join(f"{type(error).__name__}: {error}".split())
            found.skipped.append((name, f"not a recording in this format ({said[:_SAID]})"))
            continue
        for part in parts:
            if isinstance(part, str):
                found.skipped.append((name, part))
            else:
                found.recordings.append(part)
    if not found.recordings:
        reasons = "; ".join(
            f"{name}: {reason}" if path.is_dir() else reason
            for name, reason in found.skipped[:_FILES]
        )
        more = f"; and {len(found.skipped) - _FILES} more" if len(found.skipped) > _FILES else ""
        raise RecordingError(
            f"{path}: no recording that can be used ({reasons}{more}); docs/paper.md describes "
            "both formats"
        )
    return found


def _arm(file: Path) -> Iterator[Recording | str]:
    with np.load(file, allow_pickle=False) as data:
        most = max(MAX_CHUNK_BYTES, MAX_RATIO * file.stat().st_size)
        if sum(entry.file_size for entry in data.zip.infolist()) > most:
            raise ValueError(f"unpacks to more than {most >> 20} MB")
        motions = sorted({key.rsplit("/", 1)[0] for key in data.files if "/" in key})
        if not motions:
            raise ValueError("no MOTION/t, MOTION/goal, MOTION/pos keys")
        for motion in motions:
            keys = [f"{motion}/{part}" for part in ("t", "goal", "pos")]
            missing = [key for key in keys if key not in data.files]
            if missing:
                yield f"motion '{motion}' lacks {', '.join(missing)}"
                continue
            t, goal, pos = (np.asarray(data[key], dtype=np.float64) for key in keys)
            if t.ndim != 1 or goal.ndim != 2 or goal.shape != pos.shape or len(t) != len(goal):
                yield (
                    f"motion '{motion}': t, goal and pos have shapes {t.shape}, {goal.shape} and "
                    f"{pos.shape}; expected (n,), (n, J) and (n, J)"
                )
                continue
            if not 1 <= goal.shape[1] <= _MAX_JOINTS:
                yield f"motion '{motion}': {goal.shape[1]} joints; expected 1 to {_MAX_JOINTS}"
                continue
            yield from _stretches(motion, motion, "arm", t, pos, goal, None)


def _pendulum(file: Path) -> Iterator[Recording | str]:
    table: Any = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(table, dict) or not isinstance(table.get("entries"), list):
        raise ValueError("no list 'entries'")
    entries = [e for e in table["entries"] if e.get("torque_enable", True)]
    left_out = len(table["entries"]) - len(entries)
    t = np.array([e["timestamp"] for e in entries], dtype=np.float64)
    pos = np.array([[e["position"]] for e in entries], dtype=np.float64)
    goal = np.array([[e["goal_position"]] for e in entries], dtype=np.float64)
    gain = table.get("kp")
    if gain is None:
        raise ValueError("no 'kp'")
    trajectory = str(table.get("trajectory", file.stem))
    name = f"{trajectory}, kp {gain}"
    if left_out:
        yield f"{left_out} of {len(table['entries'])} rows without torque left out"
    yield from _stretches(name, trajectory, "pendulum", t, pos, goal, float(gain))


def _stretches(
    name: str,
    trajectory: str,
    kind: Literal["arm", "pendulum"],
    t: Array,
    pos: Array,
    goal: Array,
    gain: float | None,
) -> Iterator[Recording | str]:
    """Sound, gapless, 50 Hz parts of one motion."""
    if len(t) < 2:
        yield f"'{name}': {len(t)} rows"
        return
    sound = np.isfinite(t) & np.isfinite(pos).all(axis=1) & np.isfinite(goal).all(axis=1)
    if not sound.all():
        yield f"'{name}': {np.count_nonzero(~sound)} rows with values that are not finite left out"
        t, pos, goal = t[sound], pos[sound], goal[sound]
    forward = np.concatenate(([True], np.diff(t) > 0))
    if not forward.all():
        yield f"'{name}': {np.count_nonzero(~forward)} rows whose time does not advance left out"
        t, pos, goal = t[forward], pos[forward], goal[forward]
    if len(t) < _MIN_ROWS:
        yield f"'{name}': {len(t)} sound rows; expected at least {_MIN_ROWS}"
        return
    begins = np.concatenate(([0], np.flatnonzero(np.diff(t) > _GAP_S) + 1, [len(t)]))
    short: list[int] = []
    for first, last in itertools.pairwise(begins):
        if last - first < 2:
            short.append(int(last - first))
            continue
        part = slice(int(first), int(last))
        pos_part, repaired = _repair(np.unwrap(pos[part], axis=0))
        measured, desired = _resample(t[part], pos_part, np.unwrap(goal[part], axis=0))
        if len(measured) < _MIN_ROWS:
            short.append(len(measured))
            continue
        yield Recording(name, kind, measured, desired, gain, repaired, trajectory)
    if short:
        yield (
            f"'{name}': {len(short)} of {len(begins) - 1} stretches without a gap of {_GAP_S} s "
            f"are too short (the longest has {max(short)} ticks; expected {_MIN_ROWS}, time in s)"
        )


def _repair(pos: Array) -> tuple[Array, int]:
    """Readings that leap away and come back within a reading, replaced by a straight line."""
    out, count = pos.copy(), 0
    for column in out.T:
        leap = np.abs(np.diff(column)) > _MAX_STEP_RAD
        for k in np.flatnonzero(leap[:-1] & leap[1:]) + 1:
            if abs(column[k + 1] - column[k - 1]) < _MAX_STEP_RAD:
                column[k] = 0.5 * (column[k - 1] + column[k + 1])
                count += 1
    return out, count


def _resample(t: Array, pos: Array, goal: Array) -> tuple[Array, Array]:
    """To 50 Hz: readings by interpolation, commands by holding the last one written."""
    # A recorded rate this far off 50 Hz is resampled.
    if abs(np.median(np.diff(t)) / PERIOD_S - 1.0) < 0.05:
        return pos, goal
    grid = np.arange(t[0], t[-1], PERIOD_S)
    measured = np.stack([np.interp(grid, t, column) for column in pos.T], axis=1)
    held = np.searchsorted(t, grid, side="right") - 1
    return measured, goal[held]
