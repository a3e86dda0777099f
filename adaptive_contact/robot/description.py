r"""Defines a robot's description: legs, joints, servos, ports, and the convention of angles.

A description is frozen, and checked once, on load (:mod:`adaptive_contact.robot.load`).

A source may count its joints' angles another way than ``robot.toml`` does: the other way round, or
from another zero.  ``[leg.angles]`` says how, joint by joint:

.. math:: q = d\,w + o, \qquad d \in \{1, -1\}

with the wire's angle :math:`w`, the description's :math:`q`, and the description's angle :math:`o`
of a joint whose source says 0.  A sample is turned once, where it enters a learner or is gathered
for a fit.  Everything behind that point, models and residuals included, is in the description's
frame; keys of the wire (samples, commands) are in the source's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta

from adaptive_contact.arrays import Array, np
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot.kinematics import AXES, Chain, Vector, rotation, straight
from adaptive_contact.wire import ServoSample

# Offsets are written with so many digits: finer than the step of any servo (0.0001 rad).
_DIGITS: Final = 4


class AngleFrame:
    """Turns one leg's samples into the description's frame.

    Attributes:
        directions: (J,) 1 or -1.
        offsets_rad: (J,) rad.
        same: the wire's angles are the description's, so that nothing is to be done.
    """

    def __init__(self, leg: Leg) -> None:
        joints = len(leg.joints)
        angles = Angles() if leg.angles is None else leg.angles
        self.directions = angles.directions or (1,) * joints
        self.offsets_rad = angles.offsets_rad or (0.0,) * joints
        self.same = all(d == 1 for d in self.directions) and not any(self.offsets_rad)
        self._joints = joints

    def sample(self, sample: ServoSample) -> ServoSample:
        """Turn a sample of the wire into the description's frame.

        A sample with another number of values is left as it is; the checks refuse it.
        """
        if self.same:
            return sample
        preview = sample.preview
        return msgspec.structs.replace(
            sample,
            measured=self.angles(sample.measured),
            desired=self.angles(sample.desired),
            preview=None if preview is None else [self.angles(row) for row in preview],
        )

    def angles(self, wire: list[float]) -> list[float]:
        """Convert angles of the wire, (J,) rad, to the description's."""
        if len(wire) != self._joints:
            return wire
        turned = zip(self.directions, wire, self.offsets_rad, strict=True)
        return [d * w + o for d, w, o in turned]

    def wire(self, angles: Sequence[float]) -> list[float]:
        """Convert angles of the description, (J,) rad, to the wire's."""
        turned = zip(self.directions, angles, self.offsets_rad, strict=True)
        return [d * (q - o) for d, q, o in turned]


def angles_text(directions: Sequence[int], offsets_rad: Sequence[float], table: str) -> str:
    """Format what to write into ``robot.toml``, in one line.

    Args:
        directions: (J,) 1 or -1.
        offsets_rad: (J,) rad; left out where all are 0.
        table: ``[leg.angles]`` or ``[leg.servos]``.
    """
    text = f"{table} directions = {list(directions)}"
    if any(round(o, _DIGITS) for o in offsets_rad):
        listed = ", ".join(f"{round(o, _DIGITS):g}" for o in offsets_rad)
        text += f", offsets_rad = [{listed}]"
    return text


