r"""Finds legs whose samples come under another leg's name.

Two facts show it:

1. *A leg's servos are its own.*  With a baseline of every leg, the residuals of one leg's free
   motion are least under its own model.  Legs i and k are named where each fits the other's better
   by a margin, and as well as free motion fits the right one.
2. *Feet that stand do not move against each other.*  With mounts and lengths, the legs' places on
   the body are permuted until the distances of standing feet stay constant.

Neither is complete.  Legs of equal servos have equal models, and a body that looks the same
turned by half a turn keeps all distances when its legs are named so.  In straight walking, a swap
of a left leg with its mirror image looks like a yaw of the wrong sign: both are said.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Mask
from adaptive_contact.detect.leg_batch import LegPlace
from adaptive_contact.diagnose.kept_samples import KeptSamples
from adaptive_contact.diagnose.standing_feet import LegRows, standing_feet
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.fit.train import cautious
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.model.window import stack
from adaptive_contact.notes import SWAPPED
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.robot.gait_phase import infer_phase
from adaptive_contact.wire import ServoSample

# When the samples are judged, s: a tripod's tenth swing ends after 14 s.  Two verdicts must agree.
TIMES_S: Final = (12.0, 20.0, 28.0, 40.0, 60.0)
# Free ticks of a leg from which its residuals are evidence.
LEAST_TICKS: Final = 150
# Another leg's model is the right one where it errs by so much less than the leg's own.  Of the
# shipped hexapod's legs the two most alike err by 1.08 times as much under each other's models.
BETTER: Final = 1.04
# And where all legs err by no more than this many times the noise that their models were learned
# with: in ten kinds of walks it is 0.83 to 1.08 times; of other robots of the kind 0.91 to 1.6, and
# two legs of them are like two others' by chance.
AT_HOME: Final = 1.1
_ALL: Final = "*ids"


class Owner(NamedTuple):
    """Names the leg that samples are of, and how that shows."""

    leg: str
    why: str


def judge_fit(robot: Robot, baseline: Baseline, rows: Mapping[str, LegRows]) -> dict[str, Owner]:
    """Compare every leg's residuals under its own and the others' baselines.

    Returns:
        By the name of the samples, the leg that they are of, where the models distinguish legs;
        the same name where the models show that it is right.
    """
    errors: dict[str, dict[str, float]] = {}
    for leg, of_leg in rows.items():
        if leg in baseline.legs:
            errors[leg] = _errors(robot, baseline, leg, of_leg)
    noise = {name: float(np.sqrt(np.mean(k.noise.rms**2))) for name, k in baseline.legs.items()}
    owners = {}
    for leg, under in errors.items():
        best = min(under, key=lambda name: under[name], default=leg)
        if under.get(leg, 0.0) > BETTER * under.get(best, 0.0):
            owners[leg] = Owner(
                best,
                f"its model errs by {1e3 * under[best]:.1f} mrad on them, that of '{leg}' by "
                f"{1e3 * under[leg]:.1f}",
            )
    # A leg that has changed may fit another's model by chance; legs that changed places do all.
    owners = _circles(owners)
    at_home = all(
        under.get(owner, 0.0) <= AT_HOME * noise[owner]
        for leg, under in errors.items()
        for owner in [owners[leg].leg if leg in owners else leg]
    )
    if not at_home:
        return {}
    right = {leg: Owner(leg, "") for leg, under in errors.items() if under and leg not in owners}
    return {**right, **owners}


def _circles(owners: Mapping[str, Owner]) -> dict[str, Owner]:
    """Those owners that form closed circles: every leg's samples are somewhere."""
    left = dict(owners)
    while True:
        named = {owner.leg for owner in left.values()}
        open_ones = [leg for leg in left if left[leg].leg not in left or leg not in named]
        if not open_ones:
            return left
        for leg in open_ones:
            del left[leg]


def _errors(robot: Robot, baseline: Baseline, leg: str, rows: LegRows) -> dict[str, float]:
    """Root mean square of a leg's free residuals, rad, under every model of its library."""
    own = baseline.legs[leg].model
    free = _free(robot.leg(leg), rows)
    theta, target = [], []
    for part in np.split(np.arange(len(rows.seq)), np.flatnonzero(np.diff(rows.seq) != 1) + 1):
        if len(part) <= own.library.window.length + 1:
            continue
        cut = stack(rows.measured[part], rows.desired[part], own.library.window)
        ticks = part[cut.tick]
        use = np.flatnonzero(free[ticks] & free[np.minimum(ticks + 1, part[-1])])
        theta.append(own.library.evaluate(cut.measured[use], cut.desired[use], cut.preview[use]))
        target.append(cut.increment[use])
    if sum(map(len, target)) < LEAST_TICKS:
        return {}
    regressors, increments = np.concatenate(theta), np.concatenate(target)
    return {
        name: _root(increments - regressors @ known.model.coefficients)
        for name, known in baseline.legs.items()
        if known.model.library == own.library
    }


def _root(residuals: Array) -> float:
    """Root mean square but for the largest, which are touches and bad readings."""
    squares = np.sort(np.square(residuals).mean(axis=1))
    return float(np.sqrt(squares[: math.ceil(0.95 * len(squares))].mean()))


def _free(leg: Leg, rows: LegRows) -> Mask:
    swing = rows.swing if rows.swing is not None else infer_phase(rows.desired, leg)
    return np.zeros(len(rows.seq), dtype=bool) if swing is None else cautious(swing)


