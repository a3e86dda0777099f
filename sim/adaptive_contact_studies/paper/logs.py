"""The same libraries on recordings of real servos.

Recordings of an arm are dealt into five folds twice: by motion, so that a model is tried on motions
of a kind it has never seen, and by blocks of ten seconds, so that it knows the kind but not the
moment.  Models are fitted to three fifths; λ, noise and thresholds are taken from another fifth;
errors and alarms are counted on the last, in turn.  For a pendulum recorded at several gains, a
model of one gain is tried at the others as it is, beside one fitted there; the trajectory that is
tried is held out of both, so that only the gain differs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Factor, LegModel, Library, LibraryName, Window
from adaptive_contact.model.window import stack
from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.robot.description import Axis
from adaptive_contact_studies.paper.detectors import (
    Calibration,
    Motion,
    Prediction,
    alarm_ticks,
    learn_noise,
    likelihood_ratio,
)
from adaptive_contact_studies.paper.log_files import PERIOD_S, Recording, load_logs
from adaptive_contact_studies.paper.rows import (
    NO_MODEL,
    blockwise,
    factor_of,
    residual_unit,
    rms_deg,
    worst,
)

FOLDS: Final = 5
# Slopes of the servo's law that are tried, rad.
SLOPES: Final = (0.04, 0.08, 0.16, 0.32, 0.64, 1.28)
# λ that are tried, in units of the residual.
_THRESHOLDS: Final = (0.0, 0.05, 0.2, 0.5, 1.0)
_BLOCK_TICKS: Final = 500
_AIM_PER_HOUR: Final = 1.0
# Windows by library; the paper's grows with the square of joints times window.
_WINDOWS: Final[dict[LibraryName, Window]] = {
    "linear": Window(),
    "paper": Window(past_measured=1, past_desired=1, preview=0),
    "servo": Window(),
}
_QUANTUM_RAD: Final = 0.001534  # 4096 steps a turn, both servos


def run_logs(path: Path) -> dict[str, Any]:
    """Fit and test on all recordings of a path.

    Returns:
        A tree of figures, with what was skipped and why.

    Raises:
        RecordingError: there is nothing to read.
    """
    logs = load_logs(path)
    arms: dict[int, list[Recording]] = {}
    for recording in logs.recordings:
        if recording.kind == "arm":
            arms.setdefault(recording.measured.shape[1], []).append(recording)
    pendulum = [r for r in logs.recordings if r.kind == "pendulum"]
    return {
        "path": str(path),
        "skipped": [{"file": f, "reason": r} for f, r in logs.skipped],
        "recordings": len(logs.recordings),
        "repaired": sum(r.repaired for r in logs.recordings),
        "arms": [{"joints": joints, **_arm(own)} for joints, own in sorted(arms.items())],
        "pendulum": _pendulum(pendulum) if pendulum else None,
    }


def _library(name: LibraryName, joints: int, slope: float) -> Library:
    # Axes only matter for gravity terms: a first joint that turns about the vertical, as in arms
    # and legs, then pitches; a single joint pitches.
    pitch: Axis = "pitch"
    pitches = (pitch,) * max(joints - 1, 1)
    axes: tuple[Axis, ...] = pitches if joints == 1 else ("yaw", *pitches)
    return Library(
        name=name,
        joints=tuple(f"joint{i + 1}" for i in range(joints)),
        axes=axes,
        window=_WINDOWS[name],
        slope_rad=slope,
        period_s=PERIOD_S,
    )


def _factors(library: Library, recordings: Iterable[Recording]) -> list[Factor]:
    cut = [stack(r.measured, r.desired, library.window) for r in recordings]
    return [factor_of(library, windows, windows.increment) for windows in cut]


def _merged(library: Library, factors: Iterable[Factor]) -> Factor:
    return Factor.merged(factors, library.size, len(library.joints))


def _fit(factor: Factor, trials: Sequence[tuple[Factor, Factor]]) -> tuple[FitStatus, Array]:
    """Status and coefficients of the λ that, fitted to the first of each trial, predicts the other.

    Args:
        factor: that is fitted in the end.
        trials: none for plain least squares.
    """
    plain = fit_sparse(factor, FitSettings())
    if plain.status is not FitStatus.OK or not trials:
        return plain.status, plain.coefficients
    unit = residual_unit(plain)
    errors = []
    for threshold in _THRESHOLDS:
        settings = FitSettings(threshold=threshold, unit=unit)
        fits = [(fit_sparse(fitted, settings), held) for fitted, held in trials]
        errors.append(
            sum(
                float((held.rms(fit.coefficients) / unit).mean())
                if fit.status is FitStatus.OK
                else np.inf
                for fit, held in fits
            )
        )
    best = FitSettings(threshold=_THRESHOLDS[int(np.argmin(errors))], unit=unit)
    fit = fit_sparse(factor, best)
    return fit.status, fit.coefficients


def _residual(library: Library, coefficients: Array, recording: Recording) -> Array:
    windows = stack(recording.measured, recording.desired, library.window)
    return np.asarray(windows.increment - blockwise(library, windows, coefficients))


def _naive_deg(recordings: Sequence[Recording]) -> list[float]:
    return rms_deg(np.concatenate([np.diff(r.measured, axis=0) for r in recordings]))


def _arm(recordings: list[Recording]) -> dict[str, Any]:
    """One-step errors of every library, and false alarms of the servo law's."""
    joints = recordings[0].measured.shape[1]
    slope = _best_slope(recordings, joints)
    out: dict[str, Any] = {
        "motions": [r.name for r in recordings],
        "rows": int(sum(len(r.measured) for r in recordings)),
        "slope_rad": slope,
        "naive_deg": _naive_deg(recordings),
    }
    blocks = [block for r in recordings for block in _blocks(r)]
    for name, parts in (("unseen motions", recordings), ("unseen moments", blocks)):
        if len(parts) >= FOLDS:
            out[name] = _folded(parts, joints, slope)
        else:
            few = f"{len(parts)} parts; expected at least {FOLDS} to hold some out"
            out[name] = {"status": few}
    return out


