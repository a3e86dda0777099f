"""Where the moving leg of the pose set-up goes: parts of its workspace.

The subspaces are layers 5 cm high with 5 cm between them, in the coxa's frame: reach 13 to 22 cm
from the coxa axis and yaw within 30 degrees (assumed; the paper draws them without figures).  A
reach below 0 lies behind the axis.

The paper's set-up: the body stands on five legs, one leg moves in the air or onto obstacles.

A trial is one ascent from the lower to the upper subspace and one descent back, each between
random points and 10 control ticks long, then a hold of 3 ticks that counts as stance.  Segments
are straight lines of the foot in the leg's frame (or of the joints, with ``path="joint"``), cut
into equal steps, each written as a goal for one tick, as in the paper's section 4.1.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import Geometry
from adaptive_contact_sim.limits import check_number, check_word
from adaptive_contact_sim.motion import Goal, World
from adaptive_contact_sim.obstacles import Approach, ObstacleCourse, ObstacleSettings


@dataclass(frozen=True)
class Space:
    """A part of the leg's workspace: yaw, reach and height in the coxa's frame."""

    yaw_rad: tuple[float, float]
    reach_m: tuple[float, float]
    height_m: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> Array:
        """Draw a point, (3,) m, uniform in yaw, reach and height."""
        yaw, reach = rng.uniform(*self.yaw_rad), rng.uniform(*self.reach_m)
        height = rng.uniform(*self.height_m)
        return np.array([reach * math.cos(yaw), reach * math.sin(yaw), height])


# Lower and upper subspace, by name of the workspace.
WORKSPACES: Final = {
    "paper": (
        Space((-math.radians(30), math.radians(30)), (0.13, 0.22), (-0.125, -0.075)),
        Space((-math.radians(30), math.radians(30)), (0.13, 0.22), (-0.025, 0.025)),
    ),
    "whole": (
        Space((-math.radians(50), math.radians(50)), (0.09, 0.24), (-0.13, -0.03)),
        Space((-math.radians(50), math.radians(50)), (0.09, 0.25), (-0.03, 0.12)),
    ),
    # Of a leg that hangs down 0.38 m: under its hip, to the front, to the back and to the sides.
    "hung": (
        Space((-math.radians(60), math.radians(60)), (-0.09, 0.09), (-0.355, -0.315)),
        Space((-math.radians(60), math.radians(60)), (-0.09, 0.09), (-0.285, -0.235)),
    ),
}

Path = Literal["cartesian", "joint"]
Workspace = Literal["paper", "whole", "hung"]

PERIOD_S: Final = 0.02
# A leg taking its turn: ticks for lifting off or setting down, and how high.
_TURN_TICKS: Final = 40


@dataclass(frozen=True)
class PoseSettings:
    """What the moving leg does."""

    legs: tuple[str, ...] = ("rf",)  # which legs move, in turn
    trials_per_turn: int = 20  # ascents and descents before the next leg's turn
    segment_ticks: int = 10  # length of an ascent or a descent
    hold_ticks: int = 3  # rest after a descent, marked stance
    path: Path = "cartesian"  # ``cartesian`` or ``joint``, what is straight
    # `paper` or `whole`; `hung`, of a leg that hangs on a stand
    workspace: Workspace = "paper"
    # `descent`; `slow` (2 to 10 cm/s); `forward` (a level swing against a post); `graze`
    # (along a steep face)
    approach: Approach = "descent"
    obstacles: ObstacleSettings = field(default_factory=ObstacleSettings)  # what is in the way
    # how far above an obstacle the foot is when it comes, at least: more than a sole that is tilted
    # reaches below the foot's point
    clear_m: float = 0.008
    # per joint, how far from the leg's posture at rest is what joints beyond three follow, drawn
    # again for each end of a trial; empty leaves it where it is
    vary_rad: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.legs:
            raise ConfigurationError("there is no leg to move; expected one or more")
        check_word("workspace", self.workspace, WORKSPACES)
        check_word("approach", self.approach, get_args(Approach))
        check_word("path", self.path, get_args(Path))
        if self.workspace == "hung" and self.approach not in ("descent", "slow"):
            raise ConfigurationError(
                f"approach '{self.approach}' is not of a leg that hangs; expected descent or slow"
            )
        check_number("ticks of a segment", self.segment_ticks, 4, 500)
        check_number("ticks of a hold", self.hold_ticks, 1, 500)
        check_number("clearance over obstacles", self.clear_m, 0.001, 0.1, "m")
        for width in self.vary_rad:
            check_number("width of postures", width, 0.0, math.pi, "rad")
        check_number("trials per turn", self.trials_per_turn, 1, 100_000)


@dataclass(eq=False)
class _Plan:
    """What the moving leg does next: goals, tick by tick, and where it is in them."""

    leg: int
    joints: Array  # (n, J) rad
    points: Array  # (n, 3) m, leg frame
    ascent: int  # ticks of ascent
    swing: int  # ticks of swing; the rest is hold
    obstacle: float | None = None  # share of the descent at which to touch
    tick: int = 0


class PoseMotion:
    """Goals of the pose set-up."""

    def __init__(
        self,
        settings: PoseSettings,
        geometry: Geometry,
        course: ObstacleCourse,
        rng: np.random.Generator,
        legs: tuple[str, ...] = LEGS,
    ) -> None:
        self.settings = settings
        self._geometry = geometry
        self._course = course
        self._rng = rng
        self._legs = legs
        self._stand_m = geometry.standing_m
        self.start_joints = geometry.joints(np.tile(self._stand_m, (len(legs), 1)))
        self.start_height_m = -float(self._stand_m[2])
        self._goals = self.start_joints.copy()
        self._lower, self._upper = WORKSPACES[settings.workspace]
        self._turn = 0
        self._trials_left = settings.trials_per_turn
        self._point = self._stand_m
        self._side = 1.0
        # What joints beyond three follow where the last plan ends; None for the posture at rest.
        self._rest: Array | None = None
        if settings.vary_rad:
            self._rest = geometry.middle_rad
            if len(settings.vary_rad) != len(self._rest):
                raise ConfigurationError(
                    f"postures vary by {list(settings.vary_rad)} rad; expected one figure for each "
                    f"of {len(self._rest)} joints"
                )
        self._plan = self._step_up()
        # Always one plan ahead: the order of draws is part of what a seed means.
        self._upcoming = self._next_plan()

    @property
    def leg(self) -> int:
        """Index of the leg that moves."""
        return self._plan.leg

    def step(self, world: World) -> Goal:
        """Goals for this tick."""
        if self._plan.tick >= len(self._plan.joints):
            self._plan, self._upcoming = self._upcoming, self._next_plan()
        plan, leg = self._plan, self.leg
        if plan.tick == 0:
            self._course.assign(leg)
        swinging = plan.tick < plan.swing
        descending = plan.ascent <= plan.tick < plan.swing
        if descending and plan.obstacle is not None:
            self._raise_obstacle(plan, world)
        # An obstacle goes when the foot has left it; a foot that slid under it never would.
        left = world.touch_step[leg] is None or plan.tick >= 8
        if swinging and not descending and plan.tick >= 1 and left:
            self._course.clear()
        goal = self._goals.copy()
        goal[leg] = plan.joints[plan.tick]
        self._goals = goal
        plan.tick += 1
        phase: list[Literal["swing", "stance"]] = ["stance"] * len(self._legs)
        if swinging:
            phase[leg] = "swing"
        return Goal(goal, tuple(phase))

    def _raise_obstacle(self, plan: _Plan, world: World) -> None:
        """Put an obstacle on a descent, given where body and foot really are.

        The foot lags the command: it is still rising when its descent is commanded.  The
        obstacle comes once the foot is clear of it, or not at all.
        """
        assert plan.obstacle is not None
        leg = self.leg
        descent = plan.points[plan.ascent : plan.swing]
        where = plan.obstacle * (len(descent) - 1)
        at = int(where)
        after = min(at + 1, len(descent) - 1)
        point = descent[at] + (where - at) * (descent[after] - descent[at])
        motion = descent[after] - descent[max(at - 1, 0)]
        turn = world.rotation @ self._geometry.rotations[leg]
        mount = world.position_m + world.rotation @ self._geometry.mounts_m[leg]
        place = mount + turn @ point
        forward = self.settings.approach == "forward"
        ahead = turn @ motion / np.linalg.norm(motion) if forward else np.array([0.0, 0.0, -1.0])
        # A post comes when the foot is this far before it, m.
        clear = 0.03 if forward else self.settings.clear_m
        if float((place - world.feet_m[leg]) @ ahead) < clear:
            if plan.tick - plan.ascent >= 5:
                plan.obstacle = None
            return
        plan.obstacle = None
        inward = turn @ np.array([-point[0], -point[1], 0.0])
        inward[2] = 0.0
        self._course.place(
            place,
            turn @ motion,
            inward / np.linalg.norm(inward),
            self.settings.approach,
        )

    # -- plans ---------------------------------------------------------------------------------

    def _next_plan(self) -> _Plan:
        if self._trials_left > 0:
            self._trials_left -= 1
            return self._trial()
        if len(self.settings.legs) == 1:
            self._trials_left = self.settings.trials_per_turn - 1
            return self._trial()
        if not np.array_equal(self._point, self._stand_m):
            return self._step(self._stand_m)
        self._turn += 1
        self._trials_left = self.settings.trials_per_turn
        return self._step_up()

    def _turning(self) -> int:
        """Index of the leg whose turn it is, for plans being made."""
        return self._legs.index(self.settings.legs[self._turn % len(self.settings.legs)])

    def _trial(self) -> _Plan:
        """One ascent, one descent, one hold."""
        n = self.settings.segment_ticks
        forward = self.settings.approach == "forward"
        self._side = -self._side
        path = self.settings.path
        for attempt in itertools.count(1):
            # Draws of a trial after which its ascent may bend: there are places, low and close to
            # the body, that no straight line leaves.  A straight one is found in a handful of draws
            # elsewhere.
            if attempt > 200:
                path = "joint"  # out of a pocket that no straight line leaves
            top = self._upper.draw(self._rng)
            end = self._lower.draw(self._rng)
            down = n
            if forward:
                # From one side to the other at one height, low enough for foot or shin to meet
                # the post; back on the next trial.
                yaw = self._side * self._rng.uniform(0.25, 0.5)
                reach = float(np.hypot(top[0], top[1]))
                height = self._rng.uniform(-0.09, -0.03)
                top = np.array([reach * math.cos(yaw), reach * math.sin(yaw), height])
                end = np.array([top[0], -top[1], height])
            elif self.settings.approach == "slow":
                drop = self._rng.uniform(0.05, 0.08)
                end = top - np.array([0.0, 0.0, drop])
                down = round(drop / self._rng.uniform(0.02, 0.10) / PERIOD_S)
            # Where the two subspaces touch each other, an ascent still has to be one.
            elif top[2] - end[2] < 0.04:
                continue
            rest = below = up_rests = down_rests = None
            if self._rest is not None:
                rest, below = self._draw_rest(), self._draw_rest()
                up_rests, down_rests = (self._rest, rest), (rest, below)
            up_points, up = self._line(self._point, top, n, path, up_rests)
            down_points, fall = self._line(top, end, down, self.settings.path, down_rests)
            points, joints = np.concatenate([up_points, down_points]), np.concatenate([up, fall])
            if rest is None and self._geometry.reachable(points).all():
                break
            # How near to its points a leg whose posture varies comes, or another trial is drawn.
            if rest is not None and np.abs(self._geometry.feet(joints) - points).max() < 1e-3:
                break
        self._rest = below
        hold = self.settings.hold_ticks
        self._point = end
        return _Plan(
            leg=self._turning(),
            joints=np.concatenate([up, fall, np.repeat(fall[-1:], hold, axis=0)]),
            points=np.concatenate([up_points, down_points, np.repeat(end[None], hold, axis=0)]),
            ascent=n,
            swing=n + down,
            obstacle=self._course.share() if self._course.wanted() else None,
        )

    def _draw_rest(self) -> Array:
        """(J,) rad, a posture for joints beyond three to follow."""
        widths = np.array(self.settings.vary_rad)
        return np.asarray(self._geometry.middle_rad + self._rng.uniform(-widths, widths))

    def _line(
        self,
        start: Array,
        end: Array,
        ticks: int,
        path: Path,
        rests: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Equal steps from start (left out) to end: (ticks, 3) m and (ticks, J) rad.

        Args:
            start: (3,) m.
            end: (3,) m.
            ticks: from one to the other.
            path: what is straight.
            rests: (J,) rad, what joints beyond three follow at either end.
        """
        share = (np.arange(1, ticks + 1) / ticks)[:, None]
        if path == "joint":
            if rests is None:
                first, last = self._geometry.joints(start), self._geometry.joints(end)
            else:
                ends = np.stack([start, end])
                first, last = self._geometry.joints(ends, rest_rad=np.stack(rests))
            joints = first + share * (last - first)
            return self._geometry.feet(joints), joints
        points = start + share * (end - start)
        if rests is None:
            return points, self._geometry.joints(points)
        rest = rests[0] + share * (rests[1] - rests[0])
        return points, self._geometry.joints(points, rest_rad=rest)

    def _step_up(self) -> _Plan:
        """From standing to the lower subspace."""
        while True:
            end = self._lower.draw(self._rng)
            if self._geometry.reachable(end):
                break
        return self._step(end)

    def _step(self, end: Array) -> _Plan:
        """From wherever the leg is to a point; no swing to be judged."""
        points = _arc(self._point, end)
        self._point = end
        return _Plan(self._turning(), self._geometry.joints(points), points, ascent=0, swing=0)


def _arc(start: Array, end: Array) -> Array:
    """A lifted, gentle way from one foot point to another, (n, 3) m, with a rest at the end."""
    s = np.arange(1, _TURN_TICKS + 1) / _TURN_TICKS
    smooth = s**3 * (10 - 15 * s + 6 * s**2)
    points = start + smooth[:, None] * (end - start)
    points[:, 2] += 0.05 * np.sin(np.pi * smooth)
    return np.concatenate([points, np.repeat(points[-1:], _TURN_TICKS // 4, axis=0)])
