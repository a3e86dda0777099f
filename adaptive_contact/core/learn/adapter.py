"""Follows one leg's model: recursion, refits, return to what was known.

Two ways lead back to an older model.  One kept as a swing began takes the place of a model that no
servo can have, and of one that a false source has taught.  The baseline takes the place of a model
where it fits again.

When the drift monitor finds that the leg has changed, the covariance of the recursion is inflated
along the ways in which legs change, and the lifts are learned at once.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any, Final, NamedTuple

from adaptive_contact.core.learn.active_model import RETURN_SWINGS, ActiveModel, FirstSwings, Good
from adaptive_contact.core.learn.change_classifier import ChangeClassifier
from adaptive_contact.core.learn.drift import DriftMonitor, EarlyContacts
from adaptive_contact.core.learn.mode import LearnerMode
from adaptive_contact.core.learn.noise_tracker import NoiseTracker
from adaptive_contact.core.learn.periodic_refit import PeriodicRefit, rows_for_refit
from adaptive_contact.core.learn.replay_buffer import ReplayBuffer
from adaptive_contact.core.learn.state import (
    FORMAT,
    ImplausibleError,
    library_key,
    read_state,
    segment_of,
)
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.model.bounds import is_count
from adaptive_contact.model.free_motion import FreeMotion
from adaptive_contact.model.labelled_swing import NO_ROWS, Label, LabelledSwing, Rows
from adaptive_contact.model.leg_model import LegModel
from adaptive_contact.model.model_file import LegBaseline
from adaptive_contact.wire import Doubt, RefitCounts, Status

# Rows that may wait while nothing has changed: those of one long swing.
CALM_QUEUE: Final = 24
# Confirmed ticks whose times are kept for `drain_confirmed`: some 150 swings.
CONFIRMED_TICKS: Final = 2048
# A variance scale up to this counts as 1 for a leg that has not changed; from twice as far on it
# counts in full.
STRAY: Final = 1.2
STEEP: Final = 2.0
# Covariances and thresholds are recomputed after so many swings.
REFRESH_SWINGS: Final = 4

# Swings that can be taken back: a false source is found within three.
KEPT_SWINGS: Final = 6


class _Kept(NamedTuple):
    """Holds what was known of a leg as a swing began."""

    t_ns: int
    era: int
    good: Good
    parts: tuple[dict[str, Any] | None, ...]  # of what follows the leg


class EventStatus(NamedTuple):
    """Holds status, doubt and version of a leg, for its events."""

    # learning where a leg has no model, or began with a prior and is not known yet
    status: Status = "learning"
    doubt: Doubt | None = None  # why the leg is ambiguous; None where it is not
    version: int = 0  # of the model in force


class Adapter:
    """Adapts one leg's model: routes labelled swings to drift, recursion, buffer and refits.

    Args:
        leg: its id.
        start: what the leg begins with, the baseline or a prior.
        noise_tracker: covariances and thresholds, which it keeps up to date.
        mode: what it may do.
        refitter: does the sparse refits.
        quantum_rad: position step.

    Attributes:
        learning: whether it does anything at all.
        baseline: the model as the leg was first known.
        active: the model in force, with its recursion.
        refit: sparse refits, requested and judged.
        found: what a refit has found to go on from with another adapter.
        monitor: whether the lifts fit.
        early: touches reported at the top of swings.
        buffer: confirmed rows.
        noise_tracker: covariances and thresholds.
        first: progress of a leg that began with a prior; None once it is known.
    """

    def __init__(
        self,
        leg: str,
        start: LegBaseline,
        noise_tracker: NoiseTracker,
        mode: LearnerMode,
        refitter: Refitter,
        quantum_rad: float,
    ) -> None:
        self.learning = mode is not LearnerMode.FROZEN
        self.baseline = start.model
        self.monitor = DriftMonitor(len(start.noise.rms), known=start.spread is None)
        self.early = EarlyContacts()
        self.buffer = ReplayBuffer(rows=rows_for_refit(start.model))
        self.noise_tracker = noise_tracker
        self.confirmed_ns: deque[int] = deque(maxlen=CONFIRMED_TICKS)
        self._leg = leg
        self._noise = start.noise.rms
        self._scale = start.scale
        self.active = ActiveModel(start)
        self.first = None if start.spread is None else FirstSwings()
        self._suspected = NO_ROWS  # the descent after a suspected lift
        self._evidence: ChangeClassifier | None = None  # of the newest change
        self._era = 0
        self._swings = 0  # since covariances were recomputed
        self._learned_swing = False
        self._kept = deque[_Kept](maxlen=KEPT_SWINGS)
        prior_rms = None if start.spread is None else start.noise.rms
        self.refit = PeriodicRefit(leg, start.model.library, quantum_rad, refitter, prior_rms)
        self._domain = start.domain
        self.found: LegBaseline | None = None

    # -- what detection and status read -----------------------------------------------------------

    @property
    def model(self) -> LegModel:
        """Model in force."""
        return self.active.model

    @property
    def changed(self) -> bool:
        """Whether the leg may differ from its model: begun with a prior, or by its lifts."""
        return self.active.inflated or self.variance_in_force > 1.0

    @property
    def variance_in_force(self) -> float:
        """Variance scale by which this swing is judged.

        That of a leg that has not changed strays by a tenth of itself; as it is not followed below
        the baseline's, what it strays upwards would make the detector duller on average.
        """
        level = self.monitor.variance_in_force
        if self.active.inflated or not 1.0 < level < STEEP * STRAY - 1.0:
            return level
        return max(1.0, 1.0 + STEEP * (level - STRAY))

    @property
    def status(self) -> Status:
        """Status of the leg, by which its contacts are reported or withheld.

        ``monitor.status`` says whether the lifts fit the model in force, and governs the learning.
        This one says more: a leg that began with a prior is learning until it is known, though its
        lifts fit, and one whose early touches were none is ambiguous.
        """
        status = self.monitor.status
        if status == "valid" and self.early.reported:
            return "ambiguous"
        return "learning" if self.first is not None and status != "ambiguous" else status

    @property
    def version(self) -> int:
        """Version of the model in force."""
        return self.active.version

    @property
    def event_status(self) -> EventStatus:
        """Status, doubt and version, for events and the leg's status."""
        status, doubt = self.status, self.monitor.doubt
        if doubt is None and status == "ambiguous":
            doubt = "descents"
        return EventStatus(status, doubt, self.active.version)

    @property
    def note(self) -> str | None:
        """One line for the operator on the state of the leg, None when all is well."""
        return self.monitor.note or self.early.note

    @property
    def refits(self) -> RefitCounts:
        """Counts of refits, for the status."""
        return self.refit.counts

    def free_motion(self) -> FreeMotion:
        """Publish what the next tick is judged by."""
        noise, active, changed = self.noise_tracker, self.active, self.changed
        return FreeMotion(
            active.coefficients,
            self.variance_in_force,
            active.covariance,
            active.from_prior,
            changed,
            self.status == "valid" and not changed,
            noise.after_known,
            noise.whiten,
            noise.thresholds,
            self._domain,
        )

    # -- what detection has found -------------------------------------------------------------

    def learn(self, part: LabelledSwing) -> None:
        """Learn from a part of a swing."""
        match part.label:
            case Label.BEGIN:
                self.monitor.begin_swing(refuted=part.refuted)
            case Label.TICK:
                self.monitor.watch_tick(part.nis, part.way_rad)
            case Label.TRAVEL:
                self.monitor.record_travel(
                    obstructed=part.obstructed, travel_ratio=part.travel_ratio
                )
            case Label.LIFT:
                self._lift(part)
            case Label.DESCENT:
                self._descent(part.rows, part.region)
            case Label.END:
                self._end_swing(part.early, refuted=part.refuted)

    def _lift(self, part: LabelledSwing) -> None:
        """Assess the lift of a swing whose top has been passed."""
        region = part.region
        found = self.monitor.assess_lift(part.rows, part.t_ns, whole=part.whole)
        waiting, self._suspected = self._suspected, NO_ROWS
        if found.changed:
            self._change(first=found.first)
        if found.rows:
            if self.first is not None:
                self.first.add_uncertainty(self.active.uncertainty(found.rows))
            if self.active.baseline_is_better(found.rows):  # such as after mud is washed off
                self._return_to_start(f"the baseline fits {RETURN_SWINGS} lifts better")
            self._confirm(found.rows, region)
        if found.changed:
            self._confirm(waiting, region)

    def _descent(self, rows: Rows, region: int) -> None:
        """Learn the confirmed part of a descent; after a suspected lift it waits for the next."""
        if self.first is not None:
            self.first.add_uncertainty(self.active.uncertainty(rows))
        if self.monitor.trusted:
            self._confirm(rows, region)
        else:
            self._suspected = rows

    def distrust(self, since_ns: int) -> None:
        """Drop what was confirmed since a time: those ticks were of another length.

        A row or two of them may have been learned, which the next swings outweigh; the buffer
        would have kept them.
        """
        self._suspected = self._suspected[self._suspected.t_ns < since_ns]
        self.buffer.drop_since(since_ns)
        self.monitor.distrust(since_ns)
        # Not in order: a descent that waited is confirmed with the lift that comes after it.
        kept = [t_ns for t_ns in self.confirmed_ns if t_ns < since_ns]
        self.confirmed_ns = deque(kept, maxlen=CONFIRMED_TICKS)

    def go_on_from(self, before: Adapter) -> None:
        """Take over what does not depend on the model, from the adapter of another slope."""
        self.refit.restore(before.refit.snapshot())
        self._era = before._era + 1
        self.first = None if before.first is None else FirstSwings(before.first.swings)

    def keep(self, t_ns: int) -> None:
        """Keep what is known of the leg as a swing begins, for :meth:`retract`."""
        if self.learning:
            parts = tuple(None if of is None else _copied(vars(of)) for of in self._followers)
            self._kept.append(_Kept(t_ns, self._era, self.active.good(), parts))

    def retract(self, since_ns: int) -> None:
        """Drop what was confirmed and learned since a time: those ticks were not of this leg."""
        self.distrust(since_ns)
        while len(self._kept) > 1 and self._kept[-1].t_ns > since_ns:
            self._kept.pop()
        if not self._kept:
            return
        kept = self._kept.pop()
        self.active.return_to(kept.good)
        if self.first is None and kept.parts[-1] is not None:
            self.first = FirstSwings()
        for of, state in zip(self._followers, kept.parts, strict=True):
            if of is not None and state is not None:
                vars(of).update(_copied(state))
        self._era, self._evidence = kept.era, None
        self.refit.leg_changed()
        self._refresh()

    @property
    def _followers(self) -> tuple[object | None, ...]:
        return self.monitor, self.early, self.noise_tracker, self.first

    def new_source(self) -> None:
        """Follow a restart of the source: times from before do not compare with its own."""
        while self.buffer.unlearned:
            self._learn()
        self._suspected = NO_ROWS
        self._kept.clear()
        self.confirmed_ns.clear()
        self.buffer.new_source()
        self.monitor.new_clock()

    def _end_swing(self, early: bool | None, *, refuted: bool) -> None:
        """End a swing that is resolved: count it, and request a refit that is due.

        Args:
            early: a touch was reported in it before the foot had begun to come down; None where
                that is not known.
            refuted: the foot came down all the same.
        """
        learned, self._learned_swing = self._learned_swing, False
        if not self.learning:
            return
        valid = self.monitor.status == "valid"
        if self.first is not None and self.first.end_swing(valid=valid):
            self.first = None
        if valid and early is not None and self.early.count_swing(early, refuted=refuted):
            self.refit.drop()  # no lift shows what is wrong: rows of lifts are no judge
        self._swings += 1
        if self._swings >= REFRESH_SWINGS:
            self._refresh()
        if not self.early.reported:
            self.refit.end_swing(self.buffer, self._era, learned=learned)

    def tick(self, budget: int) -> bool:
        """Learn a few rows and collect a refit that is due; once per control tick.

        Args:
            budget: rows at most.

        Returns:
            Whether the coefficients of the free-motion model have changed.
        """
        before = self.buffer.unlearned
        if before:
            for _ in range(min(self._share(budget), before)):
                if self.buffer.unlearned:  # a model that falls takes the rows that wait with it
                    self._learn()
        won = self.refit.tick()
        if won is not None:
            model = won.model.moved(won.model.coefficients, self.version + 1)
            self.found = dataclasses.replace(won, model=model)
        return before > 0

    def _share(self, budget: int) -> int:
        """Return how many rows a tick learns: a known leg can wait, a changed one cannot.

        A swing brings a dozen rows and takes some 70 ticks; a queue that grows longer than that of
        a long swing is worked off at the full rate.
        """
        return budget if self.monitor.status != "valid" or self.buffer.unlearned > CALM_QUEUE else 1

    def snapshot(self) -> dict[str, Any]:
        """Return what has been learned, for :meth:`restore`."""
        return {
            "format": FORMAT,
            "library": library_key(self.model.library),
            **self.active.snapshot(),
            "level": self.monitor.variance_scale,
            "status": self.monitor.status,
            "held": self.monitor.obstructed,
            "heard": list(self.monitor.lifts_assessed),
            "kind": self.monitor.kind,
            "belied": self.early.snapshot(),
            "first": None if self.first is None else self.first.swings,
            "era": self._era,
            "refits": self.refit.snapshot(),
            "recent": self.noise_tracker.snapshot(),
            "segments": [segment_of(s) for s in self.buffer.segments],
        }

    def restore(self, saved: dict[str, Any]) -> str | None:
        """Take over a snapshot, whole or not at all.

        Returns:
            None when it is in force, else one line that says why it is not.
        """
        try:
            state = read_state(saved, self.active.baseline, len(self.noise_tracker.whiten))
            self.active.restore(state, saved.get("factor"))
        except ImplausibleError as problem:
            return f"snapshot of leg '{self._leg}' not used: {problem}"
        self.monitor.resume(
            state.level, state.status, obstructed=state.held,
            lifts_assessed=state.lifts_assessed, kind=state.kind,
        )  # fmt: skip
        self.early.restore(saved.get("belied"))
        self._restore_first(saved.get("first"))
        self._era = state.era
        self.refit.restore(saved.get("refits"))
        self.buffer.restore(state.segments)
        self.noise_tracker.restore(saved.get("recent"), self.monitor.variance_in_force)
        self._refresh()
        return None

    # -- private ----------------------------------------------------------------------------------

    def _restore_first(self, swings: object) -> None:
        if not is_count(swings):
            self.first = None
        elif self.first is not None:
            self.first = FirstSwings(swings)

    def _change(self, *, first: bool) -> None:
        """Begin a new era, as the leg has changed: inflate the covariance, drop the refit."""
        if first:
            self.early.forget()
            self._evidence = ChangeClassifier(self.model, self._noise)
        self._era += 1
        self.active.inflate()
        self.refit.leg_changed()
        self._refresh()

    def _confirm(self, rows: Rows, region: int) -> None:
        """Take free rows: into the replay buffer, the noise tracker and the recursion's queue."""
        # A foot that is not yet well off the ground may be pushed by it: its rows show whether a
        # lift fits, and are not learned.
        cleared = rows.records["cleared"]
        if not all(cleared.tolist()):
            rows = rows[cleared]
        self._learned_swing |= bool(rows)
        if self._evidence is not None and not self._evidence.complete:
            self._evidence.add(rows)
            self.monitor.record_kind(self._evidence.kind)
        if self.monitor.status == "valid" and rows:
            scale = self.monitor.variance_in_force
            self.noise_tracker.count(rows, scale)
        self.confirmed_ns.extend(rows.t_ns.tolist())
        self.buffer.add(rows, region, self._era)

    def _learn(self) -> None:
        """Learn the next row that waits."""
        segment, at = self.buffer.pop_unlearned()
        if not self.active.learn(segment.values, at):
            self._return_to_start(
                "a coefficient was not finite, or implausible: the baseline again"
            )

    def _refresh(self) -> None:
        """Recompute covariances and thresholds for the model in force and the present era."""
        self._swings = 0
        residuals = self.buffer.residuals(self.active.coefficients, self._era)
        self.noise_tracker.refresh(*residuals)

    def _return_to_start(self, why: str) -> None:
        """Go on from the model of the start; what was learned since is dropped."""
        self.active.return_to_start()
        self.buffer.drop_unlearned()
        self.refit.leg_changed()
        self.refit.count_return(why)
        self.monitor.mark_unchanged()
        self._evidence = None
        self._era += 1
        self._refresh()


def _copied(state: dict[str, Any]) -> dict[str, Any]:
    """Copy a state; its arrays are replaced, never written to."""
    return {name: of.copy() if isinstance(of, deque) else of for name, of in state.items()}
