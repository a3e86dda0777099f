"""Regression rows of simulated streams, and the floor that no prediction gets below."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.model import Factor, LegModel, Library, Rows, Window, stack
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.servo import QUANTUM_RAD
from adaptive_contact_studies.paper.data import Stream

# N, N', M of the paper's model; the paper does not print its own (see the window study).
PAPER_WINDOW: Final = Window(past_measured=2, past_desired=2, preview=1)


def free_rows(streams: Sequence[Stream], library: Library) -> Rows:
    """Windows of a leg's streams, one after the other, whose tick and next one are free swing."""
    windows = []
    for stream in streams:
        leg = stream.arrays
        cut = stack(leg.measured, leg.desired, library.window)
        use = leg.swing & stream.stretch.free
        rows = use[cut.tick] & use[cut.tick + 1]
        windows.append([part[rows] for part in cut])
    return Rows(*map(np.concatenate, zip(*windows, strict=True)))


def predictions(model: LegModel, measured: Array, desired: Array) -> Array:
    """(n, J) rad, the positions predicted one tick before; NaN where the window was not full."""
    out = np.full_like(measured, np.nan)
    cut = stack(measured, desired, model.library.window)
    out[cut.tick + 1] = cut.measured[:, 0] + model.increment(*cut[:3])
    return out


def factor_of(library: Library, windows: Rows, target: Array) -> Factor:
    """The compressed regression of windows on a target, (n, q)."""
    factor = Factor(library.size, target.shape[1])
    factor.add(library.evaluate(*windows[:3]), target)
    return factor


def noise_floor() -> float:
    r"""Standard deviation of a reading about the true angle, rad.

    Noise of :math:`\sigma` steps before rounding, and rounding itself, uniform over a step:
    :math:`q\sqrt{\sigma^2 + 1/12}`.  What is to be predicted is a reading, so that no model's
    residual is smaller.
    """
    return QUANTUM_RAD * math.sqrt(EncoderSettings().noise_steps ** 2 + 1.0 / 12.0)


def rms_deg(residual: Array) -> list[float]:
    """Root mean square of every column, degrees; NaN without rows."""
    if not len(residual):
        return [float("nan")] * residual.shape[1]
    return [float(v) for v in np.degrees(np.sqrt(np.square(residual).mean(axis=0)))]


def over_floor(residual: Array) -> list[float]:
    """:func:`rms_deg` over the noise floor."""
    floor = float(np.degrees(noise_floor()))
    return [v / floor for v in rms_deg(residual)]
