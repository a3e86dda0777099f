"""Turns messages of ROS 2 into samples of legs, live and from a bag.

A ``JointTrajectoryControllerState`` holds what a sample needs: ``feedback`` was read and
``reference`` is written in one update of the controller.  A ``JointState`` holds readings; the
command in force is the newest one on the command topic, as ros2_control writes in an update what it
had received before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Leg, Robot
from adaptive_contact.ros2.problems import (
    CdrError,
    OnProblem,
    UnknownHashError,
    some,
)
from adaptive_contact.ros2.rmw import COMMANDS, FLAGS, STATES, RosType
from adaptive_contact.ros2.ticks import Origin, Publisher, TickCounter
from adaptive_contact.wire import ContactTruth, Message, ServoSample

_NS: Final = 1_000_000_000
# A leg that moves _MOVED_RAD away from its last command, this long after it, follows commands that
# do not arrive.  One that holds its pose, or is still on its way, needs none.
_NO_COMMAND_S: Final = 1.0
_FURTHER: Final = 3  # one reading may be wrong

# Reads a message of a type and a hash of its definition.
Decode = Callable[[str, str, bytes], Any]


def check_mapped(robot: Robot, source: str) -> None:
    """Refuse a robot that names no topics of ROS 2.

    Raises:
        ConfigurationError: it has no ``[ros2]``.
    """
    if robot.ros2 is None:
        raise ConfigurationError(
            f"{source}: names no topics of ROS 2; write [ros2] with its state topic, and "
            "[leg.ros2] joints = [...] below each [[leg]] (docs/ros2.md)"
        )


class _LegState:
    """Holds what is known of a leg between messages."""

    def __init__(self, leg: Leg) -> None:
        assert leg.ros2 is not None
        self.id = leg.id
        self.names = leg.ros2.joints
        self.measured: list[float] | None = None
        self.desired = [math.nan] * len(self.names)
        self.phase: bool | None = None
        self.touches: bool | None = None
        self.commanded = False
        self.samples = 0
        self.waited = 0  # readings since the last command
        # After _NO_COMMAND_S: least distance to the command, rad, and readings in a row that are
        # further away.
        self.nearest = math.inf
        self.further = 0


class _Roles:
    """Describes what a topic carries, and for which legs."""

    def __init__(self) -> None:
        self.states: list[_LegState] = []
        self.commands: list[_LegState] = []
        self.order: tuple[str, ...] | None = None
        self.phase: _LegState | None = None
        self.truth: _LegState | None = None

    @property
    def types(self) -> tuple[str, ...]:
        """Return the types that the topic may have."""
        found: dict[str, None] = {}
        found |= dict.fromkeys(STATES if self.states else ())
        found |= dict.fromkeys(COMMANDS if self.commands else ())
        found |= dict.fromkeys(FLAGS if self.phase or self.truth else ())
        return tuple(found)


class Intake:
    """Makes samples of messages.

    Args:
        robot: whose ``[ros2]`` says which joint and topic is which.
        run: of the samples of the first publisher; those of later ones are larger.
        on_problem: called with whatever is not used.

    Attributes:
        legs: those that are mapped.
        unmapped: legs of the robot that are not.

    Raises:
        ConfigurationError: the robot has no ``[ros2]``.
    """

    def __init__(self, robot: Robot, run: int, on_problem: OnProblem) -> None:
        self._legs = {leg.id: _LegState(leg) for leg in robot.legs if leg.ros2 is not None}
        check_mapped(robot, f"robot '{robot.name}'")
        self.legs = tuple(self._legs)
        self.unmapped = tuple(leg for leg in robot.leg_ids if leg not in self._legs)
        self._robot = robot
        self._refuse = on_problem
        self._roles: dict[str, _Roles] = {}
        self._ticks = TickCounter(run, robot.period_s * _NS, on_problem)
        self._layouts: dict[str, dict[tuple[str, ...], list[tuple[_LegState, list[int]]]]] = {}
        self._no_command_ticks = round(_NO_COMMAND_S / robot.period_s)
        self._offset_ns: int | None = None
        for leg in robot.legs:
            if leg.ros2 is not None:
                self._map(leg, self._legs[leg.id])

    def _map(self, leg: Leg, state: _LegState) -> None:
        own, shared = leg.ros2, self._robot.ros2
        assert own is not None
        assert shared is not None

        def roles(role: str) -> _Roles | None:
            topic = getattr(own, role) or getattr(shared, role)
            if topic is None:
                return None
            return self._roles.setdefault(topic.replace("{leg}", leg.id), _Roles())

        found = roles("state")
        assert found is not None  # checked on load
        found.states.append(state)
        if (commanded := roles("command")) is not None:
            commanded.commands.append(state)
            state.commanded = True
            commanded.order = own.command_joints or shared.command_joints
        if (turned := roles("phase")) is not None:
            turned.phase = state
        if (switched := roles("truth")) is not None:
            switched.truth = state

    def topics(self, *, truth: bool) -> dict[str, tuple[str, ...]]:
        """Return the topics to read, and the types that each may have.

        Args:
            truth: those of foot switches, too.
        """
        return {
            topic: roles.types
            for topic, roles in self._roles.items()
            if truth or roles.states or roles.commands or roles.phase
        }

    @property
    def silent(self) -> tuple[str, ...]:
        """Return the legs of which no sample has been made yet."""
        return tuple(leg.id for leg in self._legs.values() if not leg.samples)

    def topics_of(self, leg: str) -> tuple[str, ...]:
        """Return the topics that a leg's samples are made of."""
        state = self._legs[leg]
        return tuple(
            topic
            for topic, roles in self._roles.items()
            if state in roles.states or state in roles.commands
        )

    def read(
        self, decode: Decode, topic: str, type_name: str, type_hash: str, payload: bytes
    ) -> Any | None:
        """Read a message of a mapped topic from its CDR; None where it was refused."""
        expected = self._roles[topic].types
        if type_name not in expected:
            self._refuse(
                topic,
                "wrong_type",
                f"carries {type_name}; expected {' or '.join(expected)}: "
                "correct the topic in robot.toml",
            )
            return None
        try:
            return decode(type_name, type_hash, payload)
        except UnknownHashError as error:
            self._refuse(
                topic,
                "wrong_hash",
                f"{type_name} has the type hash {type_hash[:15]}…, another definition "
                f"than those known ({error}); not used: publish with the distribution's own",
            )
        except CdrError as error:
            self._refuse(topic, "unreadable", f"a message is no {type_name} ({error}); not used")
        return None

    def take(
        self, topic: str, type_name: str, message: Any, origin: Origin
    ) -> Sequence[tuple[str, Message]]:
        """Process a message.

        Returns:
            (leg, sample or truth) that it makes.
        """
        roles = self._roles[topic]
        made: list[tuple[str, Message]] = []
        if roles.states and type_name in STATES:
            made += self._states(topic, type_name, message, origin)
        if roles.commands and type_name in COMMANDS:
            self._commands(topic, type_name, message, roles)
        if type_name in FLAGS:
            if roles.phase is not None:
                roles.phase.phase = bool(message.data)
            if roles.truth is not None:
                made += self._truth(roles.truth, bool(message.data), origin)
        return made

    # -- readings ----------------------------------------------------------------------------------

    def _states(
        self, topic: str, type_name: str, message: Any, origin: Origin
    ) -> Iterable[tuple[str, Message]]:
        publisher = self._ticks.publisher(topic, origin)
        if publisher is None:
            return
        whole = type_name == RosType.CONTROLLER_STATE
        if whole:
            names = message.joint_names
            readings, commands = message.feedback.positions, message.reference.positions
        else:
            names, readings, commands = message.name, message.position, None
        if len(readings) != len(names) or (commands is not None and len(commands) != len(names)):
            which = "feedback or reference" if whole else "position"
            found = min(len(readings), len(readings if commands is None else commands))
            self._refuse(
                topic,
                "no_positions",
                f"{which} has {found} positions for {len(names)} joints; "
                "expected one of each: let the controller have position interfaces",
            )
            return
        stamp = message.header.stamp
        stamp_ns = stamp.sec * _NS + stamp.nanosec
        t_ns = stamp_ns or origin.time_ns  # some nodes leave the stamp empty
        self._offset_ns = t_ns - origin.time_ns
        for leg, at in self._layout(topic, tuple(names), whole=whole):
            sample = self._sample(topic, leg, at, readings, commands, publisher, t_ns, origin)
            if sample is not None:
                leg.samples += 1
                yield leg.id, sample

    def _sample(
        self,
        topic: str,
        leg: _LegState,
        at: list[int],
        readings: Any,
        commands: Any,
        publisher: Publisher,
        t_ns: int,
        origin: Origin,
    ) -> ServoSample | None:
        """Make a leg's sample; None where there is none, though its tick is counted."""
        seq = self._ticks.tick(publisher, leg.id, t_ns, origin)
        measured = [float(readings[i]) for i in at]
        if commands is not None:
            desired = [float(commands[i]) for i in at]
        else:
            desired = leg.desired.copy()
        valid: list[bool] | None = None
        if not all(map(math.isfinite, measured)):
            valid = [math.isfinite(value) for value in measured]
            self._not_finite(topic, leg, valid, "a reading")
            if leg.measured is None:
                return None
            measured = [
                value if good else last
                for value, good, last in zip(measured, valid, leg.measured, strict=True)
            ]
        leg.measured = measured
        if not all(map(math.isfinite, desired)):
            if commands is None:
                self._no_command(topic, leg)
            else:
                good = [math.isfinite(value) for value in desired]
                self._not_finite(topic, leg, good, "the reference")
            return None
        if commands is None and self._moves_without_command(topic, leg, measured):
            return None
        return ServoSample(
            t_ns=t_ns,
            seq=seq,
            measured=measured,
            desired=desired,
            phase=None if leg.phase is None else ("swing" if leg.phase else "stance"),
            valid=valid,
            run=publisher.run,
        )

    def _no_command(self, topic: str, leg: _LegState) -> None:
        lacking = [n for n, value in zip(leg.names, leg.desired, strict=True) if math.isnan(value)]
        remedy = "wait, or look whether anybody publishes on the command topic of robot.toml"
        if not leg.commanded:
            remedy = "a JointState holds readings only: write the command topic into [ros2]"
        self._refuse(
            topic,
            "no_command",
            f"leg '{leg.id}' has readings and no command yet for {some(lacking)}; {remedy}",
        )

    def _moves_without_command(self, topic: str, leg: _LegState, measured: list[float]) -> bool:
        """Return whether the leg has left its last command: a newer one must be in force."""
        leg.waited += 1
        if leg.waited >= self._no_command_ticks and leg.further < _FURTHER:
            off = math.dist(measured, leg.desired)
            leg.nearest = min(leg.nearest, off)
            leg.further = leg.further + 1 if off > leg.nearest + 0.2 else 0
        if leg.further == _FURTHER:
            self._refuse(
                topic,
                "no_command",
                f"leg '{leg.id}' goes elsewhere, and its last command is more than "
                f"{_NO_COMMAND_S:g} s old; no samples meanwhile: look whether the command topic is "
                "still published",
            )
        return leg.further == _FURTHER

    def _not_finite(self, topic: str, leg: _LegState, good: list[bool], what: str) -> None:
        names = [name for name, finite in zip(leg.names, good, strict=True) if not finite]
        self._refuse(
            topic,
            "not_finite",
            f"{what} of {some(names)} is NaN or infinite; not used: "
            "look whether the hardware answers and the controller is active",
        )

    # -- layout ------------------------------------------------------------------------------------

    def _layout(
        self, topic: str, names: tuple[str, ...], *, whole: bool
    ) -> list[tuple[_LegState, list[int]]]:
        """Find which value of a message belongs to which joint of which leg."""
        layouts = self._layouts.setdefault(topic, {})
        found = layouts.get(names)
        if found is None:
            # Distinct sets of joint names of one topic that are kept.
            if len(layouts) >= 64:
                layouts.clear()
            found = layouts[names] = self._lay_out(topic, names)
        if len(found) < len(self._roles[topic].states):
            self._tell_missing(topic, names, whole=whole)
        return found

    def _lay_out(self, topic: str, names: tuple[str, ...]) -> list[tuple[_LegState, list[int]]]:
        where = {name: i for i, name in enumerate(names)}
        twice = _twice(names)
        mapped: set[str] = set()
        found = []
        for leg in self._roles[topic].states:
            mapped.update(leg.names)
            if where.keys() >= set(leg.names) and twice.isdisjoint(leg.names):
                found.append((leg, [where[name] for name in leg.names]))
        self._ignore(topic, [name for name in names if name not in mapped])
        return found

    def _ignore(self, topic: str, names: Sequence[str]) -> None:
        if names:
            self._refuse(
                topic,
                "unmapped",
                f"{some(names)} belong to no leg of robot.toml; ignored: "
                "write them into [leg.ros2] joints if they should",
            )

    def _refuse_twice(self, topic: str, names: Sequence[str]) -> None:
        self._refuse(
            topic,
            "named_twice",
            f"a message has {some(names)} more than once; not used: name each joint once",
        )

    def _tell_missing(self, topic: str, names: tuple[str, ...], *, whole: bool) -> None:
        """Report legs that lack joints; of a controller's state, also legs that lack all."""
        twice = _twice(names)
        for leg in self._roles[topic].states:
            if doubled := [name for name in leg.names if name in twice]:
                self._refuse_twice(topic, doubled)
            lacking = [name for name in leg.names if name not in names]
            # Several nodes may publish one joint state topic, each its own joints.
            if lacking and (whole or len(lacking) < len(leg.names)):
                self._refuse(
                    topic,
                    "joints_missing",
                    f"leg '{leg.id}' lacks {some(lacking)}; there are {some(names)}: "
                    "correct [leg.ros2] joints",
                )

    # -- commands ----------------------------------------------------------------------------------

    def _commands(self, topic: str, type_name: str, message: Any, roles: _Roles) -> None:
        values = self._command_values(topic, type_name, message, roles)
        if values is None:
            return
        known = {name for leg in roles.commands for name in leg.names}
        if values and known.isdisjoint(values):
            self._ignore(topic, list(values))
        bad = [name for name, value in values.items() if not math.isfinite(value)]
        if bad:
            self._refuse(
                topic,
                "not_finite",
                f"the command of {some(bad)} is NaN or infinite; the last one stays in force",
            )
        for leg in roles.commands:
            for j, name in enumerate(leg.names):
                if name in values and math.isfinite(values[name]):
                    leg.desired[j] = values[name]
                    leg.waited, leg.further, leg.nearest = 0, 0, math.inf

    def _command_values(
        self, topic: str, type_name: str, message: Any, roles: _Roles
    ) -> Mapping[str, float] | None:
        """Return the commanded angles by joint; None where a message has none that can be used."""
        if type_name == RosType.ARRAY:
            names, positions = roles.order, message.data
            if names is None:
                self._refuse(
                    topic,
                    "no_positions",
                    "the values carry no names; write command_joints = [...] into [ros2], in "
                    "the controller's order",
                )
                return None
        elif type_name == RosType.TRAJECTORY:
            if len(message.points) != 1:
                self._refuse(
                    topic,
                    "trajectory",
                    f"a trajectory of {len(message.points)} points says no command in force; "
                    "take the controller's state topic as `state` instead",
                )
                return None
            names, positions = message.joint_names, message.points[0].positions
        else:
            names, positions = message.name, message.position
        if len(names) != len(positions):
            self._refuse(
                topic,
                "no_positions",
                f"{len(positions)} positions for {len(names)} joints; expected one of each",
            )
            return None
        if twice := _twice(names):
            self._refuse_twice(topic, sorted(twice))
        pairs = zip(names, positions, strict=True)
        return {name: float(value) for name, value in pairs if name not in twice}

    def _truth(self, leg: _LegState, touches: bool, origin: Origin) -> list[tuple[str, Message]]:
        """Return a change of a foot switch, on the clock of the samples' stamps."""
        if self._offset_ns is None or touches == leg.touches:
            return []
        leg.touches = touches
        t_ns = origin.time_ns + self._offset_ns
        # A switch knows no force; it has closed.
        return [(leg.id, ContactTruth(t_ns=t_ns, contact=touches, force=0.0))]


def _twice(names: Sequence[str]) -> set[str]:
    """Names that come more than once: nobody knows which value is meant."""
    return {name for name, times in Counter(names).items() if times > 1}
