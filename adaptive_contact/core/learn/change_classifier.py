"""Classifies a change: which kind explains best how the leg has moved since.

Every kind is a few shapes per joint, each with a free amplitude: what the change adds to the
movements that the model of before predicts.  A kind with more shapes has to explain more
(Schwarz's criterion).  Friction works against the movement that is *predicted*: a joint that stands
and should break away is held back like one that moves.  Taken against the movement before, a leg
that rubs and a drive that is weak look alike (decision 20).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.model.change_prior import speaks_of
from adaptive_contact.model.labelled_swing import Rows
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.robot.kinematics import yaws_then_pitches

KINDS: Final = ("friction", "drive", "load")
# A kind is reported only if it explains this share of the squared residual...
LEAST_SHARE: Final = 0.3
# ...of so many ticks, two lifts or so...
LEAST_ROWS: Final = 8


class _Shapes(NamedTuple):
    """Holds what changes add to one joint's movement."""

    # (p, s) shapes that are linear in the regressors; friction's, which is not, stands before them
    linear: Array
    of: dict[str, list[int]]  # kind -> its columns, friction's counted


class ChangeClassifier:
    """Compares the ticks since a change with every kind; their number takes no memory.

    Args:
        model: in force when the change was found.
        noise: (J,) rad.
    """

    def __init__(self, model: LegModel, noise: Array) -> None:
        self._model, self._noise = model, noise
        # At 1 rad/s friction is three quarters of what it comes to.
        self._knee = model.library.period_s
        self._shapes = [_shapes(model, joint) for joint in range(len(noise))]
        # Where one kind alone has shapes, every change would be reported as that kind.
        self._comparable = all(any(of[kind] for _, of in self._shapes) for kind in KINDS)
        self._rows = 0
        # Per joint, products of its shapes and, last, of its residual in noise units.
        sizes = [2 + of.linear.shape[1] for of in self._shapes]
        self._products = [np.zeros((size, size)) for size in sizes]

    def add(self, rows: Rows) -> None:
        """Take in free ticks, of lifts and of descents."""
        if not rows:
            return
        theta, residual = rows.theta, rows.residual(self._model.coefficients)
        friction = np.tanh(theta @ self._model.coefficients / self._knee)
        self._rows += len(rows)
        for joint, (linear, _) in enumerate(self._shapes):
            y = residual[:, joint] / self._noise[joint]
            columns = np.column_stack((friction[:, joint], theta @ linear, y))
            self._products[joint] += columns.T @ columns

    @property
    def complete(self) -> bool:
        """Return whether more ticks would show later changes rather than this one."""
        # Ticks after which a kind is settled, fifteen lifts and descents or so: a leg may go on
        # changing.
        return self._rows >= 60

    @property
    def kind(self) -> str | None:
        """Return the kind that explains the change best; None where none does.

        Returns:
            ``friction``, ``drive`` (supply, winding, compliance: the control law is weaker or
            softer), ``load`` (gravity and inertia), or None where none explains enough, and by a
            library that knows no control law.
        """
        if self._rows < LEAST_ROWS or not self._comparable:
            return None
        n = self._rows * len(self._noise)
        found = []
        for kind in KINDS:
            unexplained = self.unexplained(kind)
            shapes = sum(len(of[kind]) for _, of in self._shapes)
            criterion = n * float(np.log(unexplained)) + shapes * float(np.log(n))
            found.append((criterion, unexplained, kind))
        (least, unexplained, best), (second, *_), *_ = sorted(found)
        # ...and so much better than the next, by the criterion: very strong evidence (Kass and
        # Raftery).
        clear = unexplained < 1.0 - LEAST_SHARE and second - least > 10.0
        return best if clear else None

    def unexplained(self, kind: str) -> float:
        """Compute the share of the squared residual that a kind leaves; 1 without ticks."""
        total = left = 0.0
        for products, (_, of) in zip(self._products, self._shapes, strict=True):
            y = float(products[-1, -1])
            total += y
            left += y - _explained(products, of[kind])
        return max(left / total, 1e-12) if total > 0.0 else 1.0


def _shapes(model: LegModel, joint: int) -> _Shapes:
    """Return the shapes whose terms the library has: the paper's has no control law, no gravity."""
    library = model.library
    names, name, own = library.names, library.joints[joint], model.coefficients[:, joint]
    drive = np.array([t.startswith("sat(") and speaks_of(t, name) for t in names])
    weaker = [np.where(drive, own, 0.0)] if drive.any() else []
    softer = _difference(names, f"sat(e_{name}/2s)", f"sat(e_{name}/s)")
    # Links that lie level at 0 weigh by the cosine; of others it is not known.
    of_zero = ("cos",) if yaws_then_pitches(library.axes) else ("cos", "sin")
    gravity = [
        one
        for angle in library.gravity
        if angle.weights[joint]
        for of in of_zero
        for one in _term(names, f"{of} {angle.name}")
    ]
    # Inertia: a movement takes longer to become another.
    slower = [own - before for before in _term(names, f"v_{name}")]
    columns = [*weaker, *softer, *gravity, *slower]
    linear = np.array(columns).reshape(len(columns), library.size).T
    pulls = len(weaker) + len(softer)
    of = {
        "friction": [0],
        "drive": list(range(1, 1 + pulls)),
        "load": list(range(1 + pulls, 1 + len(columns))),
    }
    return _Shapes(linear, of)


def _term(names: Sequence[str], term: str) -> list[Array]:
    """Return the column of a term, (p,), where there is one."""
    return [np.array([float(name == term) for name in names])] if term in names else []


def _difference(names: Sequence[str], one: str, other: str) -> list[Array]:
    return [a - b for a in _term(names, one) for b in _term(names, other)]


def _explained(products: Array, columns: Sequence[int]) -> float:
    """Compute what some columns explain of the squared residual."""
    if not columns:
        return 0.0
    among, with_y = products[np.ix_(columns, columns)], products[columns, -1]
    size = np.sqrt(np.maximum(np.diag(among), 1e-300))
    solution = np.linalg.lstsq(among / np.outer(size, size), with_y / size, rcond=1e-9)[0]
    return float(with_y / size @ solution)
