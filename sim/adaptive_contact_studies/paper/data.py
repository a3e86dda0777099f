"""Simulated streams: made in parallel, kept as whole servo steps, read as arrays.

Readings and commands are whole multiples of the servo's step, so that 16-bit integers hold them
without loss: ten robot-hours take some tens of megabytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.fit.train import Stretch
from adaptive_contact_sim.arrays import LegArrays, Onset, Run
from adaptive_contact_sim.servo import QUANTUM_RAD
from adaptive_contact_studies.cache import Store, plain, read_arrays, write_arrays
from adaptive_contact_studies.paper.plan import GantrySettings, Piece
from adaptive_contact_studies.paper.recording import (
    physics_fingerprint,
    record_gantry,
    record_leg,
    require_unchanged_source,
)
from adaptive_contact_studies.training import stretch_of
from adaptive_contact_studies.workers import alone, completed

T = TypeVar("T")
R = TypeVar("R")
_Job = list[tuple[Piece, Path]]

TICK_NS = 20_000_000
# At the start of every stream that is joined to another, ticks that are no swing's: more than any
# window looks back.
SEAM_TICKS = 10


@dataclass(frozen=True, eq=False)
class Stream:
    """One leg's stream with its truth, row k being control tick k."""

    piece: Piece  # what was simulated
    arrays: LegArrays  # the leg's samples and truth

    @property
    def leg(self) -> str:
        """Id of the leg."""
        return self.piece.leg_run.leg

    @property
    def measured(self) -> Array:
        """(n, 3) rad."""
        return self.arrays.measured

    @property
    def desired(self) -> Array:
        """(n, 3) rad."""
        return self.arrays.desired

    @property
    def swing(self) -> Mask:
        """(n,) phase."""
        return self.arrays.swing

    @cached_property
    def run(self) -> Run:
        """As a run of one leg; the body's motion is not kept."""
        n = len(self.swing)
        return Run(
            t_ns=np.arange(n, dtype=np.int64) * TICK_NS,
            legs={self.leg: self.arrays},
            position_m=np.zeros((n, 3)),
            rotation=np.broadcast_to(np.eye(3), (n, 3, 3)),
        )

    @cached_property
    def stretch(self) -> Stretch:
        """To learn from; ticks near a touch are marked as not free."""
        return stretch_of(self.run, self.leg)


def piece_path(store: Store, piece: Piece) -> Path:
    """Where a piece's recording lives."""
    return store.path("data", [physics_fingerprint(), plain(piece)], ".npz")


def record_all(
    store: Store, pieces: Sequence[Piece], workers: int, progress: Callable[[float], None]
) -> None:
    """Simulate the pieces that are not there yet.

    Raises:
        SimulationDivergedError: the physics of one blew up.
    """
    # Legs of one hung-up robot come from one simulation.
    jobs: dict[str, _Job] = {}
    for piece in pieces:
        path = piece_path(store, piece)
        if path.exists():
            progress(piece.seconds)
            continue
        shared = isinstance(piece.settings, GantrySettings)
        key = repr((piece.settings, piece.seconds)) if shared else repr(piece)
        jobs.setdefault(key, []).append((piece, path))
    for _, seconds in parallel(record_piece, list(jobs.values()), workers):
        progress(seconds)


def load(store: Store, piece: Piece) -> Stream:
    """Read a piece; simulated now if it is not there."""
    path = piece_path(store, piece)
    arrays = read_arrays(path)
    if arrays is None:
        record_piece([(piece, path)])
        arrays = read_arrays(path)
        assert arrays is not None
    steps = arrays["steps"].astype(np.float64) * QUANTUM_RAD
    names = ("ns", "tick", "force_n", "speed_m_s", "part", "soft", "grazing")
    columns = (arrays[f"onset_{name}"].tolist() for name in names)
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
        for t, tick, force, speed, part, soft, grazing in zip(*columns, strict=True)
    )
    n = len(steps)
    leg = LegArrays(
        measured=steps[:, :3],
        desired=steps[:, 3:],
        valid=np.ones((n, 3), dtype=bool),
        swing=arrays["swing"],
        # Force and contact by tick are not kept: onsets and releases say all that is judged.
        contact=np.zeros(n, dtype=bool),
        force_n=np.zeros(n),
        angle=arrays["angle"].astype(np.float64),
        onsets=onsets,
        releases_ns=tuple(arrays["releases_ns"].tolist()),
    )
    return Stream(piece, leg)


def join(streams: Sequence[Stream]) -> Stream:
    """One stream of several of the same leg, one after the other.

    Every part begins with the leg standing, so that no window of swing ticks reaches back over a
    seam.
    """
    first = streams[0]
    starts = np.cumsum([0, *(len(s.swing) for s in streams[:-1])]).tolist()
    assert all(not s.swing[:SEAM_TICKS].any() for s in streams)
    parts = [s.arrays for s in streams]
    rows = ("measured", "desired", "valid", "swing", "contact", "force_n", "angle")
    arrays = LegArrays(
        **{name: np.concatenate([getattr(a, name) for a in parts]) for name in rows},
        onsets=tuple(
            replace(o, t_ns=o.t_ns + start * TICK_NS, tick=o.tick + start)
            for start, a in zip(starts, parts, strict=True)
            for o in a.onsets
        ),
        releases_ns=tuple(
            t + start * TICK_NS
            for start, a in zip(starts, parts, strict=True)
            for t in a.releases_ns
        ),
    )
    piece = replace(first.piece, seconds=sum(s.piece.seconds for s in streams))
    return Stream(piece, arrays)


def parallel(work: Callable[[T], R], items: Sequence[T], workers: int) -> Iterator[tuple[T, R]]:
    """Do work in processes of one thread each, in order of completion.

    An interruption lets the items in hand finish, so that what they store is kept.

    Args:
        work: a module-level function.
        items: what to do it on.
        workers: processes; one does it in this process.

    Yields:
        Items with their results.

    Raises:
        ConfigurationError: the source was changed since this process began.
    """
    if not alone(workers, len(items)):
        require_unchanged_source()
    yield from completed(work, items, workers, finish=True)


def record_piece(job: _Job) -> float:
    """Simulate what pieces have in common, and write each; simulated time, s."""
    piece, _ = job[0]
    if isinstance(piece.settings, GantrySettings):
        legs = record_gantry(piece.settings, piece.seconds)
    else:
        name = piece.leg_run.leg
        legs = {name: record_leg(piece.settings, name, piece.seconds)}
    for part, path in job:
        write_arrays(path, pack(legs[part.leg_run.leg]))
    return sum(part.seconds for part, _ in job)


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
