"""Simulated streams: made in parallel, kept as whole servo steps, read as arrays.

Readings and commands are whole multiples of the servo's step, so that 16-bit integers hold them
without loss: ten robot-hours take some tens of megabytes.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.robot import Robot, foot, shipped_robot
from adaptive_contact.score import LegStream, find_swings, lift_by_height, truth_changes
from adaptive_contact.score.swings import Swings
from adaptive_contact.wire import ContactTruth
from adaptive_contact_sim.arrays import LegArrays, Onset, record_arrays
from adaptive_contact_sim.experiments.plan import Piece
from adaptive_contact_sim.experiments.store import (
    Store,
    physics_fingerprint,
    plain,
    read_arrays,
    write_arrays,
)
from adaptive_contact_sim.servo import QUANTUM_RAD

__all__ = ["Stream", "load", "parallel", "record_all"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
T = TypeVar("T")
R = TypeVar("R")

TICK_NS = 20_000_000


@dataclass(frozen=True, eq=False)
class Stream:
    """One leg's stream with its truth, row k being control tick k.

    Attributes:
        piece: what was simulated.
        measured, desired: (n, 3) rad.
        swing: (n,) phase.
        angle: (n, 3) rad, true joint angles.
        onsets, releases_ns: truth.
    """

    piece: Piece
    measured: Array
    desired: Array
    swing: Mask
    angle: NDArray[np.float32]
    onsets: tuple[Onset, ...]
    releases_ns: tuple[int, ...]

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(n,) time stamps."""
        return np.arange(len(self.swing), dtype=np.int64) * TICK_NS

    @property
    def touched(self) -> Mask:
        """(n,) ticks that a contact may have marked, from the tick it began in until 60 ms after.

        For training: what is left is free.
        """
        marked = np.zeros(len(self.swing), dtype=bool)
        releases = np.array(sorted(self.releases_ns), dtype=np.int64)
        for onset in self.onsets:
            after = np.searchsorted(releases, onset.t_ns, side="right")
            end_ns = releases[after] if after < len(releases) else self.t_ns[-1]
            first = max(onset.t_ns // TICK_NS, 0)
            marked[first : end_ns // TICK_NS + 4] = True
        return marked

    def truth(self, robot: Robot) -> LegStream:
        """What the score needs."""
        leg = robot.leg(self.piece.leg_run.leg)
        changes = [
            ContactTruth(
                t_ns=o.t_ns,
                contact=True,
                force=o.force_n,
                speed_m_s=o.speed_m_s,
                surface="soft" if o.surface == "soft" else "hard",
                grazing=o.grazing,
            )
            for o in self.onsets
        ]
        changes += [ContactTruth(t_ns=t, contact=False, force=0.0) for t in self.releases_ns]
        swings: Swings = find_swings(self.t_ns, self.swing)
        assert leg.lengths_m is not None
        height = foot(self.desired, leg.lengths_m, leg.joint_axes)[:, 2]
        return LegStream(
            leg=self.piece.leg_run.name,
            t_ns=self.t_ns,
            swing=self.swing,
            truth=truth_changes(changes),
            lift=lift_by_height(swings, height),
        )


def piece_path(store: Store, piece: Piece) -> Path:
    """Where a piece's recording lives."""
    return store.path("data", [physics_fingerprint(), plain(piece)], ".npz")


def record_all(
    store: Store, pieces: Sequence[Piece], workers: int, progress: Callable[[float], None]
) -> None:
    """Simulate the pieces that are not there yet.

    Args:
        store: where they go.
        pieces: which.
        workers: processes.
        progress: told the simulated seconds as they are done.

    Raises:
        SimulationDiverged: the physics of one blew up.
    """
    missing = []
    for piece in pieces:
        path = piece_path(store, piece)
        if path.exists():
            progress(piece.seconds)
        else:
            missing.append((piece, path))
    for _, seconds in parallel(_record, missing, workers):
        progress(seconds)


def load(store: Store, piece: Piece) -> Stream:
    """Read a piece; simulated now if it is not there."""
    path = piece_path(store, piece)
    arrays = read_arrays(path)
    if arrays is None:
        _record((piece, path))
        arrays = read_arrays(path)
        assert arrays is not None
    steps = arrays["steps"].astype(np.float64) * QUANTUM_RAD
    columns = zip(
        arrays["onset_ns"].tolist(),
        arrays["onset_tick"].tolist(),
        arrays["onset_force_n"].tolist(),
        arrays["onset_speed_m_s"].tolist(),
        arrays["onset_part"].tolist(),
        arrays["onset_soft"].tolist(),
        arrays["onset_grazing"].tolist(),
        strict=True,
    )
    onsets = tuple(
        Onset(
            t_ns=t,
            tick=tick,
            force_n=force,
            speed_m_s=None if speed != speed else speed,
            part=part or None,
            surface="soft" if soft else "hard",
            grazing=grazing,
        )
        for t, tick, force, speed, part, soft, grazing in columns
    )
    return Stream(
        piece=piece,
        measured=steps[:, :3],
        desired=steps[:, 3:],
        swing=arrays["swing"],
        angle=arrays["angle"],
        onsets=onsets,
        releases_ns=tuple(arrays["releases_ns"].tolist()),
    )


def parallel(
    work: Callable[[T], R], items: Sequence[T], workers: int
) -> Iterator[tuple[T, R]]:
    """Do work in processes of one thread each, in order of completion.

    An interruption lets the items in hand finish, so that what they store is kept.

    Args:
        work: a module-level function.
        items: what to do it on.
        workers: processes; one does it in this process.

    Yields:
        Items with their results.
    """
    if workers <= 1 or len(items) <= 1:
        for item in items:
            yield item, work(item)
        return
    # Spawned, never forked; one BLAS thread each, told before numpy is loaded there.
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    pool = ProcessPoolExecutor(
        max_workers=min(workers, len(items)),
        mp_context=get_context("spawn"),
        initializer=_ignore_interrupts,
    )
    try:
        futures = {pool.submit(work, item): item for item in items}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _record(item: tuple[Piece, Path]) -> float:
    piece, path = item
    run = record_arrays(piece.settings, piece.seconds)
    write_arrays(path, pack(run.legs[piece.leg_run.leg]))
    return piece.seconds


def pack(leg: LegArrays) -> dict[str, NDArray[Any]]:
    """Arrays to store of one leg's stream."""
    steps = np.rint(np.concatenate([leg.measured, leg.desired], axis=1) / QUANTUM_RAD)
    onsets = leg.onsets
    speed = [np.nan if o.speed_m_s is None else o.speed_m_s for o in onsets]
    return {
        "steps": steps.astype(np.int16),
        "swing": leg.swing,
        "angle": leg.angle.astype(np.float32),
        "onset_ns": np.array([o.t_ns for o in onsets], dtype=np.int64),
        "onset_tick": np.array([o.tick for o in onsets], dtype=np.int64),
        "onset_force_n": np.array([o.force_n for o in onsets], dtype=np.float64),
        "onset_speed_m_s": np.array(speed, dtype=np.float64),
        "onset_part": np.array([o.part or "" for o in onsets], dtype="U8"),
        "onset_soft": np.array([o.surface == "soft" for o in onsets], dtype=bool),
        "onset_grazing": np.array([o.grazing for o in onsets], dtype=bool),
        "releases_ns": np.array(leg.releases_ns, dtype=np.int64),
    }


def leg_robot() -> Robot:
    """The robot whose legs are simulated."""
    return shipped_robot()
