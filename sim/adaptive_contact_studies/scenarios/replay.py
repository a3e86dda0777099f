"""A recording through several learners at once, and what they did, kept as arrays.

All variants see the same samples side by side.  Besides their events, each learner is asked how it
is at the end of every swing, and which ticks it took for free; these are held against the truth.
For the page of plots, one recording of a scenario is traced tick by tick.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.bank import LegGroup
from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model.model_file import dump_baseline
from adaptive_contact.score import Events
from adaptive_contact.wire import ContactEvent, Status
from adaptive_contact_sim.robots import ROBOTS
from adaptive_contact_studies.cache import (
    code_digest,
    learner_sources,
    name_of,
    read_arrays,
    sources_digest,
    write_arrays,
)
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.scenarios.learners import learner, reference_baseline
from adaptive_contact_studies.scenarios.recording import Recording, key_of
from adaptive_contact_studies.scenarios.spec import ReplaySpec, Variant

FORMAT: Final = 2
STATUSES: Final[tuple[Status, ...]] = get_args(Status)


class SwingLog(NamedTuple):
    """How a learner was at the first sample after each swing, (s,) each."""

    t_ns: Ints  # of that sample
    status: Ints  # position in `STATUSES`
    version: Ints  # of the model
    level: Array  # drift level
    kind: Ints  # of the change that is reported, position in `KINDS`; -1 for none
    residual_rad: Array  # root mean square of recent free residuals, mean over joints
    # swings, ticks: in the buffer
    swings: Ints
    ticks: Ints
    # promoted, refused, rolled_back: refits so far
    promoted: Ints
    refused: Ints
    rolled_back: Ints


class Trace(NamedTuple):
    """Everything a plot needs of one learner."""

    residual_rad: Array  # (n, J), NaN where nothing was predicted
    score: Array  # (n,) statistic over threshold, NaN where the tick was not judged
    # (n,) of a tick's squared distance, in the baseline's noise, NaN likewise: with level, tail and
    # the model's own uncertainty in it
    threshold: Array
    coefficients: Array  # (s, p, J) after each swing, of the terms in `names`
    names: NDArray[np.str_]  # (p,) terms


@dataclass(frozen=True, eq=False)
class LegReplay:
    """What one learner made of one leg."""

    events: Events  # in order
    log: SwingLog  # swing by swing
    confirmed: int  # ticks it took for free
    touched_ns: Ints  # those of them on which the leg touched something
    trace: Trace | None = None  # of the first leg of the traced recording


Replayed = dict[str, dict[Variant, LegReplay]]


class _Watch:
    """Looks at one learner while it goes along."""

    def __init__(
        self, leg: str, variant: Variant, spec: ReplaySpec, ticks: int, *, traced: bool
    ) -> None:
        self.leg, self.variant = leg, variant
        self.learner: ContactLearner = learner(
            leg, spec.baseline, variant, spec.recording.settings.robot
        )
        self.events: list[ContactEvent] = []
        self.confirmed: list[int] = []
        self._rows: list[tuple[Any, ...]] = []
        self._coefficients: list[Array] = []
        self._names: tuple[str, ...] = ()
        joints = len(self.learner.leg.joints)
        self._residual = np.full((ticks, joints), np.nan) if traced else None
        self._score = np.full(ticks, np.nan)
        self._threshold = np.full(ticks, np.nan)

    def tick(self, k: int) -> None:
        """After the learner has taken a tick in, if it is traced."""
        if self._residual is None or (judged := self.learner.judged()) is None:
            return
        self._residual[k] = judged.residual
        self._score[k] = np.nanmax(judged.scores)
        self._threshold[k] = judged.thresholds[0]

    def swing_over(self) -> None:
        """At the first sample after a swing."""
        status = self.learner.status
        self.confirmed.extend(self.learner.drain_confirmed())
        self._rows.append(
            (
                status.t_ns,
                STATUSES.index(status.status),
                status.model_version,
                status.drift.level,
                -1 if status.drift.kind is None else KINDS.index(status.drift.kind),
                float(np.mean(status.residual_rms)),
                status.buffer.swings,
                status.buffer.lift_ticks + status.buffer.descent_ticks,
                status.refits.promoted,
                status.refits.refused,
                status.refits.rolled_back,
            )
        )
        model = self.learner.model
        if self._residual is not None and model is not None:
            # A learner that found its model on the way has no terms before; they count as zero.
            self._names = model.library.names
            self._coefficients.append(model.coefficients.copy())

    def result(self, touching: Mask, t_ns: Ints) -> LegReplay:
        """All that was seen."""
        self.confirmed.extend(self.learner.drain_confirmed())
        columns = list(zip(*self._rows, strict=True)) or [()] * len(SwingLog._fields)
        log = SwingLog._make(
            np.array(column, dtype=np.float64 if name in _FLOATS else np.int64)
            for name, column in zip(SwingLog._fields, columns, strict=True)
        )
        confirmed = np.array(self.confirmed, dtype=np.int64)
        touched = confirmed[touching[np.searchsorted(t_ns, confirmed)]]
        trace = None
        if self._residual is not None:
            late = len(self._rows) - len(self._coefficients)
            shape = self._coefficients[0].shape if self._coefficients else (0, 0)
            known = [np.zeros(shape)] * late + self._coefficients
            coefficients = np.stack(known) if known else np.zeros((0, 0, 0))
            names = np.array(self._names)
            trace = Trace(self._residual, self._score, self._threshold, coefficients, names)
        return LegReplay(Events.of(self.events), log, len(confirmed), touched, trace)


def replay(spec: ReplaySpec, recording: Recording) -> Replayed:
    """Feed a recording to new learners, all legs and variants of a tick at once.

    Returns:
        By leg and variant, what came of it.
    """
    legs = spec.recording.legs
    ticks = len(recording.t_ns)
    streams = [samples_of(recording, leg) for leg in legs]
    swings = [recording.legs[leg].swing for leg in legs]
    # The page shows one leg; to trace them all would take as long as the learners do.
    watches = [
        (i, _Watch(leg, variant, spec, ticks, traced=spec.trace and i == 0))
        for i, leg in enumerate(legs)
        for variant in spec.variants
    ]
    team = LegGroup([watch.learner for _, watch in watches])
    for k, samples in enumerate(zip(*streams, strict=True)):
        decided = team.advance([samples[i] for i, _ in watches])
        over = [k > 0 and bool(s[k - 1]) and not s[k] for s in swings]
        for (i, watch), event in zip(watches, decided, strict=True):
            if event is not None:
                watch.events.append(event)
            if spec.trace:
                watch.tick(k)
            if over[i]:
                watch.swing_over()
    touching = [recording.touching(leg) for leg in legs]
    result: Replayed = {leg: {} for leg in legs}
    for i, watch in watches:
        result[watch.leg][watch.variant] = watch.result(touching[i], recording.t_ns)
    return result


def save_replay(replayed: Replayed, path: Path) -> None:
    """Write a replay, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    arrays: dict[str, NDArray[Any]] = {}
    for leg, variants in replayed.items():
        for variant, of in variants.items():
            own = f"{leg}.{variant}."
            arrays |= {f"{own}event.{n}": v for n, v in of.events._asdict().items()}
            arrays |= {f"{own}log.{n}": v for n, v in of.log._asdict().items()}
            arrays |= {f"{own}confirmed": np.array(of.confirmed), f"{own}touched": of.touched_ns}
            if of.trace is not None:
                arrays |= {f"{own}trace.{n}": _small(v) for n, v in of.trace._asdict().items()}
    write_arrays(path, arrays)


