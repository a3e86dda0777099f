"""Reads and writes a baseline: model, noise and tails of a robot's legs, in one JSON file.

JSON, because a person can read the equations in it, a diff shows what a relearning changed, and
there is nothing to execute in it.  It carries a format version, the robot's name and everything
the library depends on; what does not fit is refused in one line.
"""

from __future__ import annotations

import codecs
import dataclasses
import math
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import msgspec
import numpy as np

from adaptive_contact.arrays import Array, scipy
from adaptive_contact.errors import BaselineError, ConfigurationError, IdentificationError
from adaptive_contact.files import cannot_write, read_file, write_file
from adaptive_contact.model import bounds
from adaptive_contact.model.glr import free_quantile
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library, LibraryName
from adaptive_contact.model.noise import CONTEXTS, DIRECTIONS, SPEEDS, WINDOWS, NoiseModel
from adaptive_contact.model.peaks import Peaks
from adaptive_contact.model.tail import Tail
from adaptive_contact.model.training_domain import Domain
from adaptive_contact.model.window import Window
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot
from adaptive_contact.robot.description import Axis

FORMAT: Final = 2
Direction = Literal["lift", "descent", "after"]
_DIRECTIONS: Final = get_args(Direction)  # in the order of noise
# Characters of a file's value that an error line shows.
_BRIEF: Final = 40


@dataclasses.dataclass(frozen=True)
class LegBaseline:
    """Holds what is known of one leg's free motion."""

    model: LegModel  # one step ahead
    noise: NoiseModel  # residuals on free ticks
    scale: Array  # (p,) root mean square of every regressor on free ticks
    rows: int  # ticks the model was fitted to
    # where these have been; None for what was learned before it was kept
    domain: Domain | None = None
    # (J, d, p) of a prior, standard deviations of the coefficients along d directions, in raw
    # units; None of what was fitted to a leg
    spread: Array | None = None
    # of its free ticks after the turn to stance; None where there were too few
    peaks: Peaks | None = None


@dataclasses.dataclass(frozen=True)
class Baseline:
    """Holds what is known of a robot's legs."""

    robot: str  # name of the robot it belongs to
    origin: str  # one line on how it was made
    quantum_rad: float  # position step of the servos it was learned with
    legs: dict[str, LegBaseline]  # by id
    tails: tuple[Tail, ...]  # of the statistic on free ticks, one per window, pooled over legs
    format: int = FORMAT  # of its file, and so which statistic tails and peaks are of

    def thresholds(self, false_alarms_per_hour: float) -> Array:
        """Compute (windows,) thresholds for a rate of false alarms.

        The rate is split evenly over the windows, which can only make alarms rarer.
        """
        return thresholds_of(self.today().tails, false_alarms_per_hour)

    def today(self) -> Baseline:
        """Return the baseline with tails and peaks of the present statistic.

        Those of an older format are converted: what they exceed those of Gaussian residuals by is
        kept.  The file keeps its text, as saved states belong to that.
        """
        return self if self.format == FORMAT else _convert_to_one_direction(self)

    def check_fits(self, robot: Robot) -> None:
        """Refuse a baseline of another robot.

        Raises:
            BaselineError: it belongs to another robot, or its legs have other joints.
        """
        if self.robot != robot.name:
            raise BaselineError(
                f"the baseline is of robot '{self.robot}', the description of '{robot.name}'; "
                "fit a baseline for this robot (adaptive-contact fit)"
            )
        for leg in robot.legs:
            known = self.legs.get(leg.id)
            if known is not None and known.model.library.joints != leg.joints:
                raise BaselineError(
                    f"the baseline's leg '{leg.id}' has joints "
                    f"{list(known.model.library.joints)}, the description's {list(leg.joints)}; "
                    "fit a baseline for this robot (adaptive-contact fit)"
                )
            if known is not None and not math.isclose(
                known.model.library.period_s, robot.period_s, rel_tol=0.05
            ):
                raise BaselineError(
                    f"the baseline was learned at {known.model.library.period_s} s per tick, the "
                    f"robot runs at {robot.period_s} s; fit a baseline at this rate"
                )


def thresholds_of(tails: tuple[Tail, ...], false_alarms_per_hour: float) -> Array:
    """Compute (windows,) thresholds from tails, with 95 % confidence."""
    per_tick = false_alarms_per_hour / ROBOT_HOUR_TICKS / len(tails)
    return np.array([t.cautious().quantile(min(per_tick, t.rate)) for t in tails])


