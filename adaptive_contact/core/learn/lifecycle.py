"""Decides which model a leg begins with: a baseline, what is known of any leg, or a saved state.

A refit that finds another slope of the servos' law, or a larger noise than the prior's, makes
another beginning (:meth:`adopt_refit`).

What is known of any leg is used where there is no baseline, or an unfit one.  From then on an
adapter keeps the model up to date; it is made here and nowhere else.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Final

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.core.learn.adapter import Adapter
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.core.learn.noise_tracker import NoiseTracker
from adaptive_contact.core.learn.state import ImplausibleError, array_of, pack
from adaptive_contact.fit.refit_job import SLOPE_RANGE, Refitter
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.leg_prior import leg_prior, prior_noise, prior_tails
from adaptive_contact.model.library import Library, leg_library, with_changes
from adaptive_contact.model.model_file import Baseline, LegBaseline
from adaptive_contact.model.tail import Tail
from adaptive_contact.robot import AngleFrame, Leg, Robot

# A prior that does not fit a leg is widened so many times, and again, up to the most.
WIDER: Final = 3.0
WIDEST: Final = 9.0
# What a servo half as stiff does otherwise in a tick, over the noise: 5 to 7, walking and in pose.
SOFT_NOISES: Final = 5.0


class Lifecycle:
    """Makes and replaces the adapter of one leg.

    Args:
        robot: the robot's description.
        leg: of it.
        baseline: what is known of its free motion, None for nothing.
        mode: how changes of the leg are followed.
        refitter: does the sparse refits.

    Attributes:
        adapter: keeps the model; None while there is none.
        begun: raised whenever another adapter takes over, or none does.
        origin: how the model began, for people.
        note: what is wrong with what is known, None when nothing is.
    """

    def __init__(
        self,
        robot: Robot,
        leg: Leg,
        baseline: Baseline | None,
        mode: LearnerMode,
        refitter: Refitter,
    ) -> None:
        self._robot = robot
        self._leg = leg
        self._baseline = None if baseline is None else baseline.today()
        self._mode = mode
        self._refitter = refitter
        # The last snapshot, made or taken over, until it is gone back to.
        self._saved: dict[str, Any] | None = None
        self.begun = 0
        self.start()

    def start(self) -> None:
        """Begin as if nothing had been learned: from the baseline, or from a prior."""
        baseline = self._baseline
        self.adapter: Adapter | None = None
        self.begun += 1
        self.origin = None if baseline is None else baseline.origin
        self.note: str | None = None
        self._widening = 0.0  # factor on the prior's spread; 0 for a leg with a baseline
        self._unfit = False
        self._found: LegModel | None = None  # of another slope than described, as it was found
        self._start = self._choose(baseline)
        if self._start is not None:
            assert baseline is not None
            self._begin(self._start, baseline.tails)
        elif self._mode is LearnerMode.FULL:
            self._begin_prior(1.0)

    @property
    def library(self) -> Library:
        """Library of the model, or the one that a leg without a model would get."""
        if self.adapter is not None:
            return self.adapter.baseline.library
        plain = leg_library(self._robot, self._leg)
        return with_changes(plain, np.zeros((plain.size, len(plain.joints))))

    @property
    def noise_tracker(self) -> NoiseTracker | None:
        """Keeps covariances and thresholds; None while there is no model."""
        return None if self.adapter is None else self.adapter.noise_tracker

    @property
    def sigma(self) -> Array:
        """(J,) rad, deviation of the residuals of the model at its start."""
        assert self._start is not None
        return self._start.noise.rms

    @property
    def noise_floor(self) -> list[float]:
        """(J,) rad, root mean square residual of the model at its start; zeros without one."""
        if self._start is None:
            return [0.0] * len(self._leg.joints)
        floor: list[float] = self._start.noise.rms.tolist()
        return floor

    def forget(self) -> None:
        """Start again from a prior, or a wider one: the first model was of another leg."""
        if self._mode is LearnerMode.FROZEN:
            self._start = self.adapter = None
            self.begun += 1
            self.note = "the baseline does not fit this leg: fit a new one"
            return
        self._unfit = self._unfit or not self._widening
        self._begin_prior(min(self._widening * WIDER, WIDEST) if self._widening else 1.0)

    def begin_again(self) -> bool:
        """Start again from a prior if the model is of another leg, by its lifts or its descents.

        A leg with a baseline that only comes down differently keeps it: a new fit is better.
        """
        adapter = self.adapter
        if adapter is None:
            return False
        comes_down = adapter.early.refuted and 0.0 < self._widening < WIDEST
        if adapter.monitor.unfit or comes_down:
            self.forget()
            return True
        return False

    def adopt_refit(self, start: LegBaseline) -> None:
        """Adopt the model of a refit, with a slope and a noise of its own."""
        before = self.adapter
        self._begin_found(start)
        if before is not None and self.adapter is not None:
            self.adapter.go_on_from(before)

    @property
    def note_now(self) -> str | None:
        """The note, with how many swings a leg has of those it needs to be known."""
        first = None if self.adapter is None else self.adapter.first
        if not self._widening or self.note is None:
            return self.note
        return None if first is None else f"{self.note} ({first.progress})"

    def snapshot(self) -> dict[str, Any]:
        """Return what has been learned, as a tree that msgpack can write."""
        tree: dict[str, Any] = {"unfit": self._unfit, "widening": self._widening, **self._frame}
        if self._found is not None:
            slope = self._found.library.slope_rad
            first, noise = pack(self._found.coefficients), self.sigma.tolist()
            tree["found"] = {"slope_rad": slope, "first": first, "noise_rad": noise}
        if self.adapter is not None:
            tree["follower"] = self.adapter.snapshot()
        self._saved = tree
        return tree

    def restore_last_good(self) -> None:
        """Restore the last snapshot; the start, if that snapshot was restored before.

        What a snapshot is refused for leaves the leg as it starts.
        """
        saved, self._saved = self._saved, None
        self.start()
        if saved is not None:
            self._restore_or_start(saved)

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        problem = self._restore_or_start(saved)
        if problem is None:
            self._saved = saved
        return problem

    # -- private -------------------------------------------------------------------------------

    def _restore_or_start(self, saved: dict[str, Any]) -> str | None:
        try:
            return self._restore(saved)
        except Exception as fault:  # whatever a file holds, the leg must go on without it
            self.start()
            return self._refused(f"{type(fault).__name__}: {fault}")

    @property
    def _frame(self) -> dict[str, Any]:
        """How the wire's angles are turned, where they are; what is learned holds for no other."""
        frame = AngleFrame(self._leg)
        if frame.same:
            return {}
        return {"angles": [list(frame.directions), list(frame.offsets_rad)]}

    def _restore(self, saved: dict[str, Any]) -> str | None:
        if saved.get("angles") != self._frame.get("angles"):
            return self._refused("robot.toml had other [leg.angles] when it was learned")
        inner, widening = saved.get("follower"), saved.get("widening", 0.0)
        if "start" in saved:
            return self._refused("it began without a baseline, in an older version")
        if saved.get("unfit") is True and not self._unfit and self.adapter is not None:
            self.forget()
        if self._widening and widening > self._widening:
            self._begin_prior(min(widening, WIDEST))
        if isinstance(saved.get("found"), dict):
            self._restore_found(saved["found"])
        if not isinstance(inner, dict):  # there was no model
            return None if isinstance(saved.get("unfit"), bool) else self._refused("it is no state")
        if self.adapter is None:
            return self._refused("there is no baseline to go with it")
        return self.adapter.restore(inner)

    def _restore_found(self, saved: dict[str, Any]) -> None:
        """Begin with a slope that was found before.

        Raises:
            ImplausibleError: it is none.
        """
        slope = saved.get("slope_rad")
        if not (isinstance(slope, float) and SLOPE_RANGE[0] <= slope <= SLOPE_RANGE[1]):
            raise ImplausibleError(f"its slope is {slope!r}")
        plain = dataclasses.replace(leg_library(self._robot, self._leg), slope_rad=slope)
        start = leg_prior(plain, self._robot.quantum(self._leg.id))
        first = array_of(saved.get("first"), start.model.coefficients.shape, "its first model")
        rms = saved.get("noise_rad", start.noise.rms.tolist())
        of_each = isinstance(rms, list) and len(rms) == len(self._leg.joints)
        if not (of_each and all(isinstance(of, float) and 0.0 < of < math.inf for of in rms)):
            raise ImplausibleError(f"its noise is {rms!r}")
        model, noise = start.model.moved(first, 1), prior_noise(np.array(rms))
        self._begin_found(dataclasses.replace(start, model=model, noise=noise))

    def _begin_found(self, start: LegBaseline) -> None:
        self._begin(start, prior_tails())
        self._found, self._widening = start.model, max(self._widening, 1.0)
        self.origin = f"a refit, with slope_rad = {start.model.library.slope_rad:.3g}"

    def _choose(self, baseline: Baseline | None) -> LegBaseline | None:
        if baseline is None:
            self.note = "no baseline: learning from the swings as they come"
            return None
        known = baseline.legs.get(self._leg.id)
        if known is None:
            self.note = f"the baseline has no leg '{self._leg.id}': fit one that has"
            return None
        self.note = None
        return known

    def _begin(self, start: LegBaseline, tails: tuple[Tail, ...]) -> None:
        """Detect and follow from here on."""
        robot = self._robot
        # A prior's spread is megabytes of a leg of many joints, and only the adapter needs it.
        self._start, self.note = dataclasses.replace(start, spread=None), None
        start = ready_for_changes(start)
        aim = robot.detector.false_alarms_per_hour
        noise_tracker = NoiseTracker(start.noise, tails, aim, start.peaks)
        self.begun += 1
        quantum_rad = robot.quantum(self._leg.id)
        self.adapter = Adapter(
            self._leg.id, start, noise_tracker, self._mode, self._refitter, quantum_rad
        )

    def _begin_prior(self, widening: float) -> None:
        """Detect and learn from what is known of any leg."""
        robot, leg, note = self._robot, self._leg, self.note
        if widening > 1.0:
            note = (
                f"no leg that is known moves like this one: the prior is {widening:.0f} times wider"
            )
        elif self._unfit:
            note = "the baseline does not fit this leg: learning a new model"
        start = leg_prior(leg_library(robot, leg), robot.quantum(leg.id), widening)
        self._begin(start, prior_tails())
        self._widening, self.note, self.origin = widening, note, "what is known of any leg"
        self._found = None

    def _refused(self, why: str) -> str:
        return f"snapshot of leg '{self._leg.id}' not used: {why}"


def ready_for_changes(known: LegBaseline) -> LegBaseline:
    """Add to a leg's baseline the terms of what may happen to it (decision 21), with zeros.

    Args:
        known: of q terms.

    Returns:
        The same with (q + added, J) coefficients, scales of all terms, and a domain and a spread
        that say nothing of the added ones.
    """
    model = known.model
    library = with_changes(model.library, model.coefficients)
    added = library.size - len(known.scale)
    joints = len(library.joints)
    scale = np.ones(added)  # friction saturates at 1
    if library.knows_law:
        scale[-joints:] = SOFT_NOISES * known.noise.rms
    return dataclasses.replace(
        known,
        model=LegModel(library, np.pad(model.coefficients, ((0, added), (0, 0))), model.version),
        scale=np.concatenate([known.scale, scale]),
        spread=None if known.spread is None else np.pad(known.spread, ((0, 0), (0, 0), (0, added))),
        domain=known.domain and dataclasses.replace(known.domain, beyond=added),
    )
