"""A real servo whose gain is halved: one number says what becomes of its model (decision 21)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.fit import FitSettings, fit_sparse
from adaptive_contact.model import Factor, Library, Window, stack, with_changes
from adaptive_contact_studies.paper.log_files import Recording, load_logs

REAL = Path(__file__).resolve().parents[3] / "shared" / "data" / "xl330"

# Error at a gain at which the servo reaches full drive: with half of it the slope is twice as wide.
# The best of a scan at each gain alone, the other gains unseen.
SLOPES = {400.0: 0.64, 200.0: 1.28}


def rows(library: Library, runs: list[Recording]) -> tuple[np.ndarray, np.ndarray]:
    cut = [stack(run.measured, run.desired, library.window) for run in runs]
    theta = [library.evaluate(c.measured, c.desired, c.preview) for c in cut]
    return np.concatenate(theta), np.concatenate([c.increment for c in cut])


def fitted(library: Library, runs: list[Recording]) -> np.ndarray:
    factor = Factor(library.size, 1)
    factor.add(*rows(library, runs))
    return fit_sparse(factor, FitSettings()).coefficients


@pytest.mark.skipif(
    not REAL.is_dir(),
    reason="no ../shared/data/xl330: recordings of github.com/Rhoban/bam, not part of the project",
)
@pytest.mark.parametrize("gain", sorted(SLOPES))
def test_half_the_gain_is_twice_the_slope(gain: float) -> None:
    """On a trajectory that neither the model nor the number has seen, each of four in turn."""
    runs = load_logs(REAL).recordings
    library = Library(
        "servo", ("joint",), ("pitch",), Window(3, 3, 0), slope_rad=SLOPES[gain], period_s=0.02
    )
    told, frozen, moved = [], 0.0, 0.0
    for trajectory in sorted({run.trajectory for run in runs}):
        stiff = [r for r in runs if r.gain == gain and r.trajectory != trajectory]
        soft = [r for r in runs if r.gain == gain / 2.0 and r.trajectory != trajectory]
        held_out = [r for r in runs if r.gain == gain / 2.0 and r.trajectory == trajectory]
        changing = with_changes(library, first := fitted(library, stiff))
        theta, increment = rows(changing, soft)
        off, shape = (increment - theta[:, : library.size] @ first)[:, 0], theta[:, -1]
        told.append(float(shape @ off / (shape @ shape)))
        theta, increment = rows(changing, held_out)
        off = (increment - theta[:, : library.size] @ first)[:, 0]
        frozen += float(np.square(off).sum())
        moved += float(np.square(off - told[-1] * theta[:, -1]).sum())
    assert np.mean(told) == pytest.approx(1.0, abs=0.35), "1 is a servo half as stiff"
    assert moved < 0.85 * frozen