def load_replay(spec: ReplaySpec, path: Path) -> Replayed | None:
    """Read a replay; None where there is none, or none that can be read."""
    arrays = read_arrays(path)
    if arrays is None:
        return None
    try:
        return {
            leg: {variant: _leg_replay(arrays, f"{leg}.{variant}.") for variant in spec.variants}
            for leg in spec.recording.legs
        }
    except KeyError:
        return None


def replay_file(spec: ReplaySpec, folder: Path) -> Path:
    """Where a replay lives: named by all that decides it, the learner's own source included."""
    seen = (spec.baseline, spec.variants, spec.trace)
    name = name_of(FORMAT, learner_fingerprint(), key_of(spec.recording), *seen)
    return folder / f"{name}.npz"


@functools.cache
def learner_fingerprint() -> str:
    """Hash of the learner's source, of this module's, and of the shipped baselines."""
    digest = sources_digest(learner_sources())
    own = Path(__file__).read_text(encoding="utf-8")
    digest.update(code_digest(own, imports=False).encode())
    for name in ROBOTS:
        digest.update(dump_baseline(reference_baseline(name)).encode())
    return digest.hexdigest()[:16]


_FLOATS: Final = ("level", "residual_rad")


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Single precision is plenty for a plot."""
    return values.astype(np.float32) if values.dtype == np.float64 else values


def _leg_replay(arrays: Mapping[str, NDArray[Any]], own: str) -> LegReplay:
    trace = None
    if f"{own}trace.score" in arrays:
        trace = Trace._make(arrays[f"{own}trace.{name}"] for name in Trace._fields)
    return LegReplay(
        events=Events._make(arrays[f"{own}event.{name}"] for name in Events._fields),
        log=SwingLog._make(arrays[f"{own}log.{name}"] for name in SwingLog._fields),
        confirmed=int(arrays[f"{own}confirmed"]),
        touched_ns=arrays[f"{own}touched"],
        trace=trace,
    )