# Bounds of what a file may hold; NaN is outside of them all.  Lengths, offsets and coordinates are
# 5 m at most, angles a turn each way.
Angle = Annotated[float, Meta(ge=-2 * math.pi, le=2 * math.pi)]
Metres = Annotated[float, Meta(ge=-5.0, le=5.0)]
Place = tuple[Metres, Metres, Metres]
Sign = Literal[1, -1]
Step = Annotated[float, Meta(ge=1e-6, le=0.2)]
Text = Annotated[str, Meta(min_length=1, max_length=1000)]
# A Dynamixel bus: 253 is reserved, 254 is broadcast.
# AX-12A go down to 7,843; no adapter goes beyond 12 M.
Baud = Annotated[int, Meta(ge=1_200, le=12_000_000)]
ServoId = Annotated[int, Meta(ge=0, le=252)]
MAX_JOINTS: Final = 16  # of a sample
Joints = Meta(min_length=1, max_length=MAX_JOINTS)
# Names of ROS: chunks of letters, digits and '_' that begin with no digit.
_CHUNK: Final = r"(?:[A-Za-z_]|\{leg\})(?:[A-Za-z0-9_]|\{leg\})*"
Topic = Annotated[str, Meta(pattern=rf"^/{_CHUNK}(?:/{_CHUNK})*\Z")]

AxisWord = Literal["roll", "pitch", "yaw"]
# A word, or a direction in the leg's frame with all angles 0.
Axis = AxisWord | Vector
_WORDS: Final[dict[Vector, AxisWord]] = {
    AXES["roll"]: "roll",
    AXES["pitch"]: "pitch",
    AXES["yaw"]: "yaw",
}

# Position step where none is described, of float readings or unknown servos.  Of Dyna 1's floats
# 28 % of touches are found by it, and 61 % of contacts are touches; by 1e-4 rad 21 and 48 %, as
# true readings count as impossible, by 3e-3 33 and 58 %.  Of AX-12A (5.1e-3) 94 in place of 97 %.
ASSUMED_STEP_RAD: Final = 1e-3

# One robot-hour is 540,000 judged swing leg-ticks: six legs at 50 Hz, half of the time in swing.
ROBOT_HOUR_TICKS: Final = 540_000


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Places a leg on the body: position in metres, yaw of its zero direction in rad."""

    xyz_m: Place = (0.0, 0.0, 0.0)
    yaw_rad: Angle = 0.0


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Holds the joint limits, (J,) rad each."""

    lower_rad: tuple[Angle, ...]
    upper_rad: tuple[Angle, ...]


