"""How fast learning and fitting are, measured in one process against references in the same run."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import numpy as np

from adaptive_contact.adapt import Baseline, ContactLearner
from adaptive_contact.adapt.advance import advance
from adaptive_contact.identify import Factor, FitSettings, fit_sparse, leg_library, stack
from adaptive_contact.robot import Robot
from adaptive_contact_sim.arrays import Run
from adaptive_contact_sim.evaluate import samples_of

__all__ = ["FitSpeed", "TickSpeed", "fit_speed", "tick_speed"]


@dataclass(frozen=True)
class TickSpeed:
    """Time of one control tick of all legs in the learners.

    Attributes:
        median_ms, p99_ms: of a tick.
        leg_ticks_per_s: of processor time, messages not counted.
    """

    legs: int
    median_ms: float
    p99_ms: float
    leg_ticks_per_s: float


def tick_speed(run: Run, robot: Robot, baseline: Baseline) -> TickSpeed:
    """Measure :func:`~adaptive_contact.adapt.learner.advance` over a run of all legs."""
    legs = list(run.legs)
    learners = [ContactLearner(robot, leg, baseline) for leg in legs]
    spent = []
    begun = time.process_time()
    for samples in zip(*(samples_of(run, leg) for leg in legs), strict=True):
        start = time.perf_counter()
        advance(list(zip(learners, samples, strict=True)))
        spent.append(time.perf_counter() - start)
    total = time.process_time() - begun
    median, p99 = np.percentile(spent, (50, 99)) * 1e3
    return TickSpeed(len(legs), float(median), float(p99), len(spent) * len(legs) / total)


@dataclass(frozen=True)
class FitSpeed:
    """A sparse fit on the compressed factor against PySINDy's own on the raw rows.

    Attributes:
        ratio: PySINDy's time over ours with the factor held.
        build_s: of building the factor, once.
        same_support: whether both kept the same terms.
        difference: largest difference of a coefficient, in scaled units.
    """

    rows: int
    terms: int
    pysindy_s: float
    compressed_s: float
    build_s: float
    ratio: float
    same_support: bool
    difference: float


def fit_speed(run: Run, leg: str, robot: Robot, *, threshold: float = 0.15) -> FitSpeed:
    """Fit the servo library to a leg's swing ticks both ways.

    Args:
        run: recorded; its swings of ``leg`` are the rows.
        leg: which.
        robot: its description.
        threshold: λ in units of the residual.
    """
    from pysindy.optimizers import STLSQ

    library = leg_library(robot, robot.leg(leg))
    arrays = run.legs[leg]
    cut = stack(arrays.measured, arrays.desired, library.window)
    swing = arrays.swing[cut.tick] & arrays.swing[cut.tick + 1]
    theta = library.evaluate(cut.measured[swing], cut.desired[swing], cut.preview[swing])
    target = cut.increment[swing]
    begin = time.perf_counter()
    factor = Factor(library.size, target.shape[1])
    factor.add(theta, target)
    build_s = time.perf_counter() - begin
    unit = tuple(fit_sparse(factor, FitSettings()).rms.tolist())
    settings = FitSettings(threshold=threshold, unit=unit)
    compressed_s = _median(lambda: fit_sparse(factor, settings), 15)
    scale = np.sqrt(np.square(theta).mean(axis=0))
    scaled, goal = theta / scale, target / np.array(unit)

    def pysindy() -> STLSQ:
        optimizer = STLSQ(threshold=threshold, alpha=settings.ridge * len(theta), unbias=True)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore")  # what it warns of is in the coefficients
            return optimizer.fit(scaled, goal)

    pysindy_s = _median(pysindy, 3)
    expected = np.asarray(pysindy().coef_).T
    ours = fit_sparse(factor, settings).coefficients * scale[:, None] / np.array(unit)
    return FitSpeed(
        rows=len(theta),
        terms=library.size,
        pysindy_s=pysindy_s,
        compressed_s=compressed_s,
        build_s=build_s,
        ratio=pysindy_s / compressed_s,
        same_support=bool(((ours != 0) == (expected != 0)).all()),
        difference=float(np.abs(ours - expected).max()),
    )


def _median(work: object, times: int) -> float:
    assert callable(work)
    spent = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return float(np.median(spent))
