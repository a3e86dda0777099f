"""Packs an adapter's state as a tree that msgpack can write, and reads it back.

Arrays travel as ``{"shape": [...], "data": bytes}`` of little-endian float64.  What is read is
checked for form and for sense before anything is changed: a snapshot is used whole or not at all.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.core.learn.change_classifier import KINDS
from adaptive_contact.core.learn.drift import LEAST_OWN, LEVEL_RANGE
from adaptive_contact.core.learn.replay_buffer import Segment
from adaptive_contact.model.bounds import MOST, is_count
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library
from adaptive_contact.wire import Status

FORMAT: Final = 3


class ImplausibleError(Exception):
    """Reports why a snapshot is not used; `restore` catches it, it never leaves the package."""


def pack(array: Array) -> dict[str, object]:
    """Pack an array for a snapshot."""
    data = np.ascontiguousarray(array, dtype="<f8")
    return {"shape": list(data.shape), "data": data.tobytes()}


def array_of(value: object, shape: tuple[int, ...], what: str) -> Array:
    """Unpack an array from a snapshot; -1 in ``shape`` takes any length.

    Raises:
        ImplausibleError: it is no array of that shape, or not finite.
    """
    if not isinstance(value, dict):
        raise ImplausibleError(f"{what} is no array")
    size, data = value.get("shape"), value.get("data")
    if not isinstance(size, list | tuple) or not isinstance(data, bytes):
        raise ImplausibleError(f"{what} is no array")
    fits = len(size) == len(shape) and all(
        isinstance(n, int) and n >= 0 and want in (-1, n)
        for n, want in zip(size, shape, strict=True)
    )
    if not fits or len(data) != 8 * int(np.prod(size)):
        raise ImplausibleError(f"{what} has shape {list(size)}; expected {list(shape)}")
    array = np.frombuffer(data, dtype="<f8").reshape(size).astype(np.float64)
    if not (np.abs(array) <= MOST).all():
        raise ImplausibleError(f"{what} is not finite, or beyond {MOST:g}")
    return array


def library_key(library: Library) -> dict[str, object]:
    """Describe what a library's regressors depend on; a snapshot of another is of no use."""
    window = library.window
    return {
        "name": library.name,
        "joints": list(library.joints),
        "axes": [axis if isinstance(axis, str) else list(axis) for axis in library.axes],
        "window": [window.past_measured, window.past_desired, window.preview],
        "slope_rad": library.slope_rad,
        "period_s": library.period_s,
    }


def segment_of(segment: Segment) -> dict[str, Any]:
    """Pack a segment for a snapshot."""
    return {
        "theta": pack(segment.theta),
        "target": pack(segment.target),
        "context": pack(segment.context.astype(np.float64)),
        "cell": list(segment.cell),
        "era": segment.era,
        "t_ns": segment.t_ns,
    }


class SavedState(NamedTuple):
    """Holds a snapshot of an adapter, read and checked."""

    coefficients: Array  # (p, J) of the model that was in force
    support: Mask  # (p, J) of its recursion
    segments: list[Segment]  # of the buffer, oldest first
    # version, era: of the model, and of the leg as it was
    version: int
    era: int
    # level, status, held, lifts_assessed, kind: of the drift monitor
    level: float
    status: Status
    held: bool
    lifts_assessed: tuple[int, int]
    kind: str | None
    inflated: bool  # whether the recursion's covariance was


def read_state(saved: dict[str, Any], baseline: LegModel, contexts: int) -> SavedState:
    """Read an adapter's snapshot.

    Args:
        saved: as :meth:`~adaptive_contact.core.learn.adapter.Adapter.snapshot` gave it.
        baseline: from which it must have been learned.
        contexts: of covariances.

    Raises:
        ImplausibleError: it is none, or of another leg.
    """
    p, joints = baseline.coefficients.shape
    if saved.get("format") != FORMAT:
        raise ImplausibleError(f"its format is {saved.get('format')!r}, this version's {FORMAT}")
    if saved.get("library") != library_key(baseline.library):
        raise ImplausibleError("it belongs to another library, other joints or another rate")
    of_baseline = array_of(saved.get("baseline"), (p, joints), "its baseline")
    if not np.allclose(of_baseline, baseline.coefficients, rtol=0, atol=1e-9):
        raise ImplausibleError("it was learned from another baseline")
    version, level, era = saved.get("version"), saved.get("level"), saved.get("era")
    if not (is_count(version) and is_count(era)):
        raise ImplausibleError("its version or era is no number")
    if not (isinstance(level, float) and LEAST_OWN <= level <= LEVEL_RANGE[1]):
        raise ImplausibleError(f"its level is {level!r}")
    status = saved.get("status")
    if status not in ("valid", "adapting", "ambiguous"):
        raise ImplausibleError(f"its status is {status!r}")
    return SavedState(
        coefficients=array_of(saved.get("coefficients"), (p, joints), "its model"),
        support=array_of(saved.get("support"), (p, joints), "its support") > 0.5,
        segments=_segments(saved.get("segments"), p, joints, contexts),
        version=version,
        era=era,
        level=level,
        status=status,
        held=saved.get("held") is True,
        lifts_assessed=_lifts_assessed(saved.get("heard")),
        kind=next((kind for kind in KINDS if kind == saved.get("kind")), None),
        inflated=bool(saved.get("loosened", False)),
    )


def _lifts_assessed(value: object) -> tuple[int, int]:
    """Lifts and those far off; a state of before they were saved is of a leg that was learned."""
    if isinstance(value, list | tuple) and len(value) == 2:
        lifts, far = value
        if is_count(lifts) and is_count(far) and far <= lifts:
            return lifts, far
    return 1, 0


def _segments(value: object, terms: int, joints: int, contexts: int) -> list[Segment]:
    if not isinstance(value, list | tuple):
        raise ImplausibleError("its segments are no list")
    return [_unpack_segment(one, terms, joints, contexts) for one in value]


def _unpack_segment(value: object, terms: int, joints: int, contexts: int) -> Segment:
    if not isinstance(value, dict):
        raise ImplausibleError("a segment is no map")
    theta = array_of(value.get("theta"), (-1, terms), "a segment's regressors")
    target = array_of(value.get("target"), (len(theta), joints), "a segment's targets")
    if not len(theta):
        raise ImplausibleError("a segment has no ticks")
    context = array_of(value.get("context"), (len(theta),), "a segment's contexts")
    if not ((context >= 0) & (context < contexts)).all():
        raise ImplausibleError("a segment's contexts are none")
    cell, era, t_ns = value.get("cell"), value.get("era"), value.get("t_ns")
    if not (
        isinstance(cell, list | tuple) and len(cell) == 2 and all(isinstance(c, int) for c in cell)
    ):
        raise ImplausibleError("a segment's cell is no pair")
    if not (is_count(era) and is_count(t_ns)):
        raise ImplausibleError("a segment's era or time is no number")
    place = (int(cell[0]), int(cell[1]))
    values = np.concatenate([theta, target], axis=1)
    return Segment(values, terms, context.astype(np.int64), place, era, t_ns)