class _PeaksFile(msgspec.Struct, forbid_unknown_fields=True):
    largest: list[bounds.Peak]  # statistic of free ticks, by window
    ticks: bounds.PeakTicks  # that it is of


class _LegFile(msgspec.Struct, forbid_unknown_fields=True):
    joints: Annotated[tuple[bounds.Name, ...], bounds.OfJoints]
    axes: Annotated[tuple[Axis, ...], bounds.OfJoints]
    rows: bounds.Count
    terms: dict[str, dict[str, bounds.Number]]
    scale: dict[str, bounds.Size]
    covariance: list[list[list[list[bounds.Variance]]]]
    ticks: list[bounds.Weight]
    domain: list[str] | None = None  # rows of the upper triangle, each from its diagonal on
    peaks: dict[Direction, _PeaksFile] | msgspec.UnsetType = msgspec.UNSET
    # Of terms of how the leg moves.
    inflation: bounds.Inflation | msgspec.UnsetType = msgspec.field(
        default=msgspec.UNSET, name="doubt"
    )


class _LibraryFile(msgspec.Struct, forbid_unknown_fields=True):
    name: LibraryName
    past_measured: bounds.Lag
    past_desired: bounds.Lag
    preview: bounds.Lag
    slope_rad: bounds.Slope
    period_s: bounds.Period


class _TailFile(msgspec.Struct, forbid_unknown_fields=True):
    level: bounds.Level
    rate: bounds.Share
    scale: bounds.Excess
    shape: bounds.Shape
    ticks: bounds.TailTicks


class _Head(msgspec.Struct):
    format: Any = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: int
    robot: bounds.Name
    origin: bounds.Text
    quantum_rad: bounds.Quantum
    library: _LibraryFile
    tails: Annotated[
        list[_TailFile], msgspec.Meta(min_length=len(WINDOWS), max_length=len(WINDOWS))
    ]
    legs: Annotated[dict[str, _LegFile], bounds.OfLegs]


def dump_baseline(baseline: Baseline) -> str:
    """Return the text of a baseline file.

    Raises:
        BaselineError: it has no legs, or its legs' libraries differ.
    """
    libraries = {
        dataclasses.replace(b.model.library, joints=("j",), axes=("pitch",))
        for b in baseline.legs.values()
    }
    if len(libraries) != 1:
        raise BaselineError(
            f"a baseline has one library for all legs, found {len(libraries)}; fit it in one go"
        )
    library = libraries.pop()
    file = _File(
        format=baseline.format,
        robot=baseline.robot,
        origin=baseline.origin,
        quantum_rad=baseline.quantum_rad,
        library=_library_file(library),
        tails=[_TailFile(**dataclasses.asdict(t)) for t in baseline.tails],
        legs={leg: _leg_file(known) for leg, known in baseline.legs.items()},
    )
    text = msgspec.json.format(msgspec.json.encode(file), indent=1).decode()
    return text + "\n"


def save_baseline(baseline: Baseline, path: str | Path) -> None:
    """Write a baseline file, whole or not at all.

    Raises:
        BaselineError: it cannot be written there.
    """
    path = Path(path)
    text = dump_baseline(baseline)
    advice = "give another file to write the baseline to"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BaselineError(cannot_write(path, error, advice)) from error
    write_file(path, text, advice=advice, error=BaselineError)


def load_baseline(path: str | Path) -> Baseline:
    """Read a baseline file.

    Raises:
        BaselineError: in one line, what is wrong with it.
    """
    path = Path(path)
    # A leg of 3 joints has 30 kB, one of 16 with all terms of the servo library 0.9 MB.
    data = read_file(path, "give a file that `fit` wrote", most=32_000_000, error=BaselineError)
    return parse_baseline(data, source=str(path))


def shipped_baseline(robot: str) -> Baseline | None:
    """Load the baseline that ships for a robot of this name; None if there is none."""
    root = resources.files("adaptive_contact_models")
    for folder in sorted(root.iterdir(), key=lambda entry: entry.name):
        file = folder.joinpath("baseline.json") if folder.is_dir() else None
        if file is not None and file.is_file():
            baseline = parse_baseline(file.read_bytes(), source=f"{folder.name}/baseline.json")
            if baseline.robot == robot:
                return baseline
    return None