def _blocks(recording: Recording) -> list[Recording]:
    """Ten seconds each; what is left over goes with the last."""
    n = len(recording.measured)
    edges = [*range(0, max(n - _BLOCK_TICKS + 1, 1), _BLOCK_TICKS)]
    bounds = zip(edges, [*edges[1:], n], strict=True)
    return [
        dataclasses.replace(
            recording, measured=recording.measured[a:b], desired=recording.desired[a:b]
        )
        for a, b in bounds
    ]


def _folded(parts: Sequence[Recording], joints: int, slope: float) -> dict[str, Any]:
    """Every part predicted by models of others; no error is reported where a fold has no model."""
    out: dict[str, Any] = {"rms_deg": {}, "terms": {}, "status": {}}
    for name in _WINDOWS:
        library = _library(name, joints, slope)
        factors = _factors(library, parts)
        held, over, ticks, terms = [], 0, 0, []
        ended: list[FitStatus] = []
        reason: str | None = None
        for fold in range(FOLDS):
            # From the fold on: those that are tested, then those for tuning.
            after = [(i - fold) % FOLDS for i in range(len(parts))]
            tested, tuning = (
                [part for part, n in zip(parts, after, strict=True) if n == step] for step in (0, 1)
            )
            tried, trained = (
                _merged(
                    library,
                    (f for f, n in zip(factors, after, strict=True) if n and (n > 1) is rest),
                )
                for rest in (False, True)
            )
            status, coefficients = _fit(trained, [(trained, tried)])
            ended.append(status)
            terms.append(np.count_nonzero(coefficients, axis=0))
            held += [_residual(library, coefficients, r) for r in tested]
            if name == "servo" and status is FitStatus.OK:
                try:
                    counted = _alarms(LegModel(library, coefficients), tuning, tested)
                    over, ticks = over + counted[0], ticks + counted[1]
                except IdentificationError as error:
                    reason = str(error)
        status = worst(ended)
        out["status"][name] = status.value
        out["rms_deg"][name] = None if status in NO_MODEL else rms_deg(np.concatenate(held))
        out["terms"][name] = {"size": library.size, "kept": np.mean(terms, axis=0).tolist()}
        if name == "servo":
            out["false_alarms"] = {
                "events": over,
                "ticks": ticks,
                "per_hour": over / (ticks / ROBOT_HOUR_TICKS) if ticks else None,
                "aim_per_hour": _AIM_PER_HOUR,
                "expected": _AIM_PER_HOUR * ticks / ROBOT_HOUR_TICKS,
                "reason": reason or (status.value if status in NO_MODEL else None),
            }
    return out


