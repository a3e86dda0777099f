"""Compares how a robot's samples count angles with what its description says.

Each leg's samples of the last minute are judged now and then, until the motion has confirmed
every leg (:mod:`adaptive_contact.checks.conventions.judge`).  A leg that is described wrong gets a
finding; its learner then reports no contacts and learns nothing, as both would rest on a geometry
that is not the leg's.  A finding counts when two judgements in a row agree.
"""

from __future__ import annotations

import functools
from typing import Final

from adaptive_contact.checks.conventions.judge import ConventionFinding, Verdict, judge_motion
from adaptive_contact.checks.watch import Track, Watch
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.robot import Leg, Robot

# When the motion is judged, s of samples; a tripod's 20 swings take 28 s.
TIMES_S: Final = (
    *(4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 24.0, 28.0, 34.0, 40.0, 50.0),
    *range(60, 601, 60),
)


class ConventionWatch(Watch[ConventionFinding]):
    """Watches how the angles of a robot are counted."""

    def __init__(self, robot: Robot, refitter: Refitter | None = None) -> None:
        judge = functools.partial(judge_motion, robot)
        super().__init__(robot, refitter, "*", TIMES_S, judge)

    def track(self, leg: Leg, place: LegPlace) -> Track[ConventionFinding] | None:
        """Make the track of a leg with arrays; None for one whose geometry is not known."""
        return None if leg.chain is None else super().track(leg, place)

    def _conclude(self, found: Verdict) -> None:
        findings = {finding.leg: finding for finding in found.findings}
        open_legs = {leg for leg, track in self._tracks.items() if track.begun}
        # Legs are judged by each other: none is let go before all are confirmed.
        confirmed = bool(open_legs) and open_legs <= set(found.fits)
        for leg, track in self._tracks.items():
            if not track.settled:
                track.take(findings.get(leg), right=leg in found.fits)
            track.settled |= not self._times or (confirmed and leg in open_legs)