def parse_baseline(data: bytes, *, source: str) -> Baseline:
    """Parse and check the content of a baseline file; ``source`` names it in errors.

    Raises:
        BaselineError: see :func:`load_baseline`.
    """
    try:
        # Editors of Windows begin a file with a mark.
        data = data.removeprefix(codecs.BOM_UTF8)
        found = msgspec.json.decode(data, type=_Head).format
        # Statistics of format 1 counted noise in every direction.
        if found not in (FORMAT, 1):
            raise BaselineError(
                f"{source}: a file of format {_brief(found)}; expected a baseline of format "
                f"{FORMAT}: fit a new one with `adaptive-contact fit`"
            )
        return _baseline(msgspec.json.decode(data, type=_File))
    except (ValueError, RecursionError) as error:  # also of Unicode, and of long numbers
        raise BaselineError(
            f"{source}: not a baseline file ({error}); expected what `adaptive-contact fit` writes"
        ) from error
    except (ConfigurationError, IdentificationError) as error:
        raise BaselineError(f"{source}: {error}") from error


def _library_file(library: Library) -> _LibraryFile:
    return _LibraryFile(
        name=library.name,
        **dataclasses.asdict(library.window),
        slope_rad=library.slope_rad,
        period_s=library.period_s,
    )


def leg_library_of(
    file_library: _LibraryFile, joints: tuple[str, ...], axes: tuple[Axis, ...]
) -> Library:
    """Return the library that a file's leg was fitted with."""
    return Library(
        name=file_library.name,
        joints=joints,
        axes=axes,
        window=Window(file_library.past_measured, file_library.past_desired, file_library.preview),
        slope_rad=file_library.slope_rad,
        period_s=file_library.period_s,
    )


def _peaks_file(peaks: Peaks) -> dict[Direction, _PeaksFile]:
    return {
        name: _PeaksFile(of.tolist(), ticks)
        for name, of, ticks in zip(_DIRECTIONS, peaks.largest, peaks.ticks, strict=True)
        if not np.isnan(of).any()
    }


def _leg_file(known: LegBaseline) -> _LegFile:
    library = known.model.library
    inflation = None if known.domain is None else known.domain.inflation
    covariance, ticks = known.noise.covariance, known.noise.ticks
    if known.peaks is None and not ticks[-SPEEDS:].any():
        # Written as before there was a noise after the turn: states saved then belong to it.
        covariance, ticks = covariance[:-SPEEDS], ticks[:-SPEEDS]
    return _LegFile(
        joints=library.joints,
        axes=library.axes,
        rows=known.rows,
        terms={name: dict(known.model.terms(j)) for j, name in enumerate(library.joints)},
        scale=dict(zip(library.names, known.scale.tolist(), strict=True)),
        covariance=covariance.tolist(),
        ticks=ticks.tolist(),
        peaks=msgspec.UNSET if known.peaks is None else _peaks_file(known.peaks),
        domain=None if known.domain is None else _rows_of(known.domain.triangle),
        inflation=msgspec.UNSET if inflation is None else float(inflation.max()),
    )


def _rows_of(triangle: Array) -> list[str]:
    return [" ".join(f"{value:.4g}" for value in row[i:]) for i, row in enumerate(triangle)]


def _domain(entry: _LegFile, library: Library, scale: Array) -> Domain | None:
    rows = entry.domain
    if rows is None:
        return None
    p = len(scale)
    triangle = np.zeros((p, p))
    try:
        for i, row in enumerate(rows):
            triangle[i, i:] = np.array(row.split(), dtype=np.float64)
        if not (np.abs(triangle) <= bounds.MOST).all():
            raise ValueError
    except (ValueError, IndexError) as error:
        raise IdentificationError(
            f"its domain is no triangle of {p} rows, of numbers up to {bounds.MOST:g}; fit a new "
            "one"
        ) from error
    inflation = None
    if entry.inflation is not msgspec.UNSET:
        inflation = np.where(library.moves, entry.inflation, 1.0)
    domain = Domain(triangle, scale, inflation=inflation)
    # One that has been nowhere would take every tick for new, and the leg would be blind.
    if not 0.5 * entry.rows < domain.rows < 2.0 * entry.rows:
        raise IdentificationError(
            f"its domain is of {domain.rows:.0f} rows, its model of {entry.rows}; fit a new one"
        )
    return domain


def _baseline(file: _File) -> Baseline:
    legs = {leg: _leg(leg, entry, file.library) for leg, entry in file.legs.items()}
    for leg, entry in file.legs.items():
        if entry.rows == 0:
            raise IdentificationError(f"leg '{leg}': fitted to 0 rows; fit a new one")
    tails = tuple(Tail(t.level, t.rate, t.scale, t.shape, t.ticks) for t in file.tails)
    return Baseline(file.robot, file.origin, file.quantum_rad, legs, tails, file.format)


