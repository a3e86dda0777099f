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

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from adaptive_contact.arrays import Array, Ints
from adaptive_contact.checks.conventions.feet import LOOSE, Feet, Walker
from adaptive_contact.checks.motion import LegMotion, control_ticks
from adaptive_contact.checks.watch import Watch
from adaptive_contact.core.detect.layout import KEPT
from adaptive_contact.fit.refit_job import Refitter
from adaptive_contact.fit.train import Stretch, cautious, free_rows
from adaptive_contact.model.model_file import Baseline
from adaptive_contact.notes import SWAPPED
from adaptive_contact.robot import Robot
from adaptive_contact.robot.gait_phase import infer_phase
from adaptive_contact.wire import ServoSample

# When the samples are judged, s: a tripod's tenth swing ends after 14 s.  Two verdicts must agree.
TIMES_S: Final = (12.0, 20.0, 28.0, 40.0, 60.0)
# Free ticks of a leg from which its residuals are evidence.
LEAST_TICKS: Final = 150
# Another leg's model is the right one where it errs by so much less than the leg's own.  Of the
# shipped hexapod's legs the two most alike err by 1.08 times as much under each other's models.
BETTER: Final = 1.04


class Owner(NamedTuple):
    """Names the leg that samples are of, and how that shows."""

    leg: str
    why: str

    def agrees(self, other: Owner | None) -> bool:
        """Return whether another judgement has named the same leg."""
        return other is not None and other.leg == self.leg

    @property
    def note(self) -> str:
        """Return one line for the operator."""
        return (
            f"{SWAPPED} '{self.leg}': {self.why}; give legs the ids of robot.toml in the source, "
            "or change them there"
        )


def compare_models(
    robot: Robot, baseline: Baseline, motions: Mapping[str, LegMotion]
) -> dict[str, Owner | None]:
    """Compare every leg's residuals under its own and the others' baselines.

    Returns:
        By the name of the samples, the leg that they are of, where the models distinguish legs;
        None where the models show that the name is right.
    """
    ticks = control_ticks(motions, robot.period_s)
    errors = {
        leg: _errors(robot, baseline, leg, motion, ticks[leg])
        for leg, motion in motions.items()
        if leg in baseline.legs
    }
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
        # All legs err by no more than this many times the noise that their models were learned
        # with: in ten kinds of walks it is 0.83 to 1.08 times; of other robots of the kind
        # 0.91 to 1.6, and two legs of them are like two others' by chance.
        under.get(owner, 0.0) <= 1.1 * noise[owner]
        for leg, under in errors.items()
        for owner in [owners[leg].leg if leg in owners else leg]
    )
    return {leg: owners.get(leg) for leg, under in errors.items() if under and at_home}


def _circles(owners: Mapping[str, Owner]) -> dict[str, Owner]:
    """Return the owners that form closed circles: every leg's samples are somewhere."""
    left = set(owners)
    for _ in owners:
        left = {owners[leg].leg for leg in left} & owners.keys()
    return {leg: owner for leg, owner in owners.items() if leg in left}


def _errors(
    robot: Robot, baseline: Baseline, leg: str, motion: LegMotion, ticks: Ints
) -> dict[str, float]:
    """Return the rms of a leg's free residuals, rad, under every model of its library."""
    own = baseline.legs[leg].model
    swing = infer_phase(motion.desired, robot.leg(leg)) if motion.swing is None else motion.swing
    if swing is None:
        return {}
    free, sound = cautious(swing), np.ones(len(swing), dtype=bool)
    stretches = [
        Stretch(motion.measured[part], motion.desired[part], swing[part], free[part], sound[part])
        for part in np.split(np.arange(len(ticks)), np.flatnonzero(np.diff(ticks) != 1) + 1)
        if len(part) > own.library.window.length + 1
    ]
    if not stretches:
        return {}
    rows = free_rows(robot.leg(leg), own.library, stretches, robot.quantum(leg))
    if len(rows.target) < LEAST_TICKS:
        return {}
    return {
        name: _root(rows.target - rows.theta @ known.model.coefficients)
        for name, known in baseline.legs.items()
        if known.model.library == own.library
    }


def _root(residuals: Array) -> float:
    """Return the root mean square without the largest, which are touches and bad readings."""
    squares = np.sort(np.square(residuals).mean(axis=1))
    return float(np.sqrt(squares[: math.ceil(0.95 * len(squares))].mean()))