class Angles(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Converts a source's angles to the description's: ``direction * wire + offset``."""

    directions: tuple[Sign, ...] | None = None  # (J,) all 1 where absent
    # (J,) the description's angle of a joint whose source says 0; all 0 where absent
    offsets_rad: tuple[Angle, ...] | None = None


class ServoBus(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Describes a leg's servos on their bus.

    A joint's angle is ``direction * (position - centre) + offset``, the servo's position and
    centre being those of its horn.
    """

    ids: tuple[ServoId, ...]  # (J,) on the bus
    # of all of them, or their family, such as ``XL-330``; or (J,), one of each
    model: str | tuple[str, ...] = "AX-12A"
    directions: tuple[Sign, ...] | None = None  # (J,)
    # (J,) angle of the joint with the horn in its centre
    offsets_rad: tuple[Angle, ...] | None = None
    port: str | None = None  # name of a ``[port.NAME]``; may be left out where there is one
    # how far the bridge lets a goal move in one control tick
    max_step_rad: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.15

    @property
    def models(self) -> tuple[str, ...]:
        """Return the model of each servo, (J,)."""
        return (self.model,) * len(self.ids) if isinstance(self.model, str) else self.model


class LegRos2(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Holds a leg's names in ROS 2."""

    # (J,) ROS names of the leg's joints, in the order of ``joints``
    joints: tuple[Annotated[str, Meta(min_length=1)], ...]
    # state, command, phase, truth: topics of this leg alone, instead of those of ``[ros2]``
    state: Topic | None = None
    command: Topic | None = None
    # joints of this leg's command topic, in the order of its values
    command_joints: tuple[str, ...] | None = None
    phase: Topic | None = None
    truth: Topic | None = None


class Ros2(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names the topics of ROS 2 that carry the legs' readings and commands.

    ``{leg}`` in a topic stands for the leg's id.
    """

    # ``control_msgs/JointTrajectoryControllerState``, which holds readings and commands, or
    # ``sensor_msgs/JointState``, which holds readings
    state: Topic | None = None
    command: Topic | None = None  # where the commands are, if ``state`` holds readings only
    # the joints of a command topic that names none, in the order of its values
    command_joints: tuple[str, ...] | None = None
    phase: Topic | None = None  # ``std_msgs/Bool``, true in swing
    truth: Topic | None = None  # ``std_msgs/Bool`` of a foot switch, used from bags only
    # of the ROS 2 that is talked to; Humble writes no type hashes into keys
    distro: Literal["humble", "iron", "jazzy", "kilted", "lyrical", "rolling"] = "jazzy"
    # ``ROS_DOMAIN_ID``: ROS 2 maps it to UDP ports; beyond 232 there are none left
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    node: Annotated[str, Meta(pattern=r"^[A-Za-z_]\w*\Z")] = (
        "adaptive_contact"  # name of the gateway's node; its topics begin with it
    )


class ServoLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Describes the servo's control law, as far as its registers show it."""

    # position error at which the drive saturates (AX-12A: compliance slope 32 of 1023 steps over
    # 300 degrees, 0.164 rad).  The library offers its neighbours too, so a rough value is enough.
    slope_rad: Annotated[float, Meta(ge=1e-3, le=math.pi)] = 0.164


Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Push = Annotated[float, Meta(ge=-20.0, le=100.0)]


class DetectorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Holds the owner's settings of the detector; figures behind them in decisions 51 to 53."""

    # target per robot-hour (540,000 swing leg-ticks)
    false_alarms_per_hour: Annotated[float, Meta(ge=1e-3, le=1e4)] = 1.0
    # A test ratio below this share of the leg's usual one at a contact is no touch before it has
    # lasted: a trotting quadruped's touches are at 30 times the threshold, jolts by its other feet
    # at up to 3.
    weak_share: Share = 0.125
    # And below this where jolts are likely, as the other feet of the step come down (after the turn
    # to stance), or are larger by its thresholds (of a leg from a prior); touches are 3 ms later.
    shaken_share: Share = 0.5
    lasting_ms: Annotated[float, Meta(ge=0.0, le=1000.0)] = 60.0
    # Deviations: pushes against the motion that add up to this are a contact.
    touch_push: Annotated[float, Meta(ge=1.0, le=1000.0)] = 8.0
    # In a lift, a foot that loses this share of its predicted way has struck something: friction
    # that grows fourfold takes 0.2.
    strike_loss: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.3
    # The push of the last stances, in free sizes, above which a leg carries and below which it
    # hangs.  Legs that hang are at -6 to 2.8 (eight robots of the second engine, and a real
    # quadruped), those that walk at 5 to 8, with drives that hardly give way at 1 to 5.
    carries_push: Push = 3.0
    hangs_push: Push = 0.5
    # p, for the state in every tick: the foot touches above the one, and no longer below the other.
    touches_above: Share = 0.55
    touches_below: Share = 0.45


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """Describes one leg: its joints from the body outwards, and what is known of them."""

    id: str
    joints: Annotated[tuple[Text, ...], Joints]
    # (J,) m, of links that lie along x with all angles 0
    lengths_m: tuple[Annotated[float, Meta(gt=0.0, le=5.0)], ...] | None = None
    axes: tuple[Axis, ...] | None = None  # (J,) of the joints, with all angles 0
    # (J,) m from each joint to the next, the last to the foot's tip, with all angles 0; in place of
    # ``lengths_m``
    origins_m: tuple[Place, ...] | None = None
    quantum_rad: Step | None = None
    mount: Mount = Mount()
    limits: Limits | None = None
    servos: ServoBus | None = None
    angles: Angles | None = None
    ros2: LegRos2 | None = None

    @cached_property
    def joint_axes(self) -> tuple[Axis, ...]:
        """Return the axis of every joint: a word, or a unit vector where no word fits.

        Without ``axes``: a yaw first where there are 3 joints or more.
        """
        if self.axes is not None:
            return tuple(axis if isinstance(axis, str) else _axis(axis) for axis in self.axes)
        first: AxisWord = "yaw" if len(self.joints) >= 3 else "pitch"
        pitch: AxisWord = "pitch"
        return (first, *(pitch for _ in self.joints[1:]))

    @cached_property
    def chain(self) -> Chain | None:
        """Return the leg's geometry; None where neither lengths nor origins are given."""
        if self.origins_m is not None:
            return Chain(self.joint_axes, self.origins_m)
        return None if self.lengths_m is None else straight(self.lengths_m, self.joint_axes)

    def outline(self, q: Sequence[float]) -> list[list[float]]:
        """Compute where joints and foot are on the body.

        Args:
            q: (J,) rad, in the description's angles.

        Returns:
            (J + 1, 3) m in the body's frame, x forward and y to the left; empty where the leg's
            geometry or its mount is not described.
        """
        chain = self.chain
        if chain is None or self.mount == Mount() or len(q) != len(self.joints):
            return []
        return [[*map(float, place)] for place in self.on_body(chain.frames(q)[0])]

    def on_body(self, places: Array) -> Array:
        """Turn places of the leg's frame, (..., 3) m, into the body's."""
        turn = rotation(AXES["yaw"], self.mount.yaw_rad)
        return np.asarray(places @ turn.T + np.array(self.mount.xyz_m))


def _axis(direction: Vector) -> Axis:
    """Return a direction's word, or the unit vector along it."""
    length = math.hypot(*direction)
    x, y, z = (part / length + 0.0 for part in direction)
    return _WORDS.get((x, y, z), (x, y, z))


# Dynamixel's, 1 (AX, RX, MX) or 2 (X-series, MX with that firmware); Feetech's, by series
Protocol = Literal[1, 2, "sts", "scs"]


class Port(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Describes a serial port of the bridge."""

    device: Text  # such as ``/dev/ttyUSB0``
    baud: Baud = 1_000_000  # bits per second
    protocol: Protocol = 1
    fast: bool = False  # read with fast sync read (X-series, firmware 45 or newer)
    # how long an answer may take beyond its bytes
    timeout_ms: Annotated[float, Meta(ge=0.5, le=100.0)] = 5.0
    # ids of servos that are no joint of a leg, such as a head's: they are left alone
    ignore: tuple[ServoId, ...] = ()


class Robot(msgspec.Struct, frozen=True):
    """Describes a robot; checked."""

    name: str
    period_s: float
    quantum_rad: float
    legs: tuple[Leg, ...]
    servo: ServoLaw = ServoLaw()
    detector: DetectorSettings = DetectorSettings()
    ports: dict[str, Port] = {}
    ros2: Ros2 | None = None
    steps_known: bool = True  # `quantum_rad` is described, not assumed

    @property
    def leg_ids(self) -> tuple[str, ...]:
        """Return the legs' ids in the file's order."""
        return tuple(leg.id for leg in self.legs)

    def leg(self, leg_id: str) -> Leg:
        """Return one leg's description.

        Raises:
            ConfigurationError: there is no such leg.
        """
        for leg in self.legs:
            if leg.id == leg_id:
                return leg
        raise ConfigurationError(
            f"robot '{self.name}' has no leg '{leg_id}'; its legs are {', '.join(self.leg_ids)}"
        )

    def quantum(self, leg_id: str) -> float:
        """Return the position step of a leg's servos, rad; a default where none is described."""
        own = self.leg(leg_id).quantum_rad
        return self.quantum_rad if own is None else own

    def knows_step(self, leg_id: str) -> bool:
        """Return whether the position step of a leg's servos is described."""
        return self.steps_known or self.leg(leg_id).quantum_rad is not None