def _best_slope(recordings: Sequence[Recording], joints: int) -> float:
    """The slope with the least error when half of the motions predict the other half."""
    errors = []
    for slope in SLOPES:
        library = _library("servo", joints, slope)
        half, rest = (
            _merged(library, _factors(library, part))
            for part in (recordings[::2], recordings[1::2] or recordings)
        )
        _, coefficients = _fit(half, [(half, rest)])
        errors.append(float(rest.rms(coefficients).mean()))
    return SLOPES[int(np.argmin(errors))]


def _motion(recording: Recording) -> Motion:
    """All one swing: nothing is known of phases, and nothing is touched."""
    n = len(recording.measured)
    # Descents, the cautious choice.
    falling = np.ones(n, dtype=np.int64)
    return Motion(recording.measured, recording.desired, np.arange(1, n + 1), falling)


def _alarms(
    model: LegModel, tuned: Sequence[Recording], tested: Sequence[Recording]
) -> tuple[int, int]:
    """Events on free motions, at the threshold that tuning motions set, and judged ticks.

    Raises:
        IdentificationError: the tuning motions are too short for a threshold.
    """
    known, new = (
        [(_motion(r), Prediction.of(model, r.measured, r.desired)) for r in part]
        for part in (tuned, tested)
    )
    joined = Motion(*map(np.concatenate, zip(*(m for m, _ in known), strict=True)))
    pooled = Prediction(*map(np.concatenate, zip(*(p for _, p in known), strict=True)))
    noise = learn_noise(joined, pooled, joined.judged, _QUANTUM_RAD)
    calibration = Calibration.of(
        [likelihood_ratio(m, p, noise, _QUANTUM_RAD)[m.judged] for m, p in known]
    )
    over = ticks = 0
    for motion, prediction in new:
        value = likelihood_ratio(motion, prediction, noise, _QUANTUM_RAD)
        score = calibration.score(value, _AIM_PER_HOUR / ROBOT_HOUR_TICKS)
        score[~motion.judged] = np.nan
        over += len(alarm_ticks(score, np.zeros(len(score), dtype=np.int64)))
        ticks += int(np.count_nonzero(np.isfinite(score)))
    return over, ticks


def _pendulum(recordings: list[Recording]) -> dict[str, Any]:
    """Models of every gain at every gain, the trajectory that is tried held out of all of them.

    A model tried at its own gain is the refitted one: it differs from the fixed ones in the gain
    of its rows, and in nothing else.
    """
    slope = _best_slope(recordings, 1)
    gains = sorted({r.gain for r in recordings if r.gain is not None})
    trajectories = sorted({r.trajectory for r in recordings})
    libraries: dict[str, Any] = {}
    for name in _WINDOWS:
        library = _library(name, 1, slope)
        factors = _factors(library, recordings)
        table: dict[str, dict[str, float | str]] = {}
        for gain in gains:
            held: dict[float, list[Array]] = {g: [] for g in gains}
            ended: dict[float, list[FitStatus]] = {g: [] for g in gains}
            for trajectory in trajectories:
                others = [
                    factor
                    for factor, r in zip(factors, recordings, strict=True)
                    if r.gain == gain and r.trajectory != trajectory
                ]
                trials = [
                    (_merged(library, others[:i] + others[i + 1 :]), other)
                    for i, other in enumerate(others)
                ]
                fit, coefficients = _fit(
                    _merged(library, others), trials if len(others) > 1 else []
                )
                for r in recordings:
                    if r.trajectory == trajectory and r.gain is not None:
                        held[r.gain].append(_residual(library, coefficients, r))
                        ended[r.gain].append(fit)
            known = {g: worst(ended[g]) for g in gains}
            table[f"{gain:g}"] = {
                f"{g:g}": known[g].value
                if known[g] in NO_MODEL
                else rms_deg(np.concatenate(held[g]))[0]
                for g in gains
            }
        libraries[name] = table
    return {
        "gains": [f"{g:g}" for g in gains],
        "slope_rad": slope,
        "naive_deg": {
            f"{g:g}": _naive_deg([r for r in recordings if r.gain == g])[0] for g in gains
        },
        "rms_deg": libraries,  # by library, gain of the model and gain; a status without a model
    }