def _convert_to_one_direction(baseline: Baseline) -> Baseline:
    """Convert statistics of noise in J directions to those of the one that counts now."""
    legs = {}
    for leg, known in baseline.legs.items():
        joints, peaks = len(known.noise.rms), known.peaks
        if peaks is not None:
            seen = 1.0 / np.maximum(peaks.ticks, 2)
            ratio = free_quantile(seen) / scipy.special.chdtri(joints, seen)
            peaks = Peaks(peaks.largest * ratio[:, None], peaks.ticks)
        legs[leg] = dataclasses.replace(known, peaks=peaks)
    tails = []
    for tail in baseline.tails:
        rates = tail.rate * np.array([1.0, 0.1])
        now, then = free_quantile(rates), scipy.special.chdtri(joints, rates)
        level, scale = now[0] / then[0], (now[1] - now[0]) / (then[1] - then[0])
        tails.append(
            dataclasses.replace(
                tail, level=float(tail.level * level), scale=float(tail.scale * scale)
            )
        )
    return dataclasses.replace(baseline, legs=legs, tails=tuple(tails), format=FORMAT)


def _leg(leg: str, entry: _LegFile, of: _LibraryFile) -> LegBaseline:
    library = leg_library_of(of, entry.joints, entry.axes)
    coefficients = np.zeros((library.size, len(library.joints)))
    row = {name: i for i, name in enumerate(library.names)}
    if not entry.terms.keys() <= set(library.joints):
        raise IdentificationError(f"leg '{leg}' has terms of other joints; fit a new one")
    for j, joint in enumerate(library.joints):
        for term, value in entry.terms.get(joint, {}).items():
            if term not in row:
                raise IdentificationError(
                    f"leg '{leg}' has a term '{term}' that the library "
                    f"'{library.name}' has not; fit a new one"
                )
            coefficients[row[term], j] = value
    joints = len(library.joints)
    covariances, counts = entry.covariance, entry.ticks
    # Without a noise after the turn, that is as of the descent.
    if len(covariances) == CONTEXTS - SPEEDS:
        covariances = [*covariances, *covariances[-SPEEDS:]]
    if len(counts) == CONTEXTS - SPEEDS:
        counts = [*counts, *[0.0] * SPEEDS]
    shape = (CONTEXTS, len(WINDOWS), joints, joints)
    covariance = _array(covariances, shape, f"leg '{leg}': covariance")
    ticks = _array(counts, (CONTEXTS,), f"leg '{leg}': ticks")
    if not ticks.sum() > 0:
        raise IdentificationError(f"leg '{leg}': ticks are none; fit a new one")
    scale = np.array([entry.scale.get(name, np.nan) for name in library.names])
    if not np.isfinite(scale).all():
        raise IdentificationError(f"leg '{leg}': a scale is missing; fit a new one")
    model, noise = LegModel(library, coefficients), NoiseModel(covariance, ticks)
    if not np.abs(noise.whiten).max() <= bounds.MOST_WHITEN:
        raise IdentificationError(f"leg '{leg}': covariance is too small; fit a new one")
    peaks = None
    if entry.peaks is not msgspec.UNSET and entry.peaks:
        largest = np.full((DIRECTIONS, len(WINDOWS)), np.nan)
        seen = [0] * DIRECTIONS
        for name, own in entry.peaks.items():
            at = _DIRECTIONS.index(name)
            largest[at] = _array(own.largest, (len(WINDOWS),), f"leg '{leg}': peaks")
            seen[at] = own.ticks
        peaks = Peaks(largest, tuple(seen))
    domain = _domain(entry, library, scale)
    return LegBaseline(model, noise, scale, entry.rows, domain, peaks=peaks)


def _array(values: object, shape: tuple[int, ...], what: str) -> Array:
    try:
        array = np.asarray(values, dtype=np.float64)
    except ValueError as error:
        raise IdentificationError(f"{what} is ragged; fit a new one") from error
    if array.shape != shape:
        raise IdentificationError(f"{what} has shape {array.shape}; expected {shape}")
    return array


def _brief(found: object) -> str:
    """Describe a value of a file in a word or two."""
    shown = type(found).__name__ if isinstance(found, (list, dict)) else repr(found)
    return shown if len(shown) <= _BRIEF else f"{shown[:_BRIEF]}…"
