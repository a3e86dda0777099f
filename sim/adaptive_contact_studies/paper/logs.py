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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import IdentificationError
from adaptive_contact.fit import FitSettings, FitStatus, fit_sparse
from adaptive_contact.model import Factor, Library, LibraryName, Window
from adaptive_contact.model.window import stack
from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.robot.description import Axis
from adaptive_contact_studies.paper.comparison_rules import (
    Motion,
    Prediction,
    alarm_ticks,
    calibrate,
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


def run_logs(path: Path, progress: Callable[[float], None] = lambda _: None) -> dict[str, Any]:
    """Fit and test on all recordings of a path.

    Returns:
        A tree of figures, with what was skipped and why.

    Raises:
        RecordingError: there is nothing to read.
    """
    logs = load_logs(path)
    tree: dict[str, Any] = {
        "path": str(path),
        "skipped": [{"file": f, "reason": r} for f, r in logs.skipped],
        "recordings": len(logs.recordings),
        "repaired": sum(r.repaired for r in logs.recordings),
        "arms": [],
    }
    arms: dict[int, list[Recording]] = {}
    for recording in logs.recordings:
        if recording.kind == "arm":
            arms.setdefault(recording.measured.shape[1], []).append(recording)
    pendulum = [r for r in logs.recordings if r.kind == "pendulum"]
    # An arm's slope and two ways to hold out, a pendulum's slope and one.
    steps = len(arms) * (1 + 2 * len(_WINDOWS)) + bool(pendulum) * (1 + len(_WINDOWS))

    def done() -> None:
        progress(1.0 / steps)

    for joints, recordings in sorted(arms.items()):
        tree["arms"].append({"joints": joints, **_arm(recordings, done)})
    if pendulum:
        tree["pendulum"] = _pendulum(pendulum, done)
    return tree


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


def _factor(library: Library, recordings: Sequence[Recording]) -> Factor:
    parts = []
    for recording in recordings:
        windows = stack(recording.measured, recording.desired, library.window)
        parts.append(factor_of(library, windows, windows.increment))
    return Factor.merged(parts, library.size, len(library.joints))


def _fit(factor: Factor, tuning: Factor) -> tuple[FitStatus, Array]:
    """Status and coefficients of the λ that predicts the tuning rows best."""
    plain = fit_sparse(factor, FitSettings())
    if plain.status is not FitStatus.OK:
        return plain.status, plain.coefficients
    unit = residual_unit(plain)
    best, error = plain.coefficients, float((tuning.rms(plain.coefficients) / unit).mean())
    for threshold in _THRESHOLDS[1:]:
        fit = fit_sparse(factor, FitSettings(threshold=threshold, unit=unit))
        tuned = float((tuning.rms(fit.coefficients) / unit).mean())
        if fit.status is FitStatus.OK and tuned < error:
            best, error = fit.coefficients, tuned
    return FitStatus.OK, best


def _residual(library: Library, coefficients: Array, recording: Recording) -> Array:
    windows = stack(recording.measured, recording.desired, library.window)
    return np.asarray(windows.increment - blockwise(library, windows, coefficients))


def _arm(recordings: list[Recording], done: Callable[[], None]) -> dict[str, Any]:
    """One-step errors of every library, and false alarms of the servo law's."""
    joints = recordings[0].measured.shape[1]
    slope = _best_slope(recordings, joints)
    done()
    out: dict[str, Any] = {
        "motions": [r.name for r in recordings],
        "rows": int(sum(len(r.measured) for r in recordings)),
        "slope_rad": slope,
        "naive_deg": rms_deg(np.concatenate([np.diff(r.measured, axis=0) for r in recordings])),
    }
    blocks = [block for r in recordings for block in _blocks(r)]
    for name, parts in (("unseen motions", recordings), ("unseen moments", blocks)):
        out[name] = (
            _folded(parts, joints, slope, done)
            if len(parts) >= FOLDS
            else {"status": f"{len(parts)} parts; expected at least {FOLDS} to hold some out"}
        )
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


def _folded(
    parts: Sequence[Recording], joints: int, slope: float, done: Callable[[], None]
) -> dict[str, Any]:
    """Every part predicted by models of others; no error is reported where a fold has no model."""
    out: dict[str, Any] = {"rms_deg": {}, "terms": {}, "status": {}}
    for name in _WINDOWS:
        library = _library(name, joints, slope)
        factors = [_factor(library, [r]) for r in parts]
        held, over, ticks, terms = [], 0, 0, []
        ended: list[FitStatus] = []
        reason: str | None = None
        for fold in range(FOLDS):
            tested = [r for i, r in enumerate(parts) if i % FOLDS == fold]
            tuning = [i for i in range(len(parts)) if i % FOLDS == (fold + 1) % FOLDS]
            trained = [
                f for i, f in enumerate(factors) if i % FOLDS not in (fold, (fold + 1) % FOLDS)
            ]
            status, coefficients = _fit(
                Factor.merged(trained, library.size, joints),
                Factor.merged((factors[i] for i in tuning), library.size, joints),
            )
            ended.append(status)
            terms.append(np.count_nonzero(coefficients, axis=0))
            held += [_residual(library, coefficients, r) for r in tested]
            if name == "servo" and status is FitStatus.OK:
                try:
                    counted = _alarms(library, coefficients, [parts[i] for i in tuning], tested)
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
        done()
    return out


def _best_slope(recordings: Sequence[Recording], joints: int) -> float:
    """The slope with the least error when half of the motions predict the other half."""
    errors = []
    for slope in SLOPES:
        library = _library("servo", joints, slope)
        rest = _factor(library, recordings[1::2] or recordings)
        _, coefficients = _fit(_factor(library, recordings[::2]), rest)
        errors.append(float(rest.rms(coefficients).mean()))
    return SLOPES[int(np.argmin(errors))]


def _prediction(library: Library, coefficients: Array, recording: Recording) -> Prediction:
    windows = stack(recording.measured, recording.desired, library.window)
    increment = np.full_like(recording.measured, np.nan)
    increment[windows.tick + 1] = blockwise(library, windows, coefficients)
    residual = np.full_like(recording.measured, np.nan)
    residual[1:] = np.diff(recording.measured, axis=0) - increment[1:]
    return Prediction(residual, increment)


def _motion(recording: Recording) -> Motion:
    """All one swing: nothing is known of phases, and nothing is touched."""
    n = len(recording.measured)
    # Descents, the cautious choice.
    return Motion(
        recording.measured,
        recording.desired,
        np.arange(1, n + 1),
        np.ones(n, dtype=np.int64),
    )


def _alarms(
    library: Library, coefficients: Array, tuned: Sequence[Recording], tested: Sequence[Recording]
) -> tuple[int, int]:
    """Events on free motions, at the threshold that tuning motions set, and judged ticks.

    Raises:
        IdentificationError: the tuning motions are too short for a threshold.
    """
    motions = [_motion(r) for r in tuned]
    predicted = [_prediction(library, coefficients, r) for r in tuned]
    joined = Motion(*map(np.concatenate, zip(*motions, strict=True)))
    pooled = Prediction(*map(np.concatenate, zip(*predicted, strict=True)))
    noise = learn_noise(joined, pooled, joined.judged, _QUANTUM_RAD)
    calibration = calibrate(
        [
            likelihood_ratio(m, p, noise, _QUANTUM_RAD)[m.judged]
            for m, p in zip(motions, predicted, strict=True)
        ]
    )
    over = ticks = 0
    for recording in tested:
        motion = _motion(recording)
        value = likelihood_ratio(
            motion, _prediction(library, coefficients, recording), noise, _QUANTUM_RAD
        )
        score = calibration.score(value, _AIM_PER_HOUR / ROBOT_HOUR_TICKS)
        score[~motion.judged] = np.nan
        over += len(alarm_ticks(score, np.zeros(len(score), dtype=np.int64)))
        ticks += int(np.count_nonzero(np.isfinite(score)))
    return over, ticks


def _pendulum(recordings: list[Recording], done: Callable[[], None]) -> dict[str, Any]:
    """Models of every gain at every gain, the trajectory that is tried held out of all of them.

    A model tried at its own gain is the refitted one: it differs from the fixed ones in the gain
    of its rows, and in nothing else.
    """
    slope = _best_slope(recordings, 1)
    done()
    gains = sorted({r.gain for r in recordings if r.gain is not None})
    trajectories = sorted({r.trajectory for r in recordings})
    out: dict[str, Any] = {
        "runs": len(recordings),
        "gains": gains,
        "trajectories": trajectories,
        "slope_rad": slope,
    }
    out["naive_deg"] = {
        f"{g:g}": rms_deg(
            np.concatenate([np.diff(r.measured, axis=0) for r in recordings if r.gain == g])
        )[0]
        for g in gains
    }
    libraries: dict[str, Any] = {}
    for name in _WINDOWS:
        library = _library(name, 1, slope)
        factors = [_factor(library, [r]) for r in recordings]
        rms: dict[str, dict[str, float | None]] = {}
        status: dict[str, dict[str, str]] = {}
        for gain in gains:
            held: dict[float, list[Array]] = {g: [] for g in gains}
            ended: dict[float, list[FitStatus]] = {g: [] for g in gains}
            for trajectory in trajectories:
                others = [
                    factor
                    for factor, r in zip(factors, recordings, strict=True)
                    if r.gain == gain and r.trajectory != trajectory
                ]
                fit, coefficients = _chosen(library, others)
                for r in recordings:
                    if r.trajectory == trajectory and r.gain is not None:
                        held[r.gain].append(_residual(library, coefficients, r))
                        ended[r.gain].append(fit)
            known = {g: worst(ended[g]) for g in gains}
            status[f"{gain:g}"] = {f"{g:g}": known[g].value for g in gains}
            rms[f"{gain:g}"] = {
                f"{g:g}": None if known[g] in NO_MODEL else rms_deg(np.concatenate(held[g]))[0]
                for g in gains
            }
        libraries[name] = {"rms_deg": rms, "status": status, "size": library.size}
        done()
    out["libraries"] = libraries
    return out


def _chosen(library: Library, factors: Sequence[Factor]) -> tuple[FitStatus, Array]:
    """Fit all factors with the λ that predicts each of them best from the others."""
    whole = Factor.merged(factors, library.size, 1)
    plain = fit_sparse(whole, FitSettings())
    if plain.status is not FitStatus.OK or len(factors) < 2:
        return plain.status, plain.coefficients
    unit = residual_unit(plain)
    errors = []
    for threshold in _THRESHOLDS:
        settings = FitSettings(threshold=threshold, unit=unit)
        error = 0.0
        for i, held in enumerate(factors):
            rest = Factor.merged((f for k, f in enumerate(factors) if k != i), library.size, 1)
            fit = fit_sparse(rest, settings)
            error += float(held.rms(fit.coefficients)[0]) if fit.status is FitStatus.OK else np.inf
        errors.append(error)
    threshold = _THRESHOLDS[int(np.argmin(errors))]
    fit = fit_sparse(whole, FitSettings(threshold=threshold, unit=unit))
    return fit.status, fit.coefficients
