"""The detectors that are compared, on the same streams.

Models are learned from the training streams of each leg-run; noise, tails, the lag of the tracking
error, the joints a rule looks at and the observer's gains are chosen on tuning streams.  The
default detector learns from both, as its own cross-validation keeps them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints, Mask
from adaptive_contact.fit.train import swing_ticks
from adaptive_contact.model import LegModel
from adaptive_contact.model.noise import NoiseModel
from adaptive_contact.robot import ROBOT_HOUR_TICKS, Robot
from adaptive_contact.robot.gait_phase import directions
from adaptive_contact.score import find_swings, match, summarise
from adaptive_contact_studies.evaluate import leg_stream
from adaptive_contact_studies.paper.analytical import Gains, NominalLeg, predict
from adaptive_contact_studies.paper.comparison_rules import (
    Calibration,
    Motion,
    Prediction,
    alarms,
    calibrate,
    learn_noise,
    likelihood_ratio,
    paper_rule,
    position_difference,
    tracking_error,
)
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.rows import predictions

# Lags of the tracking error that are tried, ticks.
_LAGS: Final = range(7)
JOINTS: Final = 3


class LegModels(NamedTuple):
    """The fitted models of one leg-run."""

    servo: LegModel
    paper: LegModel


@dataclass(frozen=True, eq=False)
class Evidence:
    """One stream with every model's predictions."""

    stream: Stream  # what was recorded
    motion: Motion  # what detectors see
    predictions: dict[str, Prediction]  # by model, `servo`, `paper`, `analytical`
    swing_of_tick: Ints  # (n,) number of the swing, -1 in stance

    @property
    def descending(self) -> Mask:
        """(n,) whether the command in force is past the lift."""
        falling = np.roll(self.motion.direction, 1) == 1
        return np.asarray(falling & self.motion.judged)

    @property
    def free(self) -> Mask:
        """(n,) judged ticks that no contact is near."""
        return self.motion.judged & self.stream.stretch.free


def evidence_of(
    robot: Robot, streams: Sequence[Stream], models: Mapping[str, LegModels], gains: Gains
) -> list[Evidence]:
    """Predict whole streams with every model."""
    observed = predict(NominalLeg.of(), [(s.measured, s.desired) for s in streams], gains)
    found = []
    for stream, rollout in zip(streams, observed, strict=True):
        leg = robot.leg(stream.leg)
        fitted = models[stream.piece.leg_run.name]
        found.append(
            Evidence(
                stream,
                Motion(
                    stream.measured,
                    stream.desired,
                    swing_ticks(stream.swing),
                    directions(stream.desired, leg),
                ),
                {
                    name: Prediction.of(stream.measured, predicted)
                    for name, predicted in (
                        ("servo", predictions(fitted.servo, stream.measured, stream.desired)),
                        ("paper", predictions(fitted.paper, stream.measured, stream.desired)),
                        ("analytical", rollout),
                    )
                },
                find_swings(stream.run.t_ns, stream.swing).of_tick,
            )
        )
    return found


@dataclass(frozen=True, eq=False)
class Bench:
    """All that the compared detectors learned besides their models."""

    lag: int  # of the tracking error, ticks
    noise: dict[str, dict[str, NoiseModel]]  # by model, then by leg-run's name
    calibrations: dict[str, Calibration]  # by detector
    quantum_rad: float  # position step
    aim_per_hour: float  # false alarms per robot-hour, the target rate of thresholds
    # what tuning found, for the report: recall on the tuning collisions by detector
    tuned: dict[str, float]

    def statistic(self, detector: str, evidence: Evidence) -> Array:
        """(n, channels) of a detector; NaN where it says nothing."""
        return DETECTORS[detector].statistic(self, evidence)

    def score(self, detector: str, evidence: Evidence) -> Array:
        """(n,) over the target rate's threshold; NaN on ticks that are not judged."""
        values = self.calibrations[detector].score(
            self.statistic(detector, evidence), self.aim_per_hour / ROBOT_HOUR_TICKS
        )
        return np.where(evidence.motion.judged, values, np.nan)


@dataclass(frozen=True)
class Detector:
    """One detector that is compared."""

    title: str  # for tables
    statistic: Callable[[Bench, Evidence], Array]  # of a stream, (n, channels)
    joints: bool  # whether channels are joints, of which a rule may use some


