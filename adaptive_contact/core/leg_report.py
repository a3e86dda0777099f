"""Reports one leg: its events, its status, and the note on what stops it."""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from adaptive_contact.checks.conventions.judge import ConventionFinding
from adaptive_contact.checks.source_watch import SOURCE_CAUSES, RateWatch, SourceWatch
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.core.detect.source import UNJUDGED_TURNS
from adaptive_contact.core.detect.stream import StreamGuard
from adaptive_contact.core.detect.swing_judge import SwingJudge
from adaptive_contact.core.detect.swing_labels import SwingLabels
from adaptive_contact.core.detect.touch_point import PUSH_TICKS, TouchPoint, locate
from adaptive_contact.core.learn.adapter import Adapter, EventStatus
from adaptive_contact.core.learn.lifecycle import Lifecycle
from adaptive_contact.core.learn.mode import WhenAmbiguous
from adaptive_contact.model.bounds import is_count
from adaptive_contact.robot import Leg
from adaptive_contact.wire import (
    BufferCounts,
    ContactEvent,
    Doubt,
    DriftLevel,
    LearnerStatus,
    LegState,
    RefitCounts,
    Reject,
    ServoSample,
    Status,
)

if TYPE_CHECKING:  # imports the fits
    from adaptive_contact.checks.leg_ids import Owner
    from adaptive_contact.checks.watch import Track


