r"""Finds joints whose angles mean something else than ``robot.toml`` says, from the motion.

Half of all robots count pitch angles downwards, and a leg described so is learned, judged and
driven wrong without any error.  Three facts of a robot's body show it, none of them a model:

1. *Feet that stand do not move against each other* (``rigid.py``).  Needs
   the mounts of three legs; shows signs, the order of joints, and zeros.
2. *A foot that swings is higher than one that stands*, and a foot that stands is below the axis
   that pitches it.  Both turn round with the signs of all pitch joints of a leg.
3. *The ground pushes up.*  Where a leg stands, it is above its command in the direction
   :math:`\partial h/\partial q`.

Only commands are used for 1 and 2: they have no noise, and no drift of a servo changes them.  A
finding needs facts that a right description contradicts *and* another choice that explains them;
all else is no finding: a wrong accusation is worse than silence.

Of chains that are not straight (yaws, then pitches, links along x) the mirror image often walks as
well.  Of these only signs are judged by rigid feet, and what walks as well is named or kept quiet
(:func:`choose_signs`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from adaptive_contact.checks.conventions.motion import LegMotion, control_ticks
from adaptive_contact.checks.conventions.rigid import BETTER, FLOOR, LAG_S, RIGID, Reading
from adaptive_contact.checks.conventions.sign_choices import SURE_SHARE, Chosen, LegChoices
from adaptive_contact.checks.conventions.together import (
    LOOSE,
    OPEN_RAD,
    Pairs,
    choose,
    pairs_of,
)
from adaptive_contact.notes import IN_ORDER, WRONG_WAY, ZEROS
from adaptive_contact.robot.description import AngleFrame, Leg, Mount, Robot, angles_text

__all__ = [
    "Chosen",
    "ConventionFinding",
    "LegMotion",
    "Verdict",
    "choose_signs",
    "judge_hanging",
    "judge_motion",
]

_UPSIDE_DOWN: Final = "the foot is above its axis, and comes down in its swings"
_PUSHED: Final = "the foot is above its axis, and the ground pushes it down"
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
        if other is None or len(other.offsets_rad) != len(self.offsets_rad):
            return False
        apart = [a - b for a, b in zip(self.offsets_rad, other.offsets_rad, strict=True)]
        mine, theirs = (
            (found.leg, found.joints, found.directions, found.order, found.certain, found.grave)
            for found in (self, other)
        )
        return mine == theirs and all(abs(d) < OPEN_RAD for d in apart)

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


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What the motion so far says."""

    # legs that are described wrong, in the robot's order
    findings: tuple[ConventionFinding, ...] = ()
    fits: tuple[str, ...] = ()  # legs whose description the motion confirms


def judge_motion(robot: Robot, motions: Mapping[str, LegMotion]) -> Verdict:
    """Judge signs, order and zeros of all legs that have a geometry.

    Args:
        robot: its description, as the samples were turned by.
        motions: by leg.
    """
    ticks = control_ticks(motions, robot.period_s)
    legs = [
        LegChoices(leg, motions[leg.id], ticks[leg.id], robot.period_s)
        for leg in robot.legs
        if leg.id in ticks and leg.chain is not None and len(ticks[leg.id]) > 1
    ]
    legs = [leg for leg in legs if len(leg.flips) > 1]
    if not legs:
        return Verdict()
    chosen: dict[str, Chosen] = {}
    if sum(leg.mount != Mount() for leg in robot.legs) >= 2:
        straight = [leg for leg in legs if leg.chain.is_straight]
        bent = [leg for leg in legs if not leg.chain.is_straight]
        by_leg = choose(straight, robot.period_s) if straight else {}
        chosen = {leg: Chosen(pattern) for leg, pattern in by_leg.items()}
        chosen |= choose_signs(bent, robot.period_s)
        if not _carried(legs, chosen, robot.period_s):
            chosen = {leg: choice for leg, choice in chosen.items() if choice.pattern == 0}
    findings, fits = [], []
    for leg in legs:
        choice = chosen.get(leg.leg.id) or leg.alone()
        if choice is not None and choice.pattern == 0:
            fits.append(leg.leg.id)
        elif choice is not None:
            findings.append(_finding(leg, choice))
    return Verdict(tuple(findings), tuple(fits))


