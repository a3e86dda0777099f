"""Has the newest motion of all legs judged when it is time; a finding needs two in a row.

A leg whose angles are described wrong (:mod:`adaptive_contact.checks.conventions.judge`), or whose
samples are another's (:mod:`adaptive_contact.checks.leg_ids`), gets a finding; its learner then
reports no contacts and learns nothing, as both would rest on a leg that is not this one.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, Protocol, Self, TypeVar

from adaptive_contact.checks.conventions.judge import ConventionFinding, Findings, check_motion
from adaptive_contact.checks.motion import LegMotion
from adaptive_contact.core.detect.layout import KEPT
from adaptive_contact.core.detect.leg_batch import LegPlace
from adaptive_contact.fit.refit_job import InlineRefitter, Refitter
from adaptive_contact.robot import Leg, Robot

# When angles are judged, s of samples, until the motion has confirmed every leg; a tripod's 20
# swings take 28 s.
ANGLE_TIMES_S: Final = (
    *(4.0, 6.0, 8.0, 10.0, 13.0, 16.0, 20.0, 24.0, 28.0, 34.0, 40.0, 50.0),
    *range(60, 601, 60),
)


@dataclasses.dataclass(frozen=True)
class MotionJob:
    """Describes a judgement of all legs' motion, for any process."""

    leg: str  # name of the watch
    number: int
    judge: Callable[[Mapping[str, LegMotion]], object]
    motions: Mapping[str, LegMotion]

    def run(self) -> object:
        """Judge the motion."""
        return self.judge(self.motions)


class Finding(Protocol):
    """Defines what a judgement may find of a leg."""

    def agrees(self, other: Self | None) -> bool:
        """Return whether another judgement has found the same."""


FindingT = TypeVar("FindingT", bound=Finding)


class Track(Generic[FindingT]):
    """Follows what the motion of one leg shows."""

    def __init__(self, place: LegPlace) -> None:
        self.finding: FindingT | None = None  # what two judgements in a row have found
        self.settled = False  # nothing more is looked for
        self._suspected: FindingT | None = None  # by the last judgement alone
        self.place = place

    @property
    def begun(self) -> bool:
        """Return whether the leg has had samples."""
        return bool(self.place.leg.kept_n)

    @property
    def motion(self) -> LegMotion:
        """Return copies of its newest samples; none once it is settled."""
        return self.place.batch.kept(self.place.row, 0 if self.settled else KEPT)

    def set_finding(self, found: FindingT | None, *, right: bool = False) -> None:
        """Take what a judgement has found; ``right``: that nothing is wrong."""
        if right or (found is not None and found.agrees(self._suspected)):
            self.finding = found
        self._suspected = found


class Watch(Generic[FindingT]):
    """Has a robot's motion judged when it is time.

    Args:
        robot: its description.
        refitter: makes the judgements.
        name: no leg has it.
        times_s: when it is time, s of samples.
        judge: judges all legs' motion; a function that can be pickled.  It returns the finding of
            each leg, None for one that nothing is wrong with.
        until_confirmed: nothing more is looked for once nothing is wrong with any leg.
    """

    def __init__(
        self,
        robot: Robot,
        refitter: Refitter | None,
        name: str,
        times_s: Sequence[float],
        judge: Callable[[Mapping[str, LegMotion]], Mapping[str, FindingT | None]],
        *,
        until_confirmed: bool = False,
    ) -> None:
        self._robot, self._name, self._judge = robot, name, judge
        self._until_confirmed = until_confirmed
        self._refitter = InlineRefitter() if refitter is None else refitter
        self._tracks: dict[str, Track[FindingT]] = {}
        self._times = [round(time / robot.period_s) for time in times_s]
        self._pending: int | None = None

    def track(self, leg: Leg, place: LegPlace) -> Track[FindingT] | None:
        """Make the track of a leg with arrays; None for one that is not described."""
        if leg.id not in self._robot.leg_ids:
            return None
        self._tracks[leg.id] = Track(place)
        return self._tracks[leg.id]

    def poll(self) -> None:
        """Start a judgement if it is due after this tick, and take its result when it is there."""
        if self._pending is None:
            self._submit_if_due()
        if self._pending is not None:
            found: Any = self._refitter.collect(self._name, self._pending)
            if found is not None:
                self._pending = None
                self._conclude(found)

    def _submit_if_due(self) -> None:
        tracks = self._tracks.values()
        if not self._times or all(of.place.leg.total_n < self._times[0] for of in tracks):
            return
        del self._times[0]
        if all(track.settled for track in tracks):
            return
        self._pending = len(self._times)
        motions = {leg: track.motion for leg, track in self._tracks.items() if track.begun}
        self._refitter.submit(MotionJob(self._name, self._pending, self._judge, motions))

    def _conclude(self, found: Mapping[str, FindingT | None]) -> None:
        """Take a judgement."""
        begun = {leg: track for leg, track in self._tracks.items() if track.begun}
        # Legs are judged by each other: none is let go before all are confirmed.
        right = {leg for leg, finding in found.items() if finding is None}
        confirmed = self._until_confirmed and begun.keys() <= right
        for leg, track in begun.items():
            if not track.settled:
                track.set_finding(found.get(leg), right=leg in right)
            track.settled |= confirmed or not self._times


def check_angles(robot: Robot, motions: Mapping[str, LegMotion]) -> Findings:
    """Find legs whose angles are counted otherwise than described; None for those that fit."""
    unknown: Findings = {leg.id: None for leg in robot.legs if leg.chain is None}
    return unknown | check_motion(robot, motions)


def watch_angles(robot: Robot, refitter: Refitter | None = None) -> Watch[ConventionFinding]:
    """Make the watch of how the angles of a robot are counted."""
    judge = functools.partial(check_angles, robot)
    return Watch(robot, refitter, "*", ANGLE_TIMES_S, judge, until_confirmed=True)
