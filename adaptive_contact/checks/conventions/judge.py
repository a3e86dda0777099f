r"""Finds joints whose angles mean something else than ``robot.toml`` says, from the motion.

Half of all robots count pitch angles downwards, and a leg described so is learned, judged and
driven wrong without any error.  Three facts of a robot's body show it, none of them a model:

1. *Feet that stand do not move against each other* (``feet.py``).  Needs the
   mounts of three legs; shows signs, the order of joints, and zeros.
2. *A foot that swings is higher than one that stands*, and a foot that stands is below the axis
   that pitches it.  Both turn round with the signs of all pitch joints of a leg.
3. *The ground pushes up.*  Where a leg stands, it is above its command in the direction
   :math:`\partial h/\partial q`.

Only commands are used for 1 and 2: they have no noise, and no drift of a servo changes them.  A
finding needs facts that a right description contradicts *and* another choice that explains them;
all else is no finding: a wrong accusation is worse than silence.

Of chains that are not straight (yaws, then pitches, links along x) the mirror image often walks as
well.  Of these only signs are judged by rigid feet, and what walks as well is named or kept quiet
(``search.py``).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.checks.conventions.feet import SURE_SHARE, Reading, Walker
from adaptive_contact.checks.conventions.search import OPEN_RAD, Chosen, Search
from adaptive_contact.checks.motion import LegMotion, control_ticks
from adaptive_contact.notes import IN_ORDER, WRONG_WAY, ZEROS
from adaptive_contact.robot.description import AngleFrame, Leg, Mount, Robot, angles_text

_UPSIDE_DOWN: Final = "the foot is above its axis, and comes down in its swings"
_PUSHED: Final = "the foot is above its axis, and the ground pushes it down"
_HANGS: Final = "the foot hangs above its command at rest, and gravity pulls it down"
_AGAINST: Final = "feet that stand move against each other, as they are described"


@dataclasses.dataclass(frozen=True)
class ConventionFinding:
    """One leg whose angles do not mean what its description says."""

    leg: str  # its id
    joints: tuple[str, ...]  # names of the joints concerned
    message: str  # what was seen, one line without the leg's name
    advice: str  # what to write into ``robot.toml``, one line
    # (J,) to write as ``[leg.angles] directions``; those in force included
    directions: tuple[int, ...]
    offsets_rad: tuple[float, ...]  # (J,) likewise
    certain: bool = True  # False where another choice explains the motion as well
    # heights of the foot are wrong, so that nothing can be judged or learned by them
    grave: bool = True
    # (J,) which of the source's values is each joint's; None where they come in order
    order: tuple[int, ...] | None = None

    def agrees(self, other: ConventionFinding | None) -> bool:
        """Whether another judgement has found the same, but for what a fit of zeros leaves open."""
        if other is None:
            return False
        mine, theirs = (
            dataclasses.replace(f, offsets_rad=(), message="", advice="") for f in (self, other)
        )
        return mine == theirs and bool(
            np.allclose(self.offsets_rad, other.offsets_rad, rtol=0.0, atol=OPEN_RAD)
        )

    def line(self, leg: Leg) -> str:
        """What was seen and what to write, for samples of any source."""
        text = f"{self.message}: {self.advice}"
        if leg.servos is not None:  # the bridge refuses a leg with [leg.angles]
            text += f" (where the bridge reads this leg, {self.servo_advice(leg)})"
        return text

    def servo_advice(self, leg: Leg) -> str:
        """The same for a leg that the bridge reads, whose signs stand in ``[leg.servos]``."""
        servos, joints = leg.servos, len(leg.joints)
        if self.order is not None:
            ids = servos.ids if servos else tuple(range(1, joints + 1))
            return f"write [leg.servos] ids = {[ids[k] for k in self.order]}"
        directions = (servos.directions if servos else None) or (1,) * joints
        offsets = (servos.offsets_rad if servos else None) or (0.0,) * joints
        return "write " + angles_text(
            [sign * d for sign, d in zip(self.directions, directions, strict=True)],
            [s * o + p for s, o, p in zip(self.directions, offsets, self.offsets_rad, strict=True)],
            "[leg.servos]",
        )


# By leg: what is wrong with its description; None where the motion confirms it.
Findings = dict[str, ConventionFinding | None]


def check_motion(robot: Robot, motions: Mapping[str, LegMotion]) -> Findings:
    """Judge signs, order and zeros of all legs that have a geometry.

    Args:
        robot: its description, as the samples were turned by.
        motions: by leg.

    Returns:
        In the robot's order, without the legs of which the motion shows nothing.
    """
    legs = [leg for leg in _walkers(robot, motions) if len(leg.signs) > 1]
    chosen: dict[str, Chosen] = {}
    if sum(leg.mount != Mount() for leg in robot.legs) >= 2:
        straight = [leg for leg in legs if leg.chain.is_straight]
        bent = [leg for leg in legs if not leg.chain.is_straight]
        if straight:
            chosen |= Search(straight, robot.period_s, 2).choose()
        if len(bent) > 1:
            # Feet of a trot stand two at a time.
            chosen |= Search(bent, robot.period_s, 1).signs()
        described = {leg.leg.id: Chosen(leg.plain) for leg in legs}
        carry = [leg.carries((described | chosen)[leg.leg.id].reading) for leg in legs]
        # Half of the feet carry where they stand; of a robot that hangs nothing shows.
        if 2 * sum(carry) < len(carry):
            chosen = {leg: c for leg, c in chosen.items() if c.reading == described[leg].reading}
    found = {}
    for leg in legs:
        choice = chosen.get(leg.leg.id) or _alone(leg)
        if choice is not None:
            turned = leg.motion.swing is not None and leg.upside_down()
            reason = _PUSHED if choice.pushed else _UPSIDE_DOWN if turned else _AGAINST
            found[leg.leg.id] = _finding(leg, choice.reading, reason, choice.others)
    return found


def check_hanging(robot: Robot, motions: Mapping[str, LegMotion]) -> Findings:
    """Judge the signs of legs that hang free, from what gravity does to them at rest.

    A servo holds a leg a little below its command: an AX-12A gives way by four to five steps at the
    joint that carries the most, and by less than its friction at the next one, so that a single
    sign is not shown.  A servo with an integral gain does not give way.

    Args:
        robot: its description, as the samples were turned by.
        motions: by leg; holds of 0.36 s and more are looked at.
    """
    found = {}
    for leg in _walkers(robot, motions):
        up_m = leg.up_at_rest_m()
        # Holds of a leg that hangs before they count, and how far from their commands they must be,
        # steps of the servo at the whole leg.
        least_m = 1.5 * robot.quantum(leg.leg.id) * leg.chain.reach_m
        if not leg.chain.is_straight or len(up_m) < 4 or abs(float(np.median(up_m))) < least_m:
            continue
        down = float(np.mean(up_m < 0.0))
        turned = leg.plain._replace(directions=_lifts_turned(leg))
        if not 1 - SURE_SHARE < down < SURE_SHARE:
            found[leg.leg.id] = _finding(leg, leg.plain if down > 0.5 else turned, _HANGS)
    return found


def _walkers(robot: Robot, motions: Mapping[str, LegMotion]) -> list[Walker]:
    """The legs that have a geometry and have moved."""
    ticks = control_ticks(motions, robot.period_s)
    return [
        Walker(leg, motions[leg.id], ticks[leg.id], robot.period_s)
        for leg in robot.legs
        if leg.chain is not None and len(ticks.get(leg.id, ())) > 1
    ]


def _lifts_turned(leg: Walker) -> tuple[int, ...]:
    """Directions of a leg all of whose pitches are turned round."""
    return tuple(-1 if lifts else 1 for lifts in leg.chain.lifts)


def _alone(leg: Walker) -> Chosen | None:
    """What a leg shows by itself; None for nothing that is sure."""
    if not leg.upside_down():
        return None
    pushed = leg.motion.swing is None
    yaws = np.flatnonzero(~leg.chain.lifts)
    lifting = [r for r in leg.signs if all(r.directions[j] > 0 for j in yaws)]
    left = [r for r in lifting if leg.sane(r, 0.5) and leg.within(r)]
    # That all of them are turned round is the usual case: half of all robots are.
    left.sort(key=lambda reading: reading.directions != _lifts_turned(leg))
    best = next((reading for reading in left if leg.sane(reading)), None)
    if best is None or (pushed and not leg.carries(best)):
        return None
    return Chosen(best, tuple(reading for reading in left if reading != best), pushed)


def _finding(
    walker: Walker, reading: Reading, reason: str, others: Sequence[Reading] = ()
) -> ConventionFinding | None:
    """What a reading means, with what to write; None for the described one.

    Directions and offsets in force are taken along.
    """
    if reading == walker.plain:
        return None
    leg, frame, names = walker.leg, AngleFrame(walker.leg), walker.leg.joints
    wrong = list(zip(names, reading.directions, reading.offsets_rad, strict=True))
    turned = [name for name, sign, _ in wrong if sign < 0]
    lifting = {name for name, lifts in zip(names, walker.chain.lifts, strict=True) if lifts}
    if reading.order != walker.plain.order:
        came = ", ".join(names[reading.order.index(k)] for k in range(len(names)))
        advice = f"publish measured, desired and valid in the order {', '.join(names)}"
        if turned:
            advice += f"; then look at the signs of {_listed(turned)}"
        return ConventionFinding(
            leg.id,
            tuple(name for k, name in enumerate(names) if reading.order[k] != k),
            f"the joints {IN_ORDER}: they seem to come as {came}; {_AGAINST}",
            advice,
            tuple(frame.directions),
            tuple(frame.offsets_rad),
            order=reading.order,
        )
    shifted = [f"{name} by {offset:+.2f} rad" for name, _, offset in wrong if offset]
    signs, zeros = reading.directions, reading.offsets_rad
    directions = tuple(s * d for s, d in zip(signs, frame.directions, strict=True))
    offsets = tuple(s * o + p for s, o, p in zip(signs, frame.offsets_rad, zeros, strict=True))
    advice = "write " + angles_text(directions, offsets, "[leg.angles]")
    grow = f"the angles of {_listed(turned)} {WRONG_WAY}" if turned else ""
    message = f"{grow}: {reason}"
    if shifted:
        message = f"{ZEROS}: {_listed(shifted)}{', and ' if turned else ''}{grow}; {_AGAINST}"
        advice += (
            "; zeros are found to some 0.05 rad; where they are right, measure lengths_m and mount"
        )
    for other in others:
        rival = [s * d for s, d in zip(other.directions, frame.directions, strict=True)]
        advice += f"; if that does not help, directions = {rival}"
    return ConventionFinding(
        leg.id,
        tuple(name for name, sign, offset in wrong if sign < 0 or offset),
        message,
        advice,
        directions,
        offsets,
        certain=not others,
        # A wrong yaw alone changes no height, nor does a zero that is a little off.
        grave=bool(lifting & set(turned)) or (bool(shifted) and not walker.sane(walker.plain)),
    )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