def find_exchanged_ids(
    robot: Robot, baseline: Baseline | None, motions: Mapping[str, LegMotion]
) -> dict[str, Owner]:
    """Find legs whose samples are another leg's.

    Returns:
        By the name that samples come under: the leg that they are of.
    """
    known = {} if baseline is None else compare_models(robot, baseline, motions)
    fitted = {leg: owner for leg, owner in known.items() if owner is not None}
    legs = [leg for leg in robot.legs if leg.id in motions]
    if (
        not 3 <= len(legs) <= 6
        or len({leg.joint_axes for leg in legs}) > 1
        or any(leg.chain is None or not leg.chain.is_straight for leg in legs)
        or len({leg.mount for leg in legs}) < len(legs)
    ):
        return fitted
    ticks = control_ticks(motions, robot.period_s)
    walkers = [Walker(leg, motions[leg.id], ticks[leg.id], robot.period_s) for leg in legs]
    feet = _seated(walkers)
    own = range(len(walkers))
    rigid = feet.rigid(own)
    if not fitted and rigid:  # as nearly always
        return {}
    costs = feet.costs(own)
    loose = costs.max(initial=0.0, where=np.isfinite(costs)) >= LOOSE**2
    # Of a robot that hangs nothing shows.
    if not (rigid or loose) or 2 * sum(leg.carries(leg.plain) for leg in walkers) < len(own):
        return fitted
    orders = [order for order in itertools.permutations(own) if feet.rigid(order)]
    if not orders:
        return fitted
    ids = [leg.id for leg in legs]
    named = tuple(ids.index(fitted[leg].leg if leg in fitted else leg) for leg in ids)
    if fitted and named in orders:
        # Two legs may be like two others by chance; their feet then move against the rest.
        return fitted
    orders.sort(key=lambda order: sum(i != k for i, k in enumerate(order)))
    order = orders[0]
    moved = [i for i in own if order[i] != i]
    if any(ids[i] in known and known[ids[i]] is None for i in moved):
        return {}
    mirrored = feet.rigid([len(own) if i in moved else i for i in own])
    placed = {}
    for i in moved:
        why = "feet that stand keep their distances then, and not as the legs are named"
        others = list(dict.fromkeys(ids[one[i]] for one in orders))[1:]
        if others:
            either = " or ".join(f"'{leg}'" for leg in others)
            why += f"; as likely is {either}, with all others turned round as well"
        if mirrored:
            why += "; as likely, the yaw angles grow the wrong way"
        placed[ids[i]] = Owner(ids[order[i]], why)
    return placed


def _seated(legs: Sequence[Walker]) -> Feet:
    """Feet of which each is read as that of another leg's place, by its number.

    With the number that no leg has it stands at its own place, and its yaws have the other sign.
    """

    @functools.cache
    def place(i: int, seat: int) -> Array:
        turned = seat == len(legs)
        at = legs[i if turned else seat]
        yaws = turned & (np.array(at.leg.joint_axes) == "yaw")
        desired = legs[i].motion.desired * np.where(yaws, -1.0, 1.0)
        return at.leg.on_body(at.chain.foot(desired))

    return Feet(legs, legs[0].lag, [leg.plain for leg in legs], place)


def check_recorded_ids(
    robot: Robot, samples: Mapping[str, Sequence[ServoSample]]
) -> dict[str, str]:
    """Write one line for each leg whose recorded samples seem to be another leg's."""
    motions = {leg: LegMotion.from_samples(own[:KEPT]) for leg, own in samples.items() if own}
    return {leg: owner.note for leg, owner in find_exchanged_ids(robot, None, motions).items()}


def _found_ids(
    robot: Robot, baseline: Baseline | None, motions: Mapping[str, LegMotion]
) -> dict[str, Owner | None]:
    return {**dict.fromkeys(motions), **find_exchanged_ids(robot, baseline, motions)}


def watch_ids(robot: Robot, baseline: Baseline | None, refitter: Refitter) -> Watch[Owner]:
    """Make the watch of whose samples come under each leg's name."""
    return Watch(robot, refitter, "*ids", TIMES_S, functools.partial(_found_ids, robot, baseline))