def _ratio(model: str) -> Callable[[Bench, Evidence], Array]:
    def statistic(bench: Bench, evidence: Evidence) -> Array:
        noise = bench.noise[model][evidence.stream.piece.leg_run.name]
        prediction = evidence.predictions[model]
        return likelihood_ratio(evidence.motion, prediction, noise, bench.quantum_rad)

    return statistic


def _rule(model: str) -> Callable[[Bench, Evidence], Array]:
    return lambda _, evidence: paper_rule(evidence.predictions[model])


# The detectors that learn as they go, the default and the ungated one, are played sample by sample
# (evaluation.py).
DETECTORS: Final[dict[str, Detector]] = {
    "servo ratio": Detector("servo law, likelihood ratio (frozen)", _ratio("servo"), False),
    "servo rule": Detector("servo law, paper's rule", _rule("servo"), True),
    "paper ratio": Detector("paper's library, likelihood ratio", _ratio("paper"), False),
    "paper rule": Detector("the paper: its library, its rule", _rule("paper"), True),
    "analytical ratio": Detector(
        "analytical model (tuned observer), likelihood ratio", _ratio("analytical"), False
    ),
    "analytical rule": Detector(
        "analytical model (tuned observer), paper's rule", _rule("analytical"), True
    ),
    "tracking": Detector(
        "tracking error", lambda bench, e: tracking_error(e.motion, bench.lag), True
    ),
    "naive": Detector("naive difference", lambda _, e: position_difference(e.motion), True),
}


def tune_bench(
    robot: Robot, free: Sequence[Evidence], touch: Sequence[Evidence], aim_per_hour: float
) -> Bench:
    """Choose lag, noise, tails and joints on tuning streams.

    Args:
        robot: whose legs they are.
        free: without contacts, of every leg-run.
        touch: with contacts.
        aim_per_hour: false alarms per robot-hour.

    Raises:
        IdentificationError: too few ticks.
    """
    errors = [_rms([tracking_error(e.motion, lag)[e.free] for e in free]) for lag in _LAGS]
    noise: dict[str, dict[str, NoiseModel]] = {"servo": {}, "paper": {}, "analytical": {}}
    names = list(dict.fromkeys(e.stream.piece.leg_run.name for e in free))
    for model, known in noise.items():
        for name in names:
            own = [e for e in free if e.stream.piece.leg_run.name == name]
            known[name] = _joined_noise(own, model, robot.quantum_rad)
    bench = Bench(int(np.argmin(errors)), noise, {}, robot.quantum_rad, aim_per_hour, {})
    truths = [leg_stream(e.stream.run, e.stream.leg, robot) for e in touch]
    for name, detector in DETECTORS.items():
        whole = calibrate([detector.statistic(bench, e)[e.free] for e in free])
        bench.calibrations[name] = whole
        subsets: list[tuple[int, ...]] = [whole.channels]
        if detector.joints:
            subsets = [c for n in range(1, JOINTS + 1) for c in combinations(range(JOINTS), n)]
        best = -1.0
        for channels in subsets:
            bench.calibrations[name] = replace(whole, channels=channels)
            outcomes = [
                match(
                    truth,
                    alarms(truth.t_ns, bench.score(name, e), e.swing_of_tick, 1.0, e.descending),
                )
                for truth, e in zip(truths, touch, strict=True)
            ]
            recall = summarise(outcomes).counted.recall or 0.0
            if recall > best:
                best, kept = recall, bench.calibrations[name]
        bench.calibrations[name] = kept
        bench.tuned[name] = best
    return bench


def _joined_noise(parts: Sequence[Evidence], model: str, quantum_rad: float) -> NoiseModel:
    """Noise of one leg-run over several streams, put end to end.

    Streams end in a hold, which is stance: no window reaches over a joint.
    """
    motion = Motion(*map(np.concatenate, zip(*(p.motion for p in parts), strict=True)))
    residuals = zip(*(p.predictions[model] for p in parts), strict=True)
    free = np.concatenate([p.free for p in parts])
    return learn_noise(motion, Prediction(*map(np.concatenate, residuals)), free, quantum_rad)


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.nanmean(np.square(np.concatenate(parts)))))
