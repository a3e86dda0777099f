"""Compares how a robot's samples count angles with what its description says.

Each leg's samples of the last minute are judged now and then, until the motion has confirmed
every leg (:mod:`adaptive_contact.conventions.judge`).  A leg that is described wrong gets a
finding; its learner then reports no contacts and learns nothing, as both would rest on a geometry
that is not the leg's.  A finding counts when two judgements in a row agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

from adaptive_contact.conventions.judge import ConventionFinding, LegMotion, Verdict, judge_motion
from adaptive_contact.detect.layout import KEPT
from adaptive_contact.detect.leg_batch import LegPlace
from adaptive_contact.diagnose.kept_samples import KeptSamples
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.robot import Leg, Robot

# When the motion is judged, s of samples; a tripod's 20 swings take 28 s.  After the last, it is
# every LATER_S, and with no leg left to judge, or after ENOUGH_S, never.
TIMES_S: Final = (4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 24.0, 28.0, 34.0, 40.0, 50.0, 60.0)
LATER_S: Final = 60.0
ENOUGH_S: Final = 600.0
# No leg has this name: the job is of all.
_ALL: Final = "*"


@dataclasses.dataclass(frozen=True)
class ConventionJob:
    """Describes a judgement of a robot's motion, for any process."""

    leg: str
    number: int
    robot: Robot
    motions: Mapping[str, LegMotion]

    def run(self) -> Verdict:
        """Judge the motion."""
        return judge_motion(self.robot, self.motions)


class MotionTrack:
    """Follows what the motion of one leg shows of its description."""

    def __init__(self, place: LegPlace) -> None:
        # what is wrong with its description; None as long as nothing is known to be
        self.finding: ConventionFinding | None = None
        self.settled = False  # the motion has confirmed the description
        self.suspected: ConventionFinding | None = None  # by the last judgement alone
        self._place = place

    @property
    def begun(self) -> bool:
        """Whether the leg has had samples."""
        return bool(self._place.leg.kept_n)

    @property
    def spoils(self) -> bool:
        """Whether the finding makes heights of the foot wrong."""
        return self.finding is not None and self.finding.grave

    @property
    def motion(self) -> LegMotion:
        """Its newest samples; none once it is settled."""
        kept = KeptSamples.of(self._place, 0 if self.settled else KEPT)
        # Counted from the first, as numbers of any size are.
        seq = kept.seq - kept.seq[:1]
        return LegMotion(kept.t_ns, kept.measured, kept.desired, kept.swing, seq)


class ConventionWatch:
    """Judges a robot's motion when it is time.

    Args:
        robot: its description.
        refitter: makes the judgements; in line where absent.
    """

    def __init__(self, robot: Robot, refitter: Refitter | None = None) -> None:
        self._robot = robot
        self._refitter = refitter
        self._tracks: dict[str, MotionTrack] = {}
        self._pending: int | None = None
        self._jobs = 0
        self._next = round(TIMES_S[0] / robot.period_s)
        self._ticks = 0

    def track(self, leg: Leg, place: LegPlace) -> MotionTrack | None:
        """Make the track of a leg with arrays; None for one whose geometry is not known."""
        if leg.chain is None or leg.id not in self._robot.leg_ids:
            return None
        self._tracks[leg.id] = MotionTrack(place)
        return self._tracks[leg.id]

    def look(self) -> None:
        """Judge, if it is time after this tick, and take a judgement when it is there."""
        self._ticks += 1
        if self._ticks < self._next and self._pending is None:
            return
        if self._pending is not None:
            assert self._refitter is not None
            verdict = self._refitter.collect(_ALL, self._pending)
            if verdict is None:
                return
            self._pending = None
            assert isinstance(verdict, Verdict)
            self._conclude(verdict)
            return
        self._schedule()
        open_tracks = [track for track in self._tracks.values() if not track.settled]
        if not open_tracks:
            return
        self._jobs += 1
        motions = {leg: track.motion for leg, track in self._tracks.items() if track.begun}
        job = ConventionJob(_ALL, self._jobs, self._robot, motions)
        if self._refitter is None:
            self._conclude(job.run())
        else:
            self._pending = job.number
            self._refitter.submit(job)

    def _schedule(self) -> None:
        now_s = self._ticks * self._robot.period_s
        later = [time for time in TIMES_S if time > now_s + 0.5 * self._robot.period_s]
        if later:
            self._next = round(later[0] / self._robot.period_s)
        elif now_s < ENOUGH_S:
            self._next = self._ticks + round(LATER_S / self._robot.period_s)
        else:
            self._next = 2**62
            for track in self._tracks.values():
                track.settled = True

    def _conclude(self, verdict: Verdict) -> None:
        found = {finding.leg: finding for finding in verdict.findings}
        for leg, track in self._tracks.items():
            if track.settled:
                continue
            if leg in verdict.fits:
                track.finding = track.suspected = None
                continue
            finding = found.get(leg)
            if finding is not None and finding.agrees(track.suspected):
                track.finding = finding
            track.suspected = finding
        # Legs are judged by each other: none is let go before all are confirmed.
        open_legs = [leg for leg, track in self._tracks.items() if track.begun]
        if open_legs and set(open_legs) <= set(verdict.fits):
            for leg in open_legs:
                self._tracks[leg].settled = True
