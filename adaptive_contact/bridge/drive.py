"""From commands to goals: never a movement that nobody asked for.

A leg that has had no command yet gets no goal.  Its first command leads it from where it stands
(the goal in force, or without torque its position), at an easy pace, to where the command wants
it; from there it follows, within its limits and at most one step a tick.  Without a command for
200 ms it holds the last goal, and whatever comes next starts with the easy pace again.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Collection, Sequence
from typing import Final

from adaptive_contact.bridge.plan import LegPlan
from adaptive_contact.wire import MAX_PREVIEW_TICKS, Command

__all__ = ["HOLD_AFTER_NS", "Driver", "Mode", "complaint"]

HOLD_AFTER_NS: Final = 200_000_000
# Share of the largest step while a leg comes to its first command: 0.03 of 0.15 rad a tick.
EASY_SHARE: Final = 0.2


class Mode(enum.StrEnum):
    """What a leg does."""

    IDLE = "idle"
    APPROACHING = "approaching"
    FOLLOWING = "following"
    HOLDING = "holding"


class Driver:
    """One leg's goals.

    Args:
        leg: its servos and limits.

    Attributes:
        mode: what the leg does.
        goal: (J,) rad, in force; None before the first command.
        limited: commands that asked for more than limits or step allow.
        bounds: (J,) lower and upper limit, rad: the plan's, or what the servos take, if less.
        preview: goals of the ticks to come, as far as this tick's command told of them and they
            will be followed to the letter but for the limits; None otherwise.
    """

    def __init__(self, leg: LegPlan) -> None:
        self.leg = leg
        self.mode = Mode.IDLE
        self.goal: list[float] | None = None
        self.limited = 0
        self.bounds = [(joint.lower_rad, joint.upper_rad) for joint in leg.joints]
        self.preview: list[list[float]] | None = None
        self._command: list[float] | None = None
        self._ahead: list[list[float]] | None = None
        self._heard_ns = 0

    def forget(self) -> None:
        """Start over: the servos may have been moved, or have lost their goals."""
        self.mode = Mode.IDLE
        self.goal = self.preview = None
        self._command = self._ahead = None

    def found(self, joint: int, angle_rad: float) -> None:
        """Go on from where a servo was found, at an easy pace: it was silent, limp, or moved.

        It may have lost its power and its place meanwhile; the whole leg comes to its command at
        an easy pace again.
        """
        if self.goal is None:
            return
        self.goal[joint] = angle_rad
        if self.mode is Mode.FOLLOWING:
            self.mode = Mode.APPROACHING

    def hear(self, command: Command, arrival_ns: int) -> None:
        """Take in a command that :func:`complaint` has nothing to say of."""
        self._command = list(command.desired)
        self._ahead = command.preview
        self._heard_ns = arrival_ns

    def is_asked(self, now_ns: int) -> bool:
        """Whether there is a command to be followed."""
        return self._command is not None and now_ns - self._heard_ns <= HOLD_AFTER_NS

    def step(
        self, start: Sequence[float | None], now_ns: int, absent: Collection[int] = ()
    ) -> list[float] | None:
        """The goals to write in this tick.

        Args:
            start: (J,) rad, where a first command leads on from: the goal in force, or the
                position of a servo without torque; None where that is not known.
            now_ns: monotonic.
            absent: joints whose servo is silent or shut down.  The leg begins without them; the
                goals returned for them mean nothing until :meth:`found` says where they are.

        Returns:
            (J,) rad, or None when nothing is to be written.
        """
        # A preview is of the tick its command came in; a tick later it would be one tick off.
        ahead, self._ahead, self.preview = self._ahead, None, None
        if self._command is None:
            return None
        if not self.is_asked(now_ns):
            self.mode = Mode.HOLDING
            return None
        if self.mode in (Mode.IDLE, Mode.HOLDING):
            if self.goal is None:
                unknown = {j for j, angle in enumerate(start) if angle is None}
                if len(unknown) == len(start) or not unknown.issubset(absent):
                    return None  # from where to go is not known
                self.goal = [
                    want if angle is None else angle
                    for angle, want in zip(start, self._command, strict=True)
                ]
            self.mode = Mode.APPROACHING
        easy = self.mode is Mode.APPROACHING
        largest = self.leg.max_step_rad * (EASY_SHARE if easy else 1.0)
        assert self.goal is not None
        goal, arrived, limited = self._toward(self._command, self.goal, largest)
        self.limited += limited or not (arrived or easy)
        if easy and arrived:
            self.mode = Mode.FOLLOWING
        self.goal = goal
        if ahead is not None and self.mode is Mode.FOLLOWING and arrived and not limited:
            rows, last = [], goal
            for wanted in ahead:
                last, _, _ = self._toward(wanted, last, self.leg.max_step_rad)
                rows.append(last)
            self.preview = rows
        return goal

    def _toward(
        self, wanted: Sequence[float], start: Sequence[float], largest: float
    ) -> tuple[list[float], bool, bool]:
        """One tick's goals; whether they arrive, and whether limits cut them down."""
        goal, arrived, limited = [], True, False
        for now, want, (lower, upper) in zip(start, wanted, self.bounds, strict=True):
            # A joint found outside its limits may stay, or move inwards; never further out.
            target = min(max(want, min(lower, now)), max(upper, now))
            limited |= target != want
            step = min(max(target - now, -largest), largest)
            arrived &= step == target - now
            goal.append(now + step)
        return goal, arrived, limited


def complaint(command: Command, joints: int) -> str | None:
    """Why a command cannot be used, or None."""
    if len(command.desired) != joints:
        return f"desired has {len(command.desired)} values for {joints} joints"
    if not all(math.isfinite(x) for x in command.desired):
        return "desired is not finite"
    preview = command.preview or ()
    if len(preview) > MAX_PREVIEW_TICKS:
        return f"preview has {len(preview)} ticks; {MAX_PREVIEW_TICKS} at most"
    for row in preview:
        if len(row) != joints or not all(math.isfinite(x) for x in row):
            return f"preview has a row that is not {joints} finite values"
    return None