def judge_hanging(robot: Robot, motions: Mapping[str, LegMotion]) -> Verdict:
    """Judge the signs of legs that hang free, from what gravity does to them at rest.

    A servo holds a leg a little below its command.  The first pitch joint carries the most: an
    AX-12A gives way by four to five steps there, and by less than its friction at the next one, so
    that a single sign further out is not shown.  A servo with an integral gain does not give way.

    Args:
        robot: its description, as the samples were turned by.
        motions: by leg; holds of 0.36 s and more are looked at.
    """
    findings, fits = [], []
    ticks = control_ticks(motions, robot.period_s)
    for leg in robot.legs:
        if leg.id not in motions or leg.chain is None or len(ticks.get(leg.id, ())) < 2:
            continue
        if not leg.chain.is_straight:
            continue
        choices = LegChoices(leg, motions[leg.id], ticks[leg.id], robot.period_s)
        sags = choices.sags_rad()
        # Holds of a leg that hangs before their sag counts, and how far it must be, steps of the
        # servo.
        if len(sags) < 4 or abs(float(np.median(sags))) < 1.5 * robot.quantum(leg.id):
            continue
        down = float(np.mean(sags > 0))
        if down >= SURE_SHARE:
            fits.append(leg.id)
        elif down <= 1 - SURE_SHARE:
            signs = [-1 if lifts else 1 for lifts in choices.lifts]
            findings.append(
                _sign_finding(
                    leg,
                    signs,
                    "the foot hangs above its command at rest, and gravity pulls it down",
                )
            )
    return Verdict(tuple(findings), tuple(fits))


def _carried(legs: Sequence[LegChoices], chosen: Mapping[str, Chosen], period_s: float) -> bool:
    """Whether half of the feet carry where they stand; of a robot that hangs nothing shows."""
    lag = max(round(LAG_S / period_s), 1)
    patterns = [chosen[leg.leg.id].pattern if leg.leg.id in chosen else 0 for leg in legs]
    if not any(patterns):
        return True
    carry = [leg.carries(k, lag) for leg, k in zip(legs, patterns, strict=True)]
    return 2 * sum(carry) >= len(carry)


def _finding(leg: LegChoices, choice: Chosen) -> ConventionFinding:
    """What a pattern that is not the described one means, with what to write."""
    reading, *others = (leg.readings[k] for k in (choice.pattern, *choice.others))
    plain = Reading.plain(len(leg.leg.joints))
    if reading.order != plain.order:
        return _order_finding(leg.leg, reading)
    if any(reading.offsets_rad):
        return _zero_finding(leg, reading)
    reason = _PUSHED if choice.pushed else _UPSIDE_DOWN if leg.upside_down(0) else _AGAINST
    turned = [other.directions for other in others]
    return _sign_finding(leg.leg, reading.directions, reason, turned)


def _order_finding(leg: Leg, reading: Reading) -> ConventionFinding:
    """The finding of an order that is not ``joints``'."""
    frame = AngleFrame(leg)
    came = [leg.joints[reading.order.index(k)] for k in range(len(leg.joints))]
    moved = tuple(name for k, name in enumerate(leg.joints) if reading.order[k] != k)
    advice = f"publish measured, desired and valid in the order {', '.join(leg.joints)}"
    if any(sign < 0 for sign in reading.directions):
        turned = _listed([n for n, s in zip(leg.joints, reading.directions, strict=True) if s < 0])
        advice += f"; then look at the signs of {turned}"
    message = f"the joints {IN_ORDER}: they seem to come as {', '.join(came)}; {_AGAINST}"
    return ConventionFinding(
        leg.id,
        moved,
        message,
        advice,
        tuple(frame.directions),
        tuple(frame.offsets_rad),
        order=reading.order,
    )


def _zero_finding(leg: LegChoices, reading: Reading) -> ConventionFinding:
    """The finding of zeros, and signs with them, that are not the convention's."""
    frame = AngleFrame(leg.leg)
    moved = zip(leg.leg.joints, reading.directions, reading.offsets_rad, strict=True)
    off = [(name, sign, offset) for name, sign, offset in moved if offset or sign < 0]
    directions = tuple(s * d for s, d in zip(reading.directions, frame.directions, strict=True))
    offsets = tuple(
        s * o + p
        for s, o, p in zip(reading.directions, frame.offsets_rad, reading.offsets_rad, strict=True)
    )
    zeros = _listed([f"{name} by {offset:+.2f} rad" for name, _, offset in off if offset])
    turned = [name for name, sign, _ in off if sign < 0]
    grows = f", and the angles of {_listed(turned)} {WRONG_WAY}" if turned else ""
    message = f"{ZEROS}: {zeros}{grows}; {_AGAINST}"
    advice = "write " + angles_text(directions, offsets, "[leg.angles]")
    advice += (
        "; zeros are found to some 0.05 rad; where they are right, measure lengths_m and mount"
    )
    return ConventionFinding(
        leg.leg.id,
        tuple(name for name, _, _ in off),
        message,
        advice,
        directions,
        offsets,
        grave=bool(turned) or not leg.sane(0),
    )


