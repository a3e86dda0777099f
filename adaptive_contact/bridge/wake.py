"""When a servo may be written a goal: nothing moves that was not asked to move.

A servo that has torque stands where its goal register says, or a little below that under its load;
taking its position for the start would let it sink, or move it.  Only without torque does the
position say where to begin.  So a goal is written

- to a servo whose registers of mode and limits were read twice alike (:mod:`.modes`),
- whose goal, and torque, were read in the same tick: what it holds now, whatever was written last,
- at most one step from the goal in force; without torque, only where the horn is.

Torque is switched on where the same reading shows the goal within a few steps of the horn.

An alarm that the servo's shutdown register names switches its drive off for good.  An AX, RX, MX
or XL-320 servo sets its torque limit to 0, and drives again as soon as that is written; an X-series
one, or an MX with protocol 2.0, switches its torque off and stays so until a reboot.

Source: ROBOTIS e-manual, AX-12A "Shutdown (18)", XL-320 "Shutdown(18)", XL330-M288 "Shutdown (63)".
"""

from __future__ import annotations

import enum
import math
from typing import Final, NamedTuple

from adaptive_contact.bridge.drive import EASY_SHARE
from adaptive_contact.bridge.modes import Setting, setting
from adaptive_contact.bridge.plan import JointPlan
from adaptive_contact.bridge.tables import Block, ServoModel

__all__ = ["GoalRegister", "Place", "Standing", "Waker", "remedy", "standing"]

# A goal this close to where a servo is, or within one step of the easy pace, is where it is.
_NEAR_STEPS: Final = 2
# A servo whose goal register has not taken what was written for so many ticks takes nothing.
_HEEDLESS_TICKS: Final = 25


class Standing(NamedTuple):
    """How a servo stands.

    Attributes:
        torque: it drives to its goal.
        shut: it has shut itself down.
        alarms: names of what is behind the alert of protocol 2.0, where the block holds them.
    """

    torque: bool
    shut: bool = False
    alarms: tuple[str, ...] = ()


def standing(model: ServoModel, block: Block, data: bytes) -> Standing:
    """How a servo stands.

    Args:
        model: the kind of servo.
        block: what was read; it includes :attr:`.ServoModel.state`.
        data: its bytes.
    """

    def value(name: str) -> int:
        return block.part(data, model.registers[name])

    torque = value("torque_enable") != 0
    told = model.registers.get("hardware_error")
    errors = 0 if told is None or not block.holds(told) else block.part(data, told)
    alarms = tuple(name for bit, name in model.error_bits.items() if errors & bit)
    if model.compact:
        limit = value("torque_limit")
        return Standing(torque and limit > 0, limit == 0, alarms)
    return Standing(torque, not torque and bool(errors & value("shutdown")), alarms)


class Place(NamedTuple):
    """From where a servo can be moved.

    Attributes:
        steps: the goal in force where it has torque, else its position.
        torque: it drives.
        at_goal: without torque, the goal register holds where it is.
    """

    steps: int
    torque: bool
    at_goal: bool


class GoalRegister(enum.Enum):
    """What the goal register held, against what was written."""

    TAKEN = enum.auto()
    LOST = enum.auto()
    FOREIGN = enum.auto()


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
        self.setting: Setting | None = None
        self.awake = False
        self.trouble: str | None = None
        self._joint = joint
        self._first: dict[str, int] | None = None
        self._most = max(1, math.floor(max_step_rad / joint.model.step_rad + 1e-9))
        easy = int(EASY_SHARE * max_step_rad / joint.model.step_rad)
        self._near = min(max(_NEAR_STEPS, easy), self._most)
        self._proof: list[bytes] = []
        self._written: int | None = None
        self._before: int | None = None
        self._heedless = 0

    def forget(self) -> None:
        """Start over: the servo may have lost its power, or be another one."""
        self.setting = None
        self.awake = False
        self._proof.clear()
        self._written = self._before = None
        self._heedless = 0

    @property
    def wanted(self) -> Block | None:
        """What is to be read next of its settings; None where they are known.

        The second time each block is a byte longer, so that a late answer to the first cannot be
        taken for one to the second.
        """
        if self.setting is not None:
            return None
        blocks = self._joint.model.settings
        done = len(self._proof)
        return blocks[done] if done < len(blocks) else blocks[done - len(blocks)].longer

    def learn(self, data: bytes) -> None:
        """Take in the bytes of :attr:`wanted`."""
        blocks = self._joint.model.settings
        self._proof.append(data)
        if len(self._proof) < 2 * len(blocks):
            return
        once, twice = self._proof[: len(blocks)], self._proof[len(blocks) :]
        self._proof.clear()
        if any(a != b[: len(a)] for a, b in zip(once, twice, strict=True)):
            return  # read again
        self.setting = setting(self._joint.model, once)
        self._first = self._first or self.setting.values

    def bounds(self) -> tuple[float, float]:
        """How far its goals may go: robot.toml's limits within the servo's own, rad."""
        assert self.setting is not None
        one, other = (self._joint.angle(s) for s in (self.setting.lowest, self.setting.highest))
        lower = max(self._joint.lower_rad, min(one, other))
        return lower, min(self._joint.upper_rad, max(one, other))

    def place(self, stands: Standing | None, steps: int, goal: int) -> Place | None:
        """From where it can be moved, by one tick's readings; None, and ``trouble``, if it cannot.

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
        if self._heedless >= _HEEDLESS_TICKS:
            self.trouble = (
                "does not take the goals that are written; check its bus watchdog, and whether "
                "another program writes to this bus"
            )
        if stands.torque:
            return Place(at, True, True)
        at = min(max(at, low), high)
        return Place(at, False, abs(goal - steps) <= self._near)

    def compare(self, goal: int) -> GoalRegister:
        """What became of the last write, by the goal register read now."""
        before, self._before = self._before, goal
        written, self._written = self._written, None
        if goal == written or (written is None and (goal == before or not self.awake)):
            self._heedless = 0
            return GoalRegister.TAKEN
        if before is None:
            return GoalRegister.FOREIGN
        self._heedless += 1
        return GoalRegister.LOST if goal == before else GoalRegister.FOREIGN

    def step(self, place: Place, angle_rad: float) -> int:
        """The goal to write for an angle: one step from the goal in force at the most."""
        assert self.setting is not None
        steps = min(max(self._joint.steps(angle_rad), place.steps - self._most),
                    place.steps + self._most)  # fmt: skip
        return self.wrote(min(max(steps, self.setting.lowest), self.setting.highest))

    def wrote(self, goal: int) -> int:
        """Remember what is written, to compare it with the register in the next tick."""
        self._written = goal
        return goal

    def _misplaced(self, at: int, torque: bool) -> str | None:
        """Why a servo cannot be moved from where it is."""
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
    """What to do for a servo that has shut itself down."""
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
