"""The compressed fit against PySINDy's own on the raw rows: equality and speed."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.fit import FitSettings, fit_sparse
from adaptive_contact.model import Factor, Library, LibraryName, Window, leg_library
from adaptive_contact.robot import Robot
from adaptive_contact_studies.cache import Store
from adaptive_contact_studies.paper.data import Stream, join, load, record_all
from adaptive_contact_studies.paper.identification import PAPER_WINDOW
from adaptive_contact_studies.paper.plan import FULL
from adaptive_contact_studies.paper.rows import free_rows, residual_unit

__all__ = ["Comparison", "compare", "compare_all", "compare_full"]

Array = NDArray[np.float64]
_COMPARED: Final[tuple[tuple[LibraryName, Window, float], ...]] = (
    ("servo", Window(), 0.05),
    ("servo", Window(), 0.3),
    ("paper", PAPER_WINDOW, 0.1),
    ("paper", PAPER_WINDOW, 10.0),
)
R = TypeVar("R")


@dataclasses.dataclass(frozen=True)
class Comparison:
    """One library, one λ.

    Attributes:
        library, terms, rows, threshold: what was fitted.
        kept: (J,) terms left to each joint.
        raw_s: PySINDy's STLSQ on the raw rows, Θ given.
        compressed_s: the same fit with the factor held.
        factor_s: building the factor from Θ.
        library_s: evaluating Θ, which both need.
        speed_up: ``raw_s`` over ``compressed_s``.
        same_support: whether both keep the same terms.
        difference: largest difference of a coefficient, raw units.
    """

    library: str
    terms: int
    rows: int
    threshold: float
    kept: list[int]
    raw_s: float
    compressed_s: float
    factor_s: float
    library_s: float
    speed_up: float
    same_support: bool
    difference: float


def compare(stream: Stream, library: Library, threshold: float, *, repeats: int = 3) -> Comparison:
    """Time both fits of the free rows of a stream; the better of ``repeats``, CPU time.

    Args:
        stream: the paper's training segments.
        library: the terms.
        threshold: λ, in units of the residual.
        repeats: of each.
    """
    from pysindy.optimizers import STLSQ

    windows = free_rows(stream, library).windows
    theta, library_s = _timed(
        lambda: library.evaluate(windows.measured, windows.desired, windows.preview), repeats
    )
    target = windows.increment

    def build() -> Factor:
        factor = Factor(library.size, target.shape[1])
        factor.add(theta, target)
        return factor

    factor, factor_s = _timed(build, repeats)
    unit: Array = np.array(residual_unit(factor))
    settings = FitSettings(threshold=threshold, unit=tuple(unit.tolist()))
    fit, compressed_s = _timed(lambda: fit_sparse(factor, settings), repeats)
    scale = factor.scale()
    scaled, wanted = theta / scale, target / unit

    def raw() -> Array:
        # The same problem in PySINDy's words: its ridge term is per problem, ours per row.
        optimizer = STLSQ(threshold=threshold, alpha=settings.ridge * len(theta))
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparsity parameter is too big")
            warnings.filterwarnings("ignore", message=".*did not converge")
            optimizer.fit(scaled, wanted)
        scaled_back: Array = np.asarray(optimizer.coef_, dtype=np.float64).T / scale[:, None]
        return scaled_back * unit

    coefficients, raw_s = _timed(raw, repeats)
    return Comparison(
        library=library.name,
        terms=library.size,
        rows=len(theta),
        threshold=threshold,
        kept=[int(n) for n in fit.support.sum(axis=0)],
        raw_s=raw_s,
        compressed_s=compressed_s,
        factor_s=factor_s,
        library_s=library_s,
        speed_up=raw_s / compressed_s,
        same_support=bool(((coefficients != 0) == fit.support).all()),
        difference=float(np.abs(coefficients - fit.coefficients).max()),
    )


def compare_all(
    robot: Robot, stream: Stream, progress: Callable[[float], None] = lambda _: None
) -> list[Comparison]:
    """Both libraries, at a λ that keeps nearly every term and at one that leaves the sparse model.

    Args:
        robot: whose leg it is.
        stream: the paper's training segments.
        progress: told the share of the whole that each comparison adds.
    """
    leg = robot.leg(stream.leg)
    found = []
    for name, window, threshold in _COMPARED:
        found.append(compare(stream, leg_library(robot, leg, name, window), threshold))
        progress(1.0 / len(_COMPARED))
    return found


def compare_full(
    root: Path, robot: Robot, workers: int, progress: Callable[[float], None] = lambda _: None
) -> list[Comparison]:
    """The same on the full plan's 5,000 training segments, simulated unless they are there.

    Args:
        root: folder of what later calls reuse.
        robot: whose leg it is.
        workers: processes that simulate.
        progress: told the share of the segments that each process adds.
    """
    store = Store(root)
    pieces = FULL.paper_pieces("train")
    seconds = sum(piece.seconds for piece in pieces)
    record_all(store, pieces, workers, lambda done: progress(done / seconds))
    return compare_all(robot, join([load(store, piece) for piece in pieces]))


def _timed(work: Callable[[], R], repeats: int) -> tuple[R, float]:
    best = float("inf")
    for _ in range(repeats):
        start = time.process_time()
        result = work()
        best = min(best, time.process_time() - start)
    return result, best
