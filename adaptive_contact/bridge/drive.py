"""Turns commands into goals: never a movement that no command asked for.

When a leg moves, at which pace, and what must have been read before a servo is written a goal:
docs/bridge.md, "Observe and drive"; why: decision 25.

An alarm that the servo's shutdown register names switches its drive off for good.  An AX, RX, MX
or XL-320 servo sets its torque limit to 0, and drives again as soon as that is written; an X-series
one, or an MX with protocol 2.0, switches its torque off and stays so until a reboot.  What wakes a
Feetech servo is not documented: it is taken for shut down as long as its status says so.

Source: ROBOTIS e-manual, AX-12A "Shutdown (18)", XL-320 "Shutdown(18)", XL330-M288 "Shutdown (63)".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Final, Literal, NamedTuple

from adaptive_contact.bridge.modes import Setting, setting
from adaptive_contact.bridge.plan import JointPlan, LegPlan
from adaptive_contact.bridge.tables import Block, ServoModel
from adaptive_contact.wire import MAX_PREVIEW_TICKS, Command

HOLD_AFTER_NS: Final = 200_000_000
# Share of the largest step while a leg comes to its first command: 0.03 of 0.15 rad a tick.
EASY_SHARE: Final = 0.2
# Errors that shut an STS servo down as delivered: overheating, overcurrent, overload.
_FATAL: Final = 0x2C


# What a leg does.
Mode = Literal["idle", "approaching", "following", "holding"]


class Driver:
    """Computes one leg's goals.

    Attributes:
        mode: what the leg does.
        goal: (J,) rad, in force; None before the first command.
        limited: commands that asked for more than limits or step allow.
        bounds: (J,) lower and upper limit, rad: the plan's, or what the servos take, if less.
        preview: goals of the ticks to come, as far as this tick's command gave them and only the
            limits may change them; None otherwise.
    """

    def __init__(self, leg: LegPlan) -> None:
        self.leg = leg
        self.limited = 0
        self.bounds = [(joint.lower_rad, joint.upper_rad) for joint in leg.joints]
        self.forget()

    def forget(self) -> None:
        """Start over: the servos may have been moved, or have lost their goals."""
        self.mode: Mode = "idle"
        self.goal: list[float] | None = None
        self.preview: list[list[float]] | None = None
        self._command: list[float] | None = None
        self._ahead: list[list[float]] | None = None
        self._heard_ns = 0

    def found(self, joint: int, angle_rad: float) -> None:
        """Continue from where a servo was found, at the slow pace: it was silent, limp, or moved.

        It may have lost its power and its place meanwhile; the whole leg comes to its command at
        an easy pace again.
        """
        if self.goal is None:
            return
        self.goal[joint] = angle_rad
        if self.mode == "following":
            self.mode = "approaching"

    def receive(self, command: Command, arrival_ns: int) -> None:
        """Take in a command that :func:`complaint` has nothing to say of."""
        self._command = list(command.desired)
        self._ahead = command.preview
        self._heard_ns = arrival_ns

    def is_asked(self, now_ns: int) -> bool:
        """Return whether there is a command to be followed."""
        return self._command is not None and now_ns - self._heard_ns <= HOLD_AFTER_NS

    def step(
        self, start: Sequence[float | None], now_ns: int, absent: Collection[int] = ()
    ) -> list[float] | None:
        """Compute the goals to write in this tick.

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
            self.mode = "holding"
            return None
        if self.mode in ("idle", "holding"):
            if self.goal is None:
                unknown = {j for j, angle in enumerate(start) if angle is None}
                if len(unknown) == len(start) or not unknown.issubset(absent):
                    return None  # from where to go is not known
                self.goal = [
                    want if angle is None else angle
                    for angle, want in zip(start, self._command, strict=True)
                ]
            self.mode = "approaching"
        easy = self.mode == "approaching"
        largest = self.leg.max_step_rad * (EASY_SHARE if easy else 1.0)
        assert self.goal is not None
        goal, arrived, limited = self._toward(self._command, self.goal, largest)
        self.limited += limited or not (arrived or easy)
        if easy and arrived:
            self.mode = "following"
        self.goal = goal
        if ahead is not None and self.mode == "following" and arrived and not limited:
            rows, last = [], goal
            for wanted in ahead:
                last, _, _ = self._toward(wanted, last, self.leg.max_step_rad)
                rows.append(last)
            self.preview = rows
        return goal

    def _toward(
        self, wanted: Sequence[float], start: Sequence[float], largest: float
    ) -> tuple[list[float], bool, bool]:
        """Compute one tick's goals, whether they arrive, and whether limits cut them down."""
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
    """Return why a command cannot be used, or None."""
    rows = [command.desired, *(command.preview or ())]
    if len(rows) > MAX_PREVIEW_TICKS + 1:
        return f"preview has {len(rows) - 1} ticks; {MAX_PREVIEW_TICKS} at most"
    for row in rows:
        if len(row) != joints or not all(math.isfinite(x) for x in row):
            return f"a row has {len(row)} values; expected {joints} finite ones"
    return None


