"""Decides which model a leg begins with: a baseline, its own first swings, or a saved state.

The leg's own first swings are used where there is no baseline, or an unfit one.  From then on an
adapter keeps the model up to date; it is made here and nowhere else.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive_contact.errors import BaselineError
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.learn.adapter import Adapter
from adaptive_contact.learn.cold_start import ColdStart, prior_tails
from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.learn.noise_tracker import NoiseTracker
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.library import Library, leg_library, with_changes
from adaptive_contact.model.model_file import Baseline, LegBaseline, leg_of_tree, leg_tree
from adaptive_contact.model.tail import Tail
from adaptive_contact.robot import AngleFrame, Leg, Robot
from adaptive_contact.wire import ServoSample

__all__ = ["Lifecycle", "ready_for_changes"]

Array = NDArray[np.float64]

# What a servo half as stiff does otherwise in a tick, over the noise: 5 to 7, walking and in pose.
SOFT_NOISES: Final = 5.0


class Lifecycle:
    """Makes and replaces the adapter of one leg.

    Args:
        robot: the robot's description.
        leg: of it.
        baseline: what is known of its free motion, None for nothing.
        mode: how changes of the leg are followed.
        refitter: does the sparse refits, and first fits.

    Attributes:
        adapter, recent: keep the model, covariances and thresholds; None while there is no model.
        begun: raised whenever another adapter takes over, or none does.
        cold: collects samples for a first model, None where there is one or none is wanted.
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
        self._baseline = baseline
        self._mode = mode
        self._refitter = refitter
        # The last snapshot, made or taken over, until it is gone back to.
        self._saved: dict[str, Any] | None = None
        self.begun = 0
        self.start()

    def start(self) -> None:
        """Begin as if nothing had been learned: from the baseline, or cold."""
        baseline = self._baseline
        self.recent: NoiseTracker | None = None
        self.adapter: Adapter | None = None
        self.begun += 1
        self.cold: ColdStart | None = None
        self.origin = None if baseline is None else baseline.origin
        self.note: str | None = None
        self._started_cold = self._unfit = False
        self._known = self._choose(baseline)
        if self._known is not None:
            assert baseline is not None
            self._begin(self._known, baseline.tails)
        elif self._mode is not LearnerMode.FROZEN:
            self._start_cold()

    @property
    def library(self) -> Library:
        """Library of the model, or of the first one that a leg without will get."""
        if self.adapter is not None:
            return self.adapter.model.library
        plain = leg_library(self._robot, self._leg)
        return with_changes(plain, np.zeros((plain.size, len(plain.joints))))

    @property
    def sigma(self) -> Array:
        """(J,) rad, deviation of the residuals of the model at its start."""
        assert self._known is not None
        return self._known.noise.rms

    @property
    def noise_floor(self) -> list[float]:
        """(J,) rad, root mean square residual of the model at its start; zeros without one."""
        if self._known is None:
            return [0.0] * len(self._leg.joints)
        floor: list[float] = self._known.noise.rms.tolist()
        return floor

    def collect(self, sample: ServoSample, *, swing: bool, broken: bool, off: int) -> None:
        """Collect a sample for a first model, where one is wanted.

        Args:
            sample: accepted.
            swing: the leg is in one.
            broken: it does not connect to the one before.
            off: ticks that have shown another length than the robot's, 0 where they have not.
        """
        if self.cold is None:
            return
        if off:
            self.cold.drop_newest(off)
            return
        if broken:
            self.cold.interrupt()
        sound = sample.valid is None or all(sample.valid)
        self.cold.add(sample.measured, sample.desired, swing=swing, sound=sound)

    def try_cold(self) -> None:
        """Submit a first fit when it is time, and take its result when it is there."""
        if self.cold is None:
            return
        result = self.cold.poll(self._refitter)
        if result is None:
            return
        self.note = result.reason
        if result.known is not None:
            self.origin = f"cold start: {result.reason}"
            self._begin(result.known, self._prior_tails(), version=1)
            self.cold, self._started_cold = None, True

    def forget(self) -> None:
        """Start cold: the baseline was never this leg's."""
        self._known = self.adapter = self.recent = None
        self.begun += 1
        self.origin = None
        self._started_cold, self._unfit = False, True
        self.note = "the baseline does not fit this leg: fitting a new model"
        self._start_cold()

    @property
    def note_now(self) -> str | None:
        """The note, with how many swings a leg without a model has of those it needs."""
        if self.cold is None or self.note is None:
            return self.note
        return f"{self.note} ({self.cold.progress})"

    def snapshot(self) -> dict[str, Any]:
        """Return what has been learned, as a tree that msgpack can write.

        Without a model that is what became of the baseline; the swings of a cold start are not
        kept, as the next twenty bring as much.
        """
        if self.adapter is None:
            self._saved = {"unfit": self._unfit, **self._frame}
            return self._saved
        tree: dict[str, Any] = {"follower": self.adapter.snapshot(), **self._frame}
        if self._started_cold:  # no file holds what it started from
            assert self._known is not None
            tree["start"] = {"known": leg_tree(self._known), "origin": self.origin}
        self._saved = tree
        return tree

    def restore_last_good(self) -> None:
        """Restore the last snapshot; the start, if that snapshot was restored before.

        What a snapshot is refused for leaves the leg as it starts.
        """
        saved, self._saved = self._saved, None
        self.start()
        if saved is not None:
            self._take(saved)

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        problem = self._take(saved)
        if problem is None:
            self._saved = saved
        return problem

    # -- private -------------------------------------------------------------------------------

    def _take(self, saved: dict[str, Any]) -> str | None:
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
        if isinstance(saved.get("unfit"), bool):
            if saved["unfit"] and self.adapter is not None:
                self.forget()
            return None
        inner, start = saved.get("follower"), saved.get("start")
        if not isinstance(inner, dict):
            return self._refused("it holds no model")
        if start is not None:
            refused = self._restore_cold(inner, start)
        elif self.adapter is None:
            return self._refused("there is no baseline to go with it")
        else:
            refused = self.adapter.restore(inner)
        return refused

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

    def _begin(self, known: LegBaseline, tails: tuple[Tail, ...], version: int = 0) -> None:
        """Detect and follow from here on."""
        robot, leg = self._robot, self._leg
        model = dataclasses.replace(known.model, version=version)
        known = dataclasses.replace(known, model=model)
        self._known, self.note = known, None
        known = ready_for_changes(known)
        aim = robot.detector.false_alarms_per_hour
        recent = NoiseTracker(known.noise, tails, aim, known.domain)
        self.recent, self.begun = recent, self.begun + 1
        first = version > 0  # no file's: from a few swings
        self.adapter = Adapter(leg.id, known, recent, self._mode, self._refitter, provisional=first)

    def _start_cold(self) -> None:
        library = leg_library(self._robot, self._leg)
        self.cold = ColdStart(self._leg, library, self._robot.quantum(self._leg.id))

    def _prior_tails(self) -> tuple[Tail, ...]:
        return prior_tails(len(self._leg.joints))

    def _restore_cold(self, inner: dict[str, Any], start: object) -> str | None:
        """Take over what a leg started cold had found, and what it learned since."""
        if self._mode is LearnerMode.FROZEN:
            return self._refused("a frozen learner starts from files")
        of_start = start if isinstance(start, dict) else {}
        try:
            known = leg_of_tree(of_start.get("known"), leg_library(self._robot, self._leg))
        except BaselineError as problem:
            return self._refused(str(problem))
        before = (self._known, self.note, self.recent, self.adapter)
        self._begin(known, self._prior_tails(), version=1)
        assert self.adapter is not None
        refused = self.adapter.restore(inner)
        if refused is not None:
            self._known, self.note, self.recent, self.adapter = before
            self.begun += 1
            return refused
        self.cold, self._started_cold = None, True
        origin = of_start.get("origin")
        self.origin = origin if isinstance(origin, str) else "cold start"
        return None

    def _refused(self, why: str) -> str:
        return f"snapshot of leg '{self._leg.id}' not used: {why}"


def ready_for_changes(known: LegBaseline) -> LegBaseline:
    """Add to a leg's baseline the terms of what may happen to it (decision 21), with zeros.

    Args:
        known: of q terms.

    Returns:
        The same with (q + added, J) coefficients, scales of all terms, and a domain that says
        nothing of the added ones.
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
        domain=known.domain and dataclasses.replace(known.domain, beyond=added),
    )