def judge_ids(
    robot: Robot, baseline: Baseline | None, rows: Mapping[str, LegRows]
) -> dict[str, Owner]:
    """Find legs whose samples are another leg's.

    Returns:
        By the name that samples come under: the leg that they are of.
    """
    known = {} if baseline is None else judge_fit(robot, baseline, rows)
    fitted = {leg: owner for leg, owner in known.items() if owner.leg != leg}
    legs = [leg for leg in robot.legs if leg.id in rows and len(rows[leg.id].seq)]
    places = standing_feet(legs, [rows[leg.id] for leg in legs], robot.period_s)
    if places is None:
        return fitted
    if not fitted and places.rigid(range(len(legs))):  # as nearly always
        return {}
    orders = places.rigid_orders()
    if not orders:
        return fitted
    ids = [leg.id for leg in legs]
    named = tuple(ids.index(fitted[leg].leg if leg in fitted else leg) for leg in ids)
    if fitted and named in orders:
        # Two legs may be like two others by chance; their feet then move against the rest.
        return fitted
    order = orders[0]
    moved = [i for i in range(len(ids)) if order[i] != i]
    if any(known.get(ids[i], Owner("", "")).leg == ids[i] for i in moved):
        return {}
    mirrored = places.rigid_with_yaw_turned(moved)
    placed = {}
    for i in moved:
        why = "feet that stand keep their distances then, and not as the legs are named"
        others = list(dict.fromkeys(ids[one[i]] for one in orders))[1:]
        if others:
            why += f"; as likely is {_either(others)}, with all others turned round as well"
        if mirrored:
            why += "; as likely, the yaw angles grow the wrong way"
        placed[ids[i]] = Owner(ids[order[i]], why)
    return placed


def _either(names: Sequence[str]) -> str:
    return " or ".join(f"'{name}'" for name in names)


@dataclasses.dataclass(frozen=True)
class IdJob:
    """Describes a judgement of whose samples come under each leg's name, for any process."""

    leg: str
    number: int
    robot: Robot
    baseline: Baseline | None
    rows: Mapping[str, LegRows]

    def run(self) -> dict[str, Owner]:
        """Judge the samples."""
        return judge_ids(self.robot, self.baseline, self.rows)


class IdTrack:
    """Follows whose samples come under one leg's name."""

    def __init__(self, place: LegPlace, period_ns: int) -> None:
        # the leg whose samples these are; None as long as they seem to be the leg's own
        self.owner: Owner | None = None
        self.suspected: Owner | None = None  # by the last judgement alone
        self._place, self._period_ns = place, period_ns

    @property
    def rows(self) -> LegRows:
        """Its newest samples."""
        return rows_of(KeptSamples.of(self._place), self._period_ns)

    @property
    def note(self) -> str | None:
        """One line for a person while the samples seem to be another leg's."""
        return None if self.owner is None else note_of(self.owner)


def rows_of(kept: KeptSamples, period_ns: int) -> LegRows:
    """Number the samples of a leg by their time: legs need not count alike."""
    ahead = round(int(kept.t_ns[0]) / period_ns) - kept.seq[0] if len(kept.seq) else 0
    return LegRows(kept.seq + ahead, kept.measured, kept.desired, kept.swing)


def note_of(owner: Owner) -> str:
    """Write one line for a person on samples that seem to be another leg's."""
    return (
        f"{SWAPPED} '{owner.leg}': {owner.why}; give legs the ids of robot.toml in the source, or "
        "change them there"
    )


def judge_recorded_ids(
    robot: Robot, samples: Mapping[str, Sequence[ServoSample]]
) -> dict[str, str]:
    """Write one line for each leg whose recorded samples seem to be another leg's."""
    rows = {
        leg: rows_of(KeptSamples.first(of_leg), round(robot.period_s * 1e9))
        for leg, of_leg in samples.items()
        if of_leg
    }
    return {leg: note_of(owner) for leg, owner in judge_ids(robot, None, rows).items()}


class IdWatch:
    """Judges, when it is time, whose samples come under each leg's name."""

    def __init__(self, robot: Robot, baseline: Baseline | None, refitter: Refitter) -> None:
        self._robot, self._baseline, self._refitter = robot, baseline, refitter
        self._tracks: dict[str, IdTrack] = {}
        self._times = [round(time / robot.period_s) for time in TIMES_S]
        self._ticks = self._jobs = 0
        self._pending: int | None = None

    def track(self, leg: Leg, place: LegPlace) -> IdTrack | None:
        """Make the track of a described leg with arrays."""
        if leg.id not in self._robot.leg_ids:
            return None
        self._tracks[leg.id] = IdTrack(place, round(self._robot.period_s * 1e9))
        return self._tracks[leg.id]

    def look(self) -> None:
        """Judge, if it is time after this tick, and take a judgement when it is there."""
        self._ticks += 1
        if self._pending is not None:
            owners = self._refitter.collect(_ALL, self._pending)
            if owners is None:
                return
            assert isinstance(owners, dict)
            self._pending = None
            self._conclude(owners)
        if not self._times or self._ticks < self._times[0]:
            return
        del self._times[0]
        self._jobs += 1
        self._pending = self._jobs
        every = {leg: track.rows for leg, track in self._tracks.items()}
        rows = {leg: of_leg for leg, of_leg in every.items() if len(of_leg.seq)}
        self._refitter.submit(IdJob(_ALL, self._jobs, self._robot, self._baseline, rows))

    def _conclude(self, owners: Mapping[str, Owner]) -> None:
        for leg, track in self._tracks.items():
            found = owners.get(leg)
            if found is None:
                track.owner = None
            elif track.suspected is not None and found.leg == track.suspected.leg:
                track.owner = found
            track.suspected = found