class Counters:
    """Counts for one leg.

    Attributes:
        counts: by name.
        rejects: samples and payloads that were not used, by reason.
        fault_note: one line for the operator on faults in learning; None while there was none.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.rejects: Counter[Reject] = Counter()
        self.fault_note: str | None = None
        self._faults = 0

    def fault(self, fault: Exception) -> None:
        """Count a fault in learning, after which the leg was reset."""
        self._faults += 1
        last = " ".join(f"{type(fault).__name__}: {fault}".split())[:160]
        self.fault_note = f"{self._faults} faults in learning, restarted each time; last {last}"

    def snapshot(self) -> dict[str, Any]:
        """Return the counters as plain maps, for :meth:`restore`."""
        rejects = {str(reason): n for reason, n in self.rejects.items()}
        return {"counts": dict(self.counts), "rejects": rejects}

    def restore(self, saved: dict[str, Any]) -> None:
        """Take over saved counters; what is not usable is left."""
        counts = saved.get("counts")
        if isinstance(counts, dict):
            for name, count in counts.items():
                if isinstance(name, str) and is_count(count):
                    self.counts[name] = count
        rejects = saved.get("rejects")
        if isinstance(rejects, dict):
            known = {str(reason): reason for reason in Reject}
            for name, count in rejects.items():
                if name in known and is_count(count):
                    self.rejects[known[name]] = count


class LegReport:
    """Reports of one leg.

    Args:
        leg: its description.
        place: its arrays.
        lifecycle: of its model.
        guard: of its stream.
        swing, labels: of its swings.
        track, ids: watch how its angles are counted, and whose samples they are; None for no watch.
        when_ambiguous: whether contacts are reported while the leg is ambiguous.

    Attributes:
        counters: of what was counted for the status.
        rate: reads the leg's clock.
        source: reads whether its source sends what was read.
    """

    def __init__(
        self, leg: Leg, place: LegPlace, lifecycle: Lifecycle, guard: StreamGuard,
        swing: SwingJudge, labels: SwingLabels, track: Track[ConventionFinding] | None,
        ids: Track[Owner] | None, when_ambiguous: WhenAmbiguous,
    ) -> None:  # fmt: skip
        self._leg, self._place, self._lifecycle, self._guard = leg, place, lifecycle, guard
        self._swing, self._labels, self._track, self._ids = swing, labels, track, ids
        self._when_ambiguous = when_ambiguous
        self.counters = Counters()
        self.rate = RateWatch(place.leg.period_ns, place)
        self.source = SourceWatch(leg, place)
        self._learning = EventStatus()

    def event(
        self,
        sample: ServoSample,
        *,
        contact: bool,
        onset_ns: int,
        score: float,
        residual: list[float],
    ) -> ContactEvent:
        """Make an event, withheld where the leg is ambiguous, and count it.

        Args:
            sample: that decided it.
            contact: it begins; else it ends.
            onset_ns: when, by the schedule that follows the stamps.
            score: test ratio.
            residual: (J,) rad.
        """
        leg = self._place.leg
        doubt, withheld = self.doubt, self.withholds
        reported = contact and not withheld
        leg.reported = reported
        if contact:
            self.counters.counts["withheld" if withheld else "contacts"] += 1
        return ContactEvent(
            leg=self._leg.id,
            t_ns=sample.t_ns,
            seq=sample.seq,
            # In the stamps' own time, of which the schedule is a smoothed one.
            onset_ns=sample.t_ns - max(leg.at_ns - onset_ns, 0),
            contact=reported,
            status=self._status,
            score=score,
            residual=residual,
            model_version=self._learning.version,
            withheld=withheld,
            doubt=doubt,
            p=self.state.p,
            **(self._touch_point()._asdict() if reported and self._leg.chain else {}),
        )

    def _touch_point(self) -> TouchPoint:
        """Locate the touch that the newest tick shows."""
        place, chain = self._place, self._leg.chain
        assert chain is not None
        step = place.leg.quantum**2 / 12.0
        deviation = np.sqrt(step + np.square(place.batch.sigma[place.row]) / 2.0)
        ticks = min(max(place.leg.usable, 1), PUSH_TICKS)
        off = place.residuals[:ticks].sum(axis=0)
        return locate(chain, place.window[0].tolist(), off.tolist(), deviation.tolist())

    @property
    def state(self) -> LegState:
        """Return whether the leg touches in its newest tick, stance included."""
        leg = self._place.leg
        known = not math.isnan(leg.p)
        return LegState(
            t_ns=leg.t_ns, seq=leg.seq, contact=leg.touches, p=leg.p if known else None, known=known
        )

    @property
    def status(self) -> LearnerStatus:
        """Return the learner's status, as it is published."""
        adapter, leg, counts = self._adapter, self._place.leg, self.counters.counts
        self.collect_counts()
        self.read_status()
        untouched_ns = leg.untouched_ns
        return LearnerStatus(
            leg=self._leg.id,
            t_ns=leg.t_ns,
            status=self._status,
            model_version=self._learning.version,
            residual_rms=self._place.free_rms,
            noise_floor=self._lifecycle.noise_floor,
            buffer=BufferCounts() if adapter is None else adapter.buffer.counts,
            drift=DriftLevel() if adapter is None else adapter.monitor.drift,
            refits=RefitCounts() if adapter is None else adapter.refits,
            ticks=counts["ticks"],
            rejects={str(reason): n for reason, n in sorted(self.counters.rejects.items())},
            missed=self._guard.missed,
            restarts=self._guard.restarts,
            contact=leg.reported,
            contacts=counts["contacts"],
            withheld=counts["withheld"],
            swings=counts["swings"],
            swings_withheld=counts["swings withheld"],
            doubt=self.doubt,
            jitter_ms=self.rate.jitter * self.rate.leg.period_ns / 1e6,
            untouched=leg.untouched,
            untouched_ns=None if untouched_ns < 0 else untouched_ns,
            note=self._note(),
        )

    @property
    def withholds(self) -> bool:
        """Return whether contacts are withheld, as the leg is ambiguous."""
        return self._withholds_at(self.doubt, fits=self._place.leg.fits)

    def begin_swing(self) -> None:
        """Count a swing that begins."""
        self.counters.counts["swings"] += 1
        self.counters.counts["swings withheld"] += self.withholds

    def read_status(self) -> None:
        """Take over what the learning says of the leg, for the events of the next ticks."""
        adapter = self._adapter
        self._learning = EventStatus() if adapter is None else adapter.event_status

    @property
    def version(self) -> int:
        """Return the version of the model in force, as events state it."""
        return self._learning.version

    def publish_withholding(self) -> None:
        """Set whether contacts are withheld, for this tick and a swing that begins with it."""
        self.read_status()
        leg, doubt = self._place.leg, self.doubt
        begun = leg.withholds_begun = self._withholds_at(doubt, fits=False)
        # A leg that fits may have contacts reported that others have withheld, never the other way.
        leg.withholds = begun and self._withholds_at(doubt, fits=leg.fits)

    @property
    def misread(self) -> bool:
        """Return whether the leg's angles are counted otherwise than described."""
        return bool(self._place.leg.misread)

    @property
    def doubt(self) -> Doubt | None:
        """Return why the leg is ambiguous; None where it is not."""
        cause = SOURCE_CAUSES[int(self._place.leg.cause)]
        if cause is not None:
            return cause
        if self.misread:
            return "angles"
        if self._guard.contested:
            return "publishers"
        if self.source.unproved:
            return "unproved"
        if self._unjudged:
            return "unjudged"
        return "unlearned" if self._unlearned else self._learning.doubt

    def collect_counts(self) -> None:
        """Take over what ticks have counted since the last call."""
        leg = self._place.leg
        self.counters.counts["ticks"] += leg.accepted_n
        refused = leg.refused_n
        if refused:
            self.counters.rejects[Reject.IMPLAUSIBLE] += refused
        leg.accepted_n = leg.refused_n = 0

    # -- private -------------------------------------------------------------------------------

    @property
    def _adapter(self) -> Adapter | None:
        return self._lifecycle.adapter

    @property
    def _void(self) -> bool:
        """Return whether samples cannot be judged: heights or positions of the leg are unknown."""
        return self.misread or bool(self._place.leg.cause)

    def _withholds_at(self, doubt: Doubt | None, *, fits: bool) -> bool:
        if doubt is None:
            return False
        if self._void or self._when_ambiguous is WhenAmbiguous.STRICT:
            return True
        if self._when_ambiguous is WhenAmbiguous.PUBLISH:
            return False
        # A foot that comes short of its command, and moved as the model says until it touched or
        # to its top, is slow, or meets something in its way.
        return doubt not in ("unsettled", "unjudged") and not (doubt == "held" and fits)

    @property
    def _unjudged(self) -> bool:
        """Return whether a valid leg is commanded to swing, and no swing could be judged."""
        return self._learning.status == "valid" and self._place.leg.unjudged >= UNJUDGED_TURNS

    @property
    def _unlearned(self) -> bool:
        """Return whether the model of a leg that began with a prior does not predict it.

        That of a leg that carries follows it within a lift or two; one that hangs has seen more.
        """
        adapter, leg, doubt = self._adapter, self._place.leg, self._learning.doubt
        if adapter is None or not leg.from_prior:
            return False
        return doubt == "unsettled" or (
            doubt is None and bool(leg.hanging) and adapter.monitor.unlearned
        )

    @property
    def _status(self) -> Status:
        doubted = self._void or self._guard.contested or self.source.unproved or self._unjudged
        return "ambiguous" if doubted else self._learning.status

    def _note(self) -> str | None:
        """Return the most serious reason why the leg reports no contacts, for the operator."""
        adapter = self._adapter
        ids = None if self._ids is None else self._ids.finding
        notes = (
            self.counters.fault_note,
            self._guard.note,
            self.rate.note,
            self.source.note,
            None if ids is None else ids.note,
            self._angles_note,
            self._swing.phase_unknown_note,
            self._lifecycle.note_now,
            None if adapter is None else adapter.note,
            self._labels.unobservable_note,
            self._labels.landings.note,
            "the model needs a preview that the samples do not carry: no predictions"
            if self._place.leg.lacking
            else None,
            self._unjudged_note,
            self._unlearned_note,
            self.source.limits_note,
        )
        return next((note for note in notes if note is not None), None)

    @property
    def _unjudged_note(self) -> str | None:
        """Describe for the operator that commanded swings could not be judged; else None."""
        turns = self._place.leg.unjudged
        if turns < UNJUDGED_TURNS:
            return None
        return (
            f"{turns} lifts and lowerings were commanded and none could be judged: phase does not "
            "follow the swings, samples are lost, or readings are not those of the servos"
        )

    @property
    def _unlearned_note(self) -> str | None:
        """Describe for the operator that a leg in the air moves as it never did; else None."""
        if not self._unlearned:
            return None
        return (
            "the last lifts were not predicted: a motion that the leg has not made before; no "
            "contacts are reported until three lifts in a row are"
        )

    @property
    def _angles_note(self) -> str | None:
        """Describe to the operator how the leg's angles differ from robot.toml; else None."""
        found = None if self._track is None else self._track.finding
        if found is None:
            return None
        until = "; no contacts are reported until then" if self.misread else ""
        return found.line(self._leg) + until
