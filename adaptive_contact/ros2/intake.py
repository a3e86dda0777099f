"""Turns messages of ROS 2 into samples of legs, live and from a bag.

A ``JointTrajectoryControllerState`` holds what a sample needs: ``feedback`` was read and
``reference`` is written in one update of the controller.  A ``JointState`` holds readings; the
command in force is the newest one on the command topic, as ros2_control writes in an update what it
had received before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
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
from adaptive_contact.wire import NS_PER_S, ContactTruth, Message, ServoSample

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
        self.joints = frozenset(self.names)
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
        self._ticks = TickCounter(run, robot.period_s * NS_PER_S, on_problem)
        self._ignored: set[str] = set()  # joints of no leg that have been reported
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

    def convert(
        self, topic: str, type_name: str, message: Any, origin: Origin
    ) -> Sequence[tuple[str, Message]]:
        """Convert a ROS 2 message to samples and truths of legs.

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
        legs = self._roles[topic].states
        whole = type_name == RosType.CONTROLLER_STATE
        names = message.joint_names if whole else message.name
        readings = message.feedback.positions if whole else message.position
        columns = (readings, message.reference.positions) if whole else (readings,)
        values = self._by_name(topic, legs, names, *columns)
        if values is None:
            return
        stamp = message.header.stamp
        stamp_ns = stamp.sec * NS_PER_S + stamp.nanosec
        t_ns = stamp_ns or origin.time_ns  # some nodes leave the stamp empty
        self._offset_ns = t_ns - origin.time_ns
        for leg in legs:
            if values.keys() >= leg.joints:
                rows = [values[name] for name in leg.names]
                sample = self._sample(topic, leg, rows, publisher, t_ns, origin)
                if sample is not None:
                    leg.samples += 1
                    yield leg.id, sample
                continue
            lacking = [name for name in leg.names if name not in names]
            # Several nodes may publish one joint state topic, each its own joints.
            if lacking and (whole or len(lacking) < len(leg.names)):
                self._refuse(
                    topic,
                    "joints_missing",
                    f"leg '{leg.id}' lacks {some(lacking)}; there are {some(names)}: "
                    "correct [leg.ros2] joints",
                )

    def _sample(
        self,
        topic: str,
        leg: _LegState,
        rows: list[list[float]],
        publisher: Publisher,
        t_ns: int,
        origin: Origin,
    ) -> ServoSample | None:
        """Make a leg's sample; None where there is none, though its tick is counted."""
        seq = self._ticks.tick(publisher, leg.id, t_ns, origin)
        measured, *commanded = map(list, zip(*rows, strict=True))
        desired = commanded[0] if commanded else leg.desired.copy()
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
            if commanded:
                good = [math.isfinite(value) for value in desired]
                self._not_finite(topic, leg, good, "the reference")
            else:
                self._no_command(topic, leg)
            return None
        if not commanded and self._moves_without_command(topic, leg, measured):
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

    # -- joints ------------------------------------------------------------------------------------

    def _by_name(
        self, topic: str, legs: Sequence[_LegState], names: Sequence[str], *columns: Any
    ) -> dict[str, list[float]] | None:
        """Return what a message has of each joint; None where it has not one value of each.

        A joint that is named twice is left out: nobody knows which value is meant.
        """
        for column in columns:
            if len(column) != len(names):
                self._refuse(
                    topic,
                    "no_positions",
                    f"{len(column)} positions for {len(names)} joints; expected one of each: let "
                    "the controller have position interfaces",
                )
                return None
        found = {
            name: [float(value) for value in values]
            for name, *values in zip(names, *columns, strict=True)
        }
        known = {name for leg in legs for name in leg.names}
        strange = [name for name in found if name not in known and name not in self._ignored]
        if strange:
            if len(self._ignored) > 1024:
                self._ignored.clear()
            self._ignored.update(strange)
            self._refuse(
                topic,
                "unmapped",
                f"{some(strange)} belong to no leg of robot.toml; ignored: "
                "write them into [leg.ros2] joints if they should",
            )
        twice = [name for name, times in Counter(names).items() if times > 1 and name in known]
        if twice:
            self._refuse(
                topic,
                "named_twice",
                f"a message has {some(twice)} more than once; not used: name each joint once",
            )
        return {name: values for name, values in found.items() if name not in twice}

    # -- commands ----------------------------------------------------------------------------------

    def _commands(self, topic: str, type_name: str, message: Any, roles: _Roles) -> None:
        """Take the commanded angles of a message, where it has some that can be used."""
        if type_name == RosType.ARRAY:
            if roles.order is None:
                self._refuse(
                    topic,
                    "no_positions",
                    "the values carry no names; write command_joints = [...] into [ros2], in "
                    "the controller's order",
                )
                return
            names, positions = roles.order, message.data
        elif type_name == RosType.TRAJECTORY:
            if len(message.points) != 1:
                self._refuse(
                    topic,
                    "trajectory",
                    f"a trajectory of {len(message.points)} points says no command in force; "
                    "take the controller's state topic as `state` instead",
                )
                return
            names, positions = message.joint_names, message.points[0].positions
        else:
            names, positions = message.name, message.position
        values = self._by_name(topic, roles.commands, names, positions)
        if values is None:
            return
        bad = [name for name, (value,) in values.items() if not math.isfinite(value)]
        if bad:
            self._refuse(
                topic,
                "not_finite",
                f"the command of {some(bad)} is NaN or infinite; the last one stays in force",
            )
        for leg in roles.commands:
            for j, name in enumerate(leg.names):
                if name in values and name not in bad:
                    leg.desired[j] = values[name][0]
                    leg.waited, leg.further, leg.nearest = 0, 0, math.inf

    def _truth(self, leg: _LegState, touches: bool, origin: Origin) -> list[tuple[str, Message]]:
        """Return a change of a foot switch, on the clock of the samples' stamps."""
        if self._offset_ns is None or touches == leg.touches:
            return []
        leg.touches = touches
        t_ns = origin.time_ns + self._offset_ns
        # A switch knows no force; it has closed.
        return [(leg.id, ContactTruth(t_ns=t_ns, contact=touches, force=0.0))]
