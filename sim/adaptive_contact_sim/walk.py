r"""A walking controller: gait, steering, reaction to touch, posture.

It knows what a real one may know: its own commands, the positions its servos report, the body's
attitude (as from an IMU), and contacts reported to it.  Only the steering uses the body's true
place, as an operator would, to keep the robot on the field.

All points are feet in the body's frame, :math:`p_i`.  With the wanted twist :math:`(v, \omega)` of
the body, a stance foot moves by :math:`\dot p_i = -v - \omega \times p_i`; a swing foot goes to
its neutral point plus half a stride ahead.  Posture: stance feet are moved up and down slowly, so
that the body keeps its height over the mean of its feet, stays level, and loads its feet alike.

Two kinds of controllers: one that lets a descent go on until it is stopped at a touch, with the
phase "swing" until then; and, with ``phase="planned"``, one that follows its plan.  The second says
"stance" at the tick in which its *command* comes down to the ground that it expects, and moves on
as in stance, while the servos still bring the foot down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from adaptive_contact.arrays import Array
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Phase
from adaptive_contact_sim.gait import DESCENT, GAITS, GaitName, Sway, Swings
from adaptive_contact_sim.legs import Geometry
from adaptive_contact_sim.limits import check_number, check_word
from adaptive_contact_sim.motion import Goal, World

StopOn = Literal["truth", "service", "never"]
PhaseOf = Literal["touch", "planned"]

_FOOT_RANGE_M: Final = 0.05  # how far stance feet may leave the nominal height


@dataclass(frozen=True)
class WalkSettings:
    """How to walk."""

    # `tripod`, `ripple` or `wave` of six legs, `trot` or `walk` of four
    gait: GaitName = "tripod"
    stride_m: float = 0.06  # length of a stance at full speed
    swing_s: float = 0.64  # time of a whole swing
    body_height_m: float = 0.10  # of the legs' first joints over the feet
    clearance_m: float = 0.045  # of a foot in transfer over the ground one expects
    # how far below the expected ground descents aim, lowest and highest
    depth_m: tuple[float, float] = (0.025, 0.04)
    reach_m: float = 0.135  # of neutral feet from their legs' first joints
    variability: float = 0.15  # relative half-width of the differences between cycles and swings
    # what reports to a leg that it touches: `truth`, `service` or `never`
    stop_on: StopOn = "truth"
    react_ms: float = 60.0  # from a true touch to the leg's stop; the phase stays swing until then
    # what ends a swing: `touch` (a stop, or the descent's end) or `planned` (the command
    # reaches the expected ground; nothing stops a descent)
    phase: PhaseOf = "touch"
    # how far a foot that has come down presses below where it stands: enough for the servos to take
    # its share of the weight at once
    preload_m: float = 0.012
    # by which the feet of a moving stance are set down further back: servos that lag leave them
    # ahead of their commands, and two feet carry no weight beside their line
    lag_s: float = 0.0
    sway: float = 0.0  # share of the shift that takes the body over the feet that stand, 0 for none
    # the same at the touch, where a gait leaves three other feet standing: the load comes when the
    # next foot lifts, and one that presses earlier lifts its neighbours off; None leaves it to the
    # preload
    land_m: float | None = None
    # by which a leg lifts higher once it is reported to strike something in its lift; 0 leaves the
    # swing as it is
    raise_m: float = 0.0

    def __post_init__(self) -> None:
        check_word("gait", self.gait, GAITS)
        check_word("stop-on", self.stop_on, get_args(StopOn))
        check_word("phase", self.phase, get_args(PhaseOf))
        if self.phase == "planned" and self.stop_on == "service":
            raise ConfigurationError(
                "a planned descent is stopped by nothing, found stop-on 'service'; leave out one"
            )
        if self.raise_m and (self.phase == "planned" or self.stop_on == "never"):
            raise ConfigurationError(
                f"raise after a strike is {self.raise_m:g} m, and nothing reports strikes with "
                f"phase '{self.phase}', stop-on '{self.stop_on}'; expected phase 'touch' and "
                "stop-on 'service' or 'truth'"
            )
        ranges = (
            ("stride", self.stride_m, 0.0, 0.09, "m"),
            ("swing time", self.swing_s, 0.15, 3.0, "s"),
            ("body height", self.body_height_m, 0.07, 0.3, "m"),
            ("clearance", self.clearance_m, 0.02, 0.07, "m"),
            ("reach", self.reach_m, 0.0, 0.3, "m"),
            ("variability", self.variability, 0.0, 0.4, ""),
            ("preload", self.preload_m, 0.0, 0.03, "m"),
            ("lag", self.lag_s, 0.0, 0.5, "s"),
            ("sway", self.sway, 0.0, 1.5, ""),
            ("reaction time", self.react_ms, 0.0, 1000.0, "ms"),
            ("raise after a strike", self.raise_m, 0.0, 0.05, "m"),
        )
        for limits in ranges:
            check_number(*limits)
        if not 0.01 <= self.depth_m[0] <= self.depth_m[1] <= 0.06:
            raise ConfigurationError(
                f"descents aim {self.depth_m[0]:g} to {self.depth_m[1]:g} m below the ground; "
                "expected 0.01 to 0.06 m, rising"
            )


class WalkMotion:
    """Goals of a walk."""

    def __init__(
        self,
        settings: WalkSettings,
        geometry: Geometry,
        rng: np.random.Generator,
        *,
        field_m: float,
        period_s: float,
    ) -> None:
        self.settings = settings
        self._geometry = geometry
        self._rng = rng
        self._period_s = period_s
        # Waypoints keep this far from the field's rim, m: body and legs are 0.35 m from the centre,
        # and a turn takes some room.
        self._bound_m = max(field_m / 2 - 0.9, 0.3)
        gait = GAITS[settings.gait]
        self._share = gait.share
        self._offsets = np.array(gait.offsets)
        self._nominal_cycle_s = settings.swing_s / gait.share
        self._stance_s = self._nominal_cycle_s * (1.0 - gait.share)
        neutral = geometry.neutral(settings.reach_m, settings.body_height_m)
        self._legs = len(neutral)
        if len(gait.offsets) != self._legs:
            fitting = [name for name, g in GAITS.items() if len(g.offsets) == self._legs]
            raise ConfigurationError(
                f"gait '{settings.gait}' is of {len(gait.offsets)} legs, the robot has "
                f"{self._legs}; expected {', '.join(fitting) or 'a robot that walks'}"
            )
        if not geometry.reachable(neutral).all():
            raise ConfigurationError(
                f"feet do not reach {settings.reach_m:g} m out and {settings.body_height_m:g} m "
                "down; give another reach_m or body_height_m"
            )
        self._neutral = geometry.to_body(neutral)
        self._feet = self._neutral.copy()
        self.start_joints = geometry.joints(geometry.to_leg(self._neutral))
        self.start_height_m = settings.body_height_m
        self._goal_rad = self.start_joints
        self._swings = Swings.at(self._feet)
        self._clock = gait.share
        self._rate = 1.0 / self._nominal_cycle_s
        # Swinging: in the air by command.  A leg whose swing would be under way at the start
        # waits for its next.
        self._swinging = np.zeros(self._legs, dtype=np.bool_)
        self._own_before = self._own_clock()
        self._descent_tick = np.zeros(self._legs, dtype=np.int64)
        # (L,) swings that were stopped this tick on the report of a touch, and raised on that of a
        # strike
        self.stopped, self.raised = self._swinging.copy(), self._swinging.copy()
        self.raises = 0  # so far
        self._lifted_tick = self._descent_tick.copy()  # from then on a report is of a strike
        self._begun_again = np.zeros(self._legs)  # progress at the swing's last strike
        self._planned = settings.phase == "planned"
        # Three feet stand while one swings: none has to carry before it is needed.
        self._land_m = settings.land_m if self._legs * (1.0 - gait.share) >= 3.0 else None
        # Expected where the swing goes, in the body's frame.
        self._floor_m = self._feet[:, 2].copy()
        self._settled_tick = np.zeros(self._legs, dtype=np.int64)  # from then on the foot stands
        # Feet are planned as if the body did not sway; their goals and readings are moved by it.
        self._sway: Sway | None = None
        self._swayed_m = np.zeros(3)
        self._sway_share = 0.0  # grows over the first cycle
        if settings.sway:
            self._sway = Sway(
                gait,
                self._neutral,
                height_m=settings.body_height_m,
                cycle_s=self._nominal_cycle_s,
                lag_s=settings.lag_s,
            )
        self._twist = np.zeros(3)  # vx, vy m/s, wz rad/s
        self._waypoint = self._draw_waypoint()

    def step(self, world: World) -> Goal:
        """Goals for this tick."""
        self._steer(world)
        measured = self._geometry.to_body(self._geometry.feet(world.measured_rad))
        if self._sway is not None:
            measured += self._swayed_m
        self._lift_off(world, measured)
        self._stand(world, measured)
        self._swing(world, measured)
        feet = self._feet
        if self._sway is not None:
            self._sway_share = min(1.0, self._sway_share + self._rate * self._period_s)
            # How far the body's command is from where it would not sway.
            self._swayed_m[:2] = self.settings.sway * self._sway_share * self._sway.at(self._clock)
            feet = feet - self._swayed_m
        goal = self._goal_rad = self._geometry.joints(self._geometry.to_leg(feet), self._goal_rad)
        phase: tuple[Phase, ...] = tuple("swing" if s else "stance" for s in self._swinging)
        return Goal(goal, phase)

    def _draw_waypoint(self) -> Array:
        return self._rng.uniform(-self._bound_m, self._bound_m, 2)

    def _steer(self, world: World) -> None:
        """Turn towards the waypoint, walk when roughly facing it."""
        to = self._waypoint - world.position_m[:2]
        if math.hypot(to[0], to[1]) < 0.25:
            self._waypoint = self._draw_waypoint()
            to = self._waypoint - world.position_m[:2]
        heading = math.atan2(world.rotation[1, 0], world.rotation[0, 0])
        error = math.remainder(math.atan2(to[1], to[0]) - heading, 2 * math.pi)
        speed = self.settings.stride_m / self._stance_s
        # A stance foot's way is limited by what the leg reaches, turning included.
        fastest = speed / self._geometry.outer_foot_m
        turn = max(-fastest, min(fastest, 1.0 * error))  # rad/s per rad
        forward = speed * max(0.0, math.cos(error)) * (1.0 - 0.5 * abs(turn) / max(fastest, 1e-9))
        wanted = np.array([forward, 0.0, turn])
        # Time over which the wanted twist is smoothed.
        self._twist += (wanted - self._twist) * (self._period_s / 0.4)

    def _velocity_of(self, points: Array) -> Array:
        """Velocity (L, 2) m/s of the body at points of it; the ground's there is the opposite."""
        vx, vy, wz = self._twist
        return np.stack([vx - wz * points[:, 1], vy + wz * points[:, 0]], axis=1)

    # -- the gait's clock ----------------------------------------------------------------------

    def _own_clock(self) -> Array:
        return (self._clock + self._offsets) % 1.0

    def _lift_off(self, world: World, measured: Array) -> None:
        """Advance the clock; let legs whose turn it is begin their swing."""
        settings, rng = self.settings, self._rng
        clock = self._clock + self._rate * self._period_s
        if clock >= 1.0:
            clock -= 1.0
            spread = 1.0 + settings.variability * rng.uniform(-1.0, 1.0)
            self._rate = 1.0 / (self._nominal_cycle_s * spread)
        self._clock = clock
        own = self._own_clock()
        begin = np.flatnonzero(own < self._own_before)
        self._own_before = own
        if not begin.size:
            return
        point, up = self._middle(measured), world.rotation[2]
        moves = self._velocity_of(self._neutral)
        ahead = (0.5 * self._stance_s - settings.lag_s) * moves
        for leg in begin:
            self._swinging[leg] = True
            swings = self._swings
            swings.start_m[leg] = self._feet[leg]
            jitter = settings.variability * 0.06 * rng.uniform(-1.0, 1.0, 2)
            target = self._neutral[leg, :2] + ahead[leg] + jitter
            swings.target_m[leg, :2] = target
            # On the level plane through that point, in the body's frame.
            slope = up[0] * (target[0] - point[0]) + up[1] * (target[1] - point[1])
            floor = self._floor_m[leg] = point[2] - slope / max(float(up[2]), 0.5)
            lift = settings.clearance_m * (1.0 + settings.variability * rng.uniform(-1.0, 1.0))
            swings.top_m[leg] = floor + lift
            swings.target_m[leg, 2] = floor - rng.uniform(*settings.depth_m)
            swings.began_step[leg] = world.step
            self._begun_again[leg] = 0.0
            # Until then a foot may still leave the ground.
            self._lifted_tick[leg] = world.tick + round(0.1 / self._period_s)

    def _middle(self, measured: Array) -> Array:
        """(3,) m, the middle of the feet that stand; of a plan, where it has it."""
        stance = ~self._swinging
        feet = self._neutral if self._planned or not stance.any() else measured[stance]
        return np.asarray(feet.mean(axis=0))

    # -- stance --------------------------------------------------------------------------------

    def _stand(self, world: World, measured: Array) -> None:
        """Move stance feet: with the body's twist, for its posture, and off too much pressure."""
        stance = ~self._swinging
        if not stance.any():
            return
        dt, feet = self._period_s, self._feet
        feet[stance, :2] -= dt * self._velocity_of(feet)[stance]
        if self._planned:  # a foot is taken to stand some ticks after the turn
            stance &= world.tick >= self._settled_tick
            if not stance.any():
                return
        up = world.rotation[2]  # the vertical in the body's frame
        below = float(((feet if self._planned else measured)[stance] @ up).mean())
        height = -below - self.settings.body_height_m
        # Level the body: it tilts by (up x z); lower the feet on the side that hangs.
        slope = -(feet[:, 0] * up[0] + feet[:, 1] * up[1])
        # Of each error so much is taken back per second.
        feet[stance, 2] += dt * (3.0 * height - 4.0 * slope[stance])
        # How far a foot is pushed off its command shows its load: a spring of servos.
        pressed = (measured - feet) @ up
        load = pressed[stance]
        feet[stance, 2] += dt * 2.0 * (load - load.mean())
        # What a foot's command is lower than its preload is taken back at this rate.
        feet[stance, 2] += np.clip(load - self.settings.preload_m, 0.0, 1.0 * dt)
        nominal = -self.settings.body_height_m
        feet[stance, 2] = np.clip(feet[stance, 2], nominal - _FOOT_RANGE_M, nominal + _FOOT_RANGE_M)

    # -- swing ---------------------------------------------------------------------------------

    def _swing(self, world: World, measured: Array) -> None:
        """Move swing feet along their way; land those that touch, or that are at its end."""
        self.stopped[:] = self.raised[:] = False
        if not self._swinging.any():
            return
        clock = self._own_clock() / self._share
        progress = (clock - self._begun_again) / (1.0 - self._begun_again)
        points = self._swings.feet(np.minimum(progress, 1.0))
        for leg in np.flatnonzero(self._swinging).tolist():
            descending = progress[leg] > DESCENT
            if self._planned:
                self._feet[leg] = points[leg]
                if progress[leg] >= 1.0 or (descending and points[leg, 2] <= self._floor_m[leg]):
                    self._swinging[leg] = False
                    # Ticks after a planned turn to stance until a foot is taken to stand: until
                    # then its distance from its command is the servos' lag and no load.
                    self._settled_tick[leg] = world.tick + 10
                continue
            if not descending:
                self._descent_tick[leg] = world.tick + 1
                lifted = self._lifted_tick[leg]
                step = lifted * round(self._period_s / world.step_s)
                if self.settings.raise_m and self._touched(world, leg, lifted, step):
                    self._raise(world, leg, measured[leg])
                    self._begun_again[leg] = clock[leg]
                    continue
            elif self._touched(world, leg, self._descent_tick[leg], self._swings.began_step[leg]):
                self._swinging[leg], self.stopped[leg] = False, True
                if self._land_m is not None:
                    lowest = measured[leg, 2] - self._land_m
                    self._feet[leg, 2] = max(self._feet[leg, 2], lowest)
                continue
            self._feet[leg] = points[leg]
            if progress[leg] >= 1.0:
                self._swinging[leg] = False

    def _raise(self, world: World, leg: int, measured: Array) -> None:
        """Begin a swing again where its foot was struck, to a higher top, in the time left."""
        swings, feet = self._swings, self._feet
        # The swing stops here: the command is ahead of a foot that is held.
        feet[leg] = measured
        swings.start_m[leg] = feet[leg]
        swings.top_m[leg] = max(swings.top_m[leg], feet[leg, 2]) + self.settings.raise_m
        swings.began_step[leg] = world.step
        self._lifted_tick[leg] = world.tick + 1
        self.raised[leg] = True
        self.raises += 1

    def _touched(self, world: World, leg: int, since_tick: int, since_step: int) -> bool:
        """Return whether a touch is reported, in a tick from one on; a true one, after a step.

        What was reported of the lift is of no use for the descent, and would stop it in the air.
        """
        if self.settings.stop_on == "truth":
            touched = world.touch_step[leg]
            if touched is None or touched <= since_step:
                return False
            since_ms = (world.step - touched) * world.step_s * 1e3
            return since_ms >= self.settings.react_ms
        if self.settings.stop_on == "service":
            at = world.reported_tick[leg]
            return at is not None and at >= since_tick
        return False