class Standing(NamedTuple):
    """Describes a servo's state: torque, faults."""

    torque: bool  # it drives to its goal
    shut: bool = False  # it has shut itself down
    # names of what is behind the alert of protocol 2.0, where the block holds them
    alarms: tuple[str, ...] = ()


def standing(model: ServoModel, block: Block, data: bytes, fatal: int = _FATAL) -> Standing:
    """Parse a servo's state from a block that holds the model's ``state`` or ``watched``.

    Args:
        model: what it is.
        block: the registers.
        data: their bytes.
        fatal: errors that shut a Feetech servo down, where the block does not hold them.
    """

    def known(name: str, otherwise: int) -> int:
        register = model.registers.get(name)
        if register is None or not block.holds(register):
            return otherwise
        return block.part(data, register)

    torque = known("torque_enable", 0) == 1
    errors, limit = known("hardware_error", 0), known("torque_limit", 1)
    alarms = tuple(name for bit, name in model.error_bits.items() if errors & bit)
    shuts = bool(errors & known("shutdown", fatal))
    if model.compact:
        return Standing(torque and limit > 0, limit == 0 or (model.feetech and shuts), alarms)
    return Standing(torque, not torque and shuts, alarms)


class Place(NamedTuple):
    """Holds from where a servo can be moved."""

    steps: int  # the goal in force where it has torque, else its position
    torque: bool  # it drives
    at_goal: bool  # without torque, the goal register holds where it is


# What the goal register held, compared with what was written.
GoalRegister = Literal["taken", "lost", "foreign"]