def _sign_finding(
    leg: Leg, signs: Sequence[int], reason: str, others: Sequence[Sequence[int]] = ()
) -> ConventionFinding:
    """The finding of wrong signs, with what to write; directions in force are taken along."""
    frame = AngleFrame(leg)
    joints = tuple(name for name, sign in zip(leg.joints, signs, strict=True) if sign < 0)
    directions = tuple(s * d for s, d in zip(signs, frame.directions, strict=True))
    offsets = tuple(s * o + 0.0 for s, o in zip(signs, frame.offsets_rad, strict=True))
    advice = "write " + angles_text(directions, offsets, "[leg.angles]")
    for other in others:
        turned = [s * d for s, d in zip(other, frame.directions, strict=True)]
        advice += f"; if that does not help, directions = {turned}"
    message = f"the angles of {_listed(joints)} {WRONG_WAY}: {reason}"
    assert leg.chain is not None
    lifting = {name for name, lifts in zip(leg.joints, leg.chain.lifts, strict=True) if lifts}
    return ConventionFinding(
        leg.id,
        joints,
        message,
        advice,
        directions,
        offsets,
        certain=not others,
        # A wrong yaw alone changes no height.
        grave=bool(lifting & set(joints)),
    )


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def choose_signs(legs: Sequence[LegChoices], period_s: float) -> dict[str, Chosen]:
    """Choose the signs that explain how legs walk whose mirror image walks as well.

    A leg that hangs down with a hip that rolls is its own mirror image: all its pitches turned
    round, the foot has the same height and goes the other way, and feet that stand are as rigid
    wherever the robot walks straight on.  So of all choices only those are looked at that a hand
    makes: the same joints of all legs, of one side, of one end, or of one leg.  Those that explain
    the motion equally well are reported together, and a description among them is not accused.

    Args:
        legs: of one kind.
        period_s: the control tick.

    Returns:
        By leg, empty for none: of every leg the description's pattern where it explains the
        motion and no other does; of the legs concerned another one where the description does not.
    """
    if len(legs) < 2 or len({leg.leg.joint_axes for leg in legs}) > 1:
        return {}
    described = (0,) * len(legs)
    pairs, _ = pairs_of(legs, period_s, 1)
    before = _cost(pairs, described)
    tried = {}
    for chosen in dict.fromkeys(_by_hand(legs)):
        if all(leg.may_move(pattern) for leg, pattern in zip(legs, chosen, strict=True)):
            tried[chosen] = _cost(pairs, chosen)
    best = min(tried, key=lambda chosen: tried[chosen], default=described)
    least = max(tried.get(best, np.inf), FLOOR**2)
    if least >= RIGID**2:
        return {}
    # What is nearly as good; what a hand changes least comes first.
    rivals = [c for c, cost in tried.items() if cost < BETTER * least and c != best]
    if described == best or described in rivals:
        return {} if rivals else {leg.leg.id: Chosen(0) for leg in legs}
    sane = all(leg.sane(0) for leg in legs)
    # More choices than these explain a motion that shows nothing.
    if len(rivals) > 2 or before < (LOOSE**2 if sane else BETTER * least):
        return {}
    found = {}
    for k, leg in enumerate(legs):
        others = tuple(dict.fromkeys(rival[k] for rival in rivals if rival[k] != best[k]))
        if best[k]:
            found[leg.leg.id] = Chosen(best[k], others)
    return found


def _cost(pairs: Pairs, chosen: Sequence[int]) -> float:
    """rho² of the worst leg; infinite where one stands with no other."""
    # Of legs whose mirror image walks as well: feet of a trot stand two at a time.
    return max(pairs.cost(chosen, k, 1) for k in range(len(chosen)))


def _by_hand(legs: Sequence[LegChoices]) -> Iterator[tuple[int, ...]]:
    """The choices that are looked at, a pattern for each leg; the described one is the first."""
    at = np.array([leg.leg.mount.xyz_m for leg in legs])
    groups = [np.ones(len(legs), dtype=bool)]
    for axis in (1, 0):
        groups += [at[:, axis] > 0.0, at[:, axis] < 0.0]
    groups += list(np.eye(len(legs), dtype=bool))
    for group in groups:
        for pattern in range(len(legs[0].flips)):
            yield tuple(pattern if moved else 0 for moved in group)
