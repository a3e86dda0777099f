"""What kind of change explains the residuals of a few lifts best."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.adapt.directions import speaks_of
from adaptive_contact.identify import LegModel

__all__ = ["kind_of_change"]

Array = NDArray[np.float64]

# A kind is told only if it explains this share of the squared residual.
LEAST_SHARE: Final = 0.3


def kind_of_change(theta: Array, residual: Array, model: LegModel, noise: Array) -> str | None:
    """Name the change that explains residuals best, with one amplitude per joint.

    Args:
        theta: (n, p) regressors.
        residual: (n, J) rad.
        model: that left these residuals.
        noise: (J,) rad.

    Returns:
        ``friction`` (against the motion), ``drive`` (supply, winding, compliance: the control
        law's terms together), ``load`` (gravity), or None where none explains enough.
    """
    shares = {
        kind: _explained(theta, residual, _directions(kind, model), noise)
        for kind in ("friction", "drive", "load")
    }
    best = max(shares, key=lambda kind: shares[kind])
    return best if shares[best] >= LEAST_SHARE else None


def _directions(kind: str, model: LegModel) -> list[Array]:
    """(p, d) per joint: the columns along which its coefficients would move."""
    names, p = model.library.names, model.library.size
    out = []
    for joint, name in enumerate(model.library.joints):
        columns: list[Array] = []
        if kind == "friction":
            columns = [_unit(p, i) for i, t in enumerate(names) if t == f"tanh(v_{name}/v₀)"]
        elif kind == "load":
            # Gravity enters through the angles of the links; one amplitude along the joint's own.
            columns = [_unit(p, i) for i, t in enumerate(names) if t == f"cos φ_{name}"]
        else:
            own = [i for i, t in enumerate(names) if t.startswith("sat(") and speaks_of(t, name)]
            move = np.zeros(p)
            move[own] = model.coefficients[own, joint]
            columns = [move]
        out.append(np.array(columns).reshape(len(columns), p).T)
    return out


def _explained(theta: Array, residual: Array, directions: list[Array], noise: Array) -> float:
    """Share of the squared residual, in noise units, that the directions explain."""
    total = left = 0.0
    for joint, columns in enumerate(directions):
        y = residual[:, joint] / noise[joint]
        total += float(y @ y)
        if columns.shape[1] == 0:
            left += float(y @ y)
            continue
        x = theta @ columns
        solution = np.linalg.lstsq(x, y, rcond=None)[0]
        rest = y - x @ solution
        left += float(rest @ rest)
    return 1.0 - left / total if total > 0 else 0.0


def _unit(p: int, index: int) -> Array:
    out = np.zeros(p)
    out[index] = 1.0
    return out