class Waker:
    """Judges from one servo's readings whether, and from where, it may be moved.

    Args:
        joint: the servo.
        max_step_rad: how far a goal may move in one tick.

    Attributes:
        setting: how it is set; None until its registers were read twice alike.
        awake: its torque was seen, and its goals are ours.
        trouble: why it is not moved, in words; None where it may be.
    """

    def __init__(self, joint: JointPlan, max_step_rad: float) -> None:
        self.trouble: str | None = None
        self._joint = joint
        self._first: dict[str, int] | None = None
        self._most = max(1, math.floor(max_step_rad / joint.model.step_rad + 1e-9))
        easy = int(EASY_SHARE * max_step_rad / joint.model.step_rad)
        # A goal this close to where a servo is, or within one step of the easy pace, is where it
        # is.
        self._near = min(max(2, easy), self._most)
        self._lost: int | None = None
        self.forget()

    def forget(self) -> None:
        """Start over: the servo may have lost its power, or be another one."""
        self.setting: Setting | None = None
        self.awake = False
        self._proof: list[bytes] = []
        self._written: int | None = None
        self._before: int | None = None
        self._heedless = 0

    @property
    def wanted(self) -> Block | None:
        """Return which settings to read next, all of them twice; None where they are known."""
        blocks = self._joint.model.settings
        return None if self.setting is not None else blocks[len(self._proof) % len(blocks)]

    def learn(self, data: bytes) -> None:
        """Take in the bytes of :attr:`wanted`."""
        blocks = self._joint.model.settings
        self._proof.append(data)
        if len(self._proof) < 2 * len(blocks):
            return
        once, twice = self._proof[: len(blocks)], self._proof[len(blocks) :]
        self._proof.clear()
        if once != twice:
            return  # read again
        self.setting = setting(self._joint.model, once)
        self._first = self._first or self.setting.values

    @property
    def fatal(self) -> int:
        """Return the errors that shut it down, as far as it has reported them."""
        return _FATAL if self.setting is None else self.setting.values.get("shutdown", _FATAL)

    def bounds(self) -> tuple[float, float]:
        """Return the range of its goals, rad: robot.toml's limits within the servo's own."""
        assert self.setting is not None
        one, other = (self._joint.angle(s) for s in (self.setting.lowest, self.setting.highest))
        lower = max(self._joint.lower_rad, min(one, other))
        return lower, min(self._joint.upper_rad, max(one, other))

    def find_start(self, stands: Standing | None, steps: int, goal: int) -> Place | None:
        """Find the place it can be moved from, by one tick's readings; else None and ``trouble``.

        Args:
            stands: how it stands; None where that was not read.
            steps: position.
            goal: register.
        """
        if stands is None or stands.shut or self.setting is None:
            return None
        if self.awake and not stands.torque:
            self.forget()  # it has lost its power, or was let go, and perhaps set differently
            return None
        before, self.trouble = self.trouble, self._complaint()
        if self.trouble is not None:
            return None
        at = goal if stands.torque else steps
        low, high = self.setting.lowest, self.setting.highest
        misplaced = self._misplaced(at, stands.torque)
        if misplaced is not None:
            # One line, not one for every step that it is turned by hand.
            kind = misplaced.split(" at ")[0]
            self.trouble = before if before and before.startswith(kind) else misplaced
            return None
        # A servo whose goal register has not taken what was written for so many ticks takes
        # nothing.
        if self._heedless >= 25:
            self.trouble = (
                "does not take the goals that are written; check its bus watchdog, and whether "
                "another program writes to this bus"
            )
        if stands.torque:
            return Place(at, True, True)
        at = min(max(at, low), high)
        return Place(at, False, abs(goal - steps) <= self._near)

    def compare(self, goal: int) -> GoalRegister:
        """Compare the goal register read now with the last write."""
        before, self._before = self._before, goal
        written, self._written, self._lost = self._written, None, None
        if goal == written or (written is None and (goal == before or not self.awake)):
            self._heedless = 0
            return "taken"
        if before is None:
            return "foreign"
        self._heedless += 1
        if goal != before:
            return "foreign"
        self._lost = written
        return "lost"

    def step(self, place: Place, angle_rad: float) -> int:
        """Compute the goal to write for an angle: at most one step from the goal in force.

        Where the register does not hold what was written, the write was lost, or the reading is an
        old one: one step from both.
        """
        assert self.setting is not None
        goals = [place.steps]
        if self._lost is not None and abs(self._lost - place.steps) <= self._most:
            goals.append(self._lost)
        steps = max(self._joint.steps(angle_rad), max(goals) - self._most)
        steps = min(steps, min(goals) + self._most)
        return self.wrote(min(max(steps, self.setting.lowest), self.setting.highest))

    def wrote(self, goal: int) -> int:
        """Store what is written, to compare it with the register in the next tick."""
        self._written = goal
        return goal

    def _misplaced(self, at: int, torque: bool) -> str | None:
        """Return why a servo cannot be moved from where it is."""
        assert self.setting is not None
        low, high = self.setting.lowest, self.setting.highest
        if not low - self._near <= at <= high + self._near:
            what = "is held" if torque else "stands"
            return (
                f"{what} at {at}, outside of its {low} to {high}: switch its power off, turn it "
                "back by hand, and on again; or correct its limits"
            )
        ends = self.setting.ends
        if not torque and ends and min(abs(at - end) for end in ends) <= self._near:
            return (
                f"stands at {at}, where its encoder ends ({ends[0]} and {ends[1]}), so that its "
                "place is not sure: turn it a little by hand, away from there"
            )
        return None

    def _complaint(self) -> str | None:
        assert self.setting is not None
        if self.setting.wrong or self.setting.undriven:
            return self.setting.wrong or self.setting.undriven
        lower, upper = self.bounds()
        if lower >= upper:
            return (
                f"takes goals from {self.setting.lowest} to {self.setting.highest}, none of which "
                "is within the limits of robot.toml; correct one of the two"
            )
        changed = [
            f"{name.replace('_', ' ')} {value}, was {self._first[name]}"
            for name, value in self.setting.values.items()
            if self._first is not None and value != self._first[name]
        ]
        if changed:
            return f"is set differently than before ({'; '.join(changed)}); restart the bridge"
        return None


def remedy(model: ServoModel) -> str:
    """Return what to do for a servo that has shut itself down."""
    if model.feetech:
        enable = model.registers["torque_enable"].address
        return (
            "shut down, or its torque limit is 0; take the load off it, let it cool, then switch "
            f"its power off and on, or write 0 to its torque enable ({enable}): the leg goes limp"
        )
    if model.compact:
        limit = model.registers["torque_limit"].address
        return (
            "shut down, its torque limit is 0; take the load off it, let it cool, then switch its "
            f"power off and on, or write 1023 to its torque limit ({limit})"
        )
    return (
        "shut down, its torque is off until a reboot; take the load off it, let it cool, then "
        "reboot it with DYNAMIXEL Wizard, or switch its power off and on"
    )
