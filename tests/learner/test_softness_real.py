"""A real servo whose gain changes: what becomes of its model, and how soon that is followed.

One number says what half the gain does (decision 21); the recursion follows any gain within two
seconds (decision 46).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.core.learn.active_model import ActiveModel
from adaptive_contact.fit import FitSettings, fit_sparse
from adaptive_contact.model import Factor, LegModel, Library, stack, with_changes
from adaptive_contact.model.leg_prior import leg_prior
from real_logs import DATA, Recording, load_logs

REAL = DATA / "xl330"


def rows(library: Library, runs: list[Recording]) -> tuple[np.ndarray, np.ndarray]:
    cut = [stack(run.measured, run.desired, library.window) for run in runs]
    theta = [library.evaluate(c.measured, c.desired, c.preview) for c in cut]
    return np.concatenate(theta), np.concatenate([c.increment for c in cut])


def fitted(library: Library, runs: list[Recording]) -> np.ndarray:
    factor = Factor(library.size, 1)
    factor.add(*rows(library, runs))
    return fit_sparse(factor, FitSettings()).coefficients


FOLLOWED_TICKS = 100  # two seconds
QUANTUM_RAD = 0.001534  # 4096 steps a turn
SLOPE_RAD = {100.0: 2.56, 200.0: 1.28, 400.0: 0.64, 800.0: 0.32}
PAIRS = [(before, after) for before in SLOPE_RAD for after in SLOPE_RAD if before != after]


@pytest.mark.skipif(
    not REAL.is_dir(),
    reason="no ../shared/data/xl330: recordings of github.com/Rhoban/bam, not part of the project",
)
@pytest.mark.parametrize(("before", "after"), PAIRS)
def test_another_gain_is_followed_within_two_seconds(before: float, after: float) -> None:
    """By the model of the gain before, let loose, and by the prior with the slope of that gain.

    The reference has seen the very ticks it is tried on: a fit to all runs of the gain.  Each run
    begins afresh; what its first two seconds hold is not counted.
    """
    runs = load_logs(REAL)
    library = Library("servo", ("joint",), ("pitch",), slope_rad=SLOPE_RAD[before], period_s=0.02)
    first, again = (fitted(library, [r for r in runs if r.gain == g]) for g in (before, after))
    changing = with_changes(library, first)
    grown = np.concatenate([first, np.zeros((changing.size - library.size, 1))])
    prior = leg_prior(library, QUANTUM_RAD)
    off: dict[str, list[np.ndarray]] = {"frozen": [], "loose": [], "prior": [], "again": []}
    for run in (r for r in runs if r.gain == after):
        theta, increment = rows(library, [run])
        more, _ = rows(changing, [run])
        kept = slice(FOLLOWED_TICKS, None)
        off["frozen"].append((increment - theta @ first)[kept, 0])
        off["again"].append((increment - theta @ again)[kept, 0])
        known = dataclasses.replace(
            prior, model=LegModel(changing, grown), spread=None,
            scale=np.sqrt(np.square(more).mean(axis=0)),
        )  # fmt: skip
        loose = ActiveModel(known)
        loose.inflate()
        off["loose"].append(followed(loose, more, increment)[kept])
        off["prior"].append(followed(ActiveModel(prior), theta, increment)[kept])
    rms = {name: float(np.sqrt(np.square(np.concatenate(e)).mean())) for name, e in off.items()}
    print(f"{before:g} to {after:g}:", *(f"{n} {e / rms['again']:.2f}" for n, e in rms.items()))
    assert rms["frozen"] > 1.25 * rms["again"]
    assert rms["loose"] < 1.3 * rms["again"]
    assert rms["prior"] < 1.3 * rms["again"]


def followed(active: ActiveModel, theta: np.ndarray, increment: np.ndarray) -> np.ndarray:
    """(n,) rad: what each tick differs from its prediction, before it is learned."""
    off = []
    for row, moved in zip(theta, increment, strict=True):
        off.append(moved[0] - row @ active.coefficients[:, 0])
        active.learn(np.concatenate([row, moved])[None], 0)
    return np.array(off)
