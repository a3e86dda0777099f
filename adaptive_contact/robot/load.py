"""Reads robots from TOML; errors say what is wrong where, and what is expected there.

Only ``name``, ``period_s`` and the legs' ids and joints are needed; all else is optional.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any, Final, NoReturn, get_args, get_type_hints

import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import parse_toml, read_toml
from adaptive_contact.robot.description import (
    ASSUMED_STEP_RAD,
    Angles,
    AxisWord,
    DetectorSettings,
    Leg,
    LegRos2,
    Limits,
    Mount,
    Port,
    Robot,
    Ros2,
    ServoBus,
    ServoLaw,
)
from adaptive_contact.wire import is_leg_id

# Most legs that one service was tried with (`make many`); most joints of a sample; most letters.
MAX_LEGS: Final = 64
MAX_JOINTS: Final = 16
_LONGEST_NAME: Final = 1000
# Largest length, offset and coordinate of a description, m.
MOST_M: Final = 5.0
# A Dynamixel bus: 253 is reserved, 254 is broadcast.
MAX_SERVO_ID: Final = 252

# Names of ROS: chunks of letters, digits and '_' that begin with no digit.
_CHUNK: Final = r"[A-Za-z_][A-Za-z0-9_]*"
_TOPIC: Final = re.compile(rf"/{_CHUNK}(?:/{_CHUNK})*")
# ROS 2 maps a domain to UDP ports; beyond 232 there are none left.
_MOST_DOMAINS: Final = 232
_TOPICS: Final = ("state", "command", "phase", "truth")

_Fail = Callable[[str], NoReturn]


def check(robot: Robot, source: str) -> None:
    """Refuse a description that no robot can have; ``source`` names it in errors.

    Raises:
        ConfigurationError: in one line, what was found, what was expected.
    """

    def fail(what: str) -> NoReturn:
        raise ConfigurationError(f"{source}: {what}")

    _check_text(robot.name, "[robot] name", fail)
    if not 1e-4 <= robot.period_s <= 1.0:
        fail(f"[robot] period_s is {robot.period_s}; expected 0.0001 to 1 s (0.02 for 50 Hz)")
    if not robot.legs:
        fail("no [[leg]]; describe at least one")
    if len(robot.legs) > MAX_LEGS:
        fail(
            f"{len(robot.legs)} [[leg]]; expected {MAX_LEGS} at most: give each part of the robot "
            "a robot.toml, a service and a --namespace of its own"
        )
    if not 1e-3 <= robot.servo.slope_rad <= math.pi:
        fail(f"[servo] slope_rad is {robot.servo.slope_rad}; expected 0.001 to 3.14 rad")
    if not 1e-3 <= robot.detector.false_alarms_per_hour <= 1e4:
        fail(
            f"[detector] false_alarms_per_hour is {robot.detector.false_alarms_per_hour}; "
            "expected 0.001 to 10000"
        )
    _check_ports(robot, fail)
    seen: set[str] = set()
    for leg in robot.legs:
        where = f"[[leg]] '{leg.id}'"
        if not is_leg_id(leg.id):
            fail(
                f"{where}: an id is 1 to 32 letters, digits, '_', '.' or '-' (it is part of a key)"
            )
        if leg.id in seen:
            fail(f"{where}: the id is used twice; ids must differ")
        seen.add(leg.id)
        _check_leg(robot, leg, where, fail)
    _check_ros2(robot, fail)


def _check_text(text: str, where: str, fail: _Fail) -> None:
    """Refuse a text that a person cannot read and a terminal would obey."""
    if not text.strip():
        fail(f"{where} is empty; write one")
    if not text.isprintable() or len(text) > _LONGEST_NAME:
        fail(f"{where} is {text!r}; expected letters that can be printed, up to {_LONGEST_NAME}")


def _check_ports(robot: Robot, fail: _Fail) -> None:
    for name, port in robot.ports.items():
        if not is_leg_id(name):
            fail(f"[port.{name}]: a name is 1 to 32 letters, digits, '_', '.' or '-'")
        _check_text(port.device, f"[port.{name}] device", fail)
        if port.fast and port.protocol != 2:
            fail(f"[port.{name}] fast is for protocol 2; remove it, or set protocol = 2")
        if not 0.5 <= port.timeout_ms <= 100.0:
            fail(f"[port.{name}] timeout_ms is {port.timeout_ms}; expected 0.5 to 100 (usual: 5)")
        for servo in port.ignore:
            if not 0 <= servo <= MAX_SERVO_ID:
                fail(f"[port.{name}] ignore has {servo}; ids are 0 to {MAX_SERVO_ID}")
    owner: dict[tuple[str | None, int], str] = {}
    for leg in robot.legs:
        servos = leg.servos
        if servos is None:
            continue
        where = f"[[leg]] '{leg.id}'"
        if servos.port is not None and servos.port not in robot.ports:
            known = ", ".join(robot.ports) or "none"
            fail(f"{where}: servos.port is '{servos.port}'; there is no such [port.NAME] ({known})")
        if servos.port is None and len(robot.ports) > 1:
            fail(f"{where}: servos.port is missing; name one of {', '.join(robot.ports)}")
        if not 1e-3 <= servos.max_step_rad <= 1.0:
            fail(f"{where}: servos.max_step_rad is {servos.max_step_rad}; expected 0.001 to 1 rad")
        for servo in servos.ids:
            if not 0 <= servo <= MAX_SERVO_ID:
                fail(f"{where}: servo id {servo}; ids are 0 to {MAX_SERVO_ID}")
            for name, port in robot.ports.items():
                if servos.port in (name, None) and servo in port.ignore:
                    fail(
                        f"{where}: servo id {servo} is in ignore of [port.{name}], too; take it "
                        "out of one of them"
                    )
            # A leg may leave out the only port.
            on = servos.port or next(iter(robot.ports), None)
            before = owner.setdefault((on, servo), leg.id)
            if before != leg.id or servos.ids.count(servo) > 1:
                fail(
                    f"{where}: servo id {servo} is used twice on a port (by leg '{before}'); give "
                    "every servo an id of its own"
                )


def _check_leg(robot: Robot, leg: Leg, where: str, fail: _Fail) -> None:
    joints = len(leg.joints)
    quantum = robot.quantum(leg.id)
    if not 1 <= joints <= MAX_JOINTS:
        has = f"has {joints} names" if joints else "is empty"
        fail(f"{where}: joints {has}; expected 1 to {MAX_JOINTS} names")
    for joint in leg.joints:
        _check_text(joint, f"{where}: the name of a joint", fail)
    if len(set(leg.joints)) != joints:
        fail(f"{where}: joints {list(leg.joints)} repeat a name; names must differ")
    if not 1e-6 <= quantum <= 0.2:
        fail(f"{where}: quantum_rad is {quantum}; expected 1e-6 to 0.2 rad (AX-12A: 0.00511)")
    sized: list[tuple[str, tuple[object, ...] | None]] = [
        ("lengths_m", leg.lengths_m),
        ("axes", leg.axes),
        ("origins_m", leg.origins_m),
        ("limits.lower_rad", leg.limits.lower_rad if leg.limits else None),
        ("limits.upper_rad", leg.limits.upper_rad if leg.limits else None),
        ("servos.ids", leg.servos.ids if leg.servos else None),
        ("servos.model", leg.servos.models if leg.servos else None),
        ("servos.directions", leg.servos.directions if leg.servos else None),
        ("servos.offsets_rad", leg.servos.offsets_rad if leg.servos else None),
        ("angles.directions", leg.angles.directions if leg.angles else None),
        ("angles.offsets_rad", leg.angles.offsets_rad if leg.angles else None),
    ]
    for name, values in sized:
        if values is not None and len(values) != joints:
            fail(f"{where}: {name} has {len(values)} values for {joints} joints")
    _check_chain(leg, where, fail)
    if leg.limits is not None:
        for low, high in zip(leg.limits.lower_rad, leg.limits.upper_rad, strict=True):
            if not -2 * math.pi <= low < high <= 2 * math.pi:
                fail(
                    f"{where}: limits {low} .. {high} rad; expected lower below upper, within 2 pi"
                )
    for table, of in (("servos", leg.servos), ("angles", leg.angles)):
        if of is not None and any(d not in (-1, 1) for d in of.directions or ()):
            fail(f"{where}: {table}.directions are {list(of.directions or ())}; use 1 or -1")
        for offset in (of.offsets_rad if of else None) or ():
            if not _is_angle(offset):
                fail(f"{where}: {table}.offsets_rad has {offset}; expected -6.28 to 6.28 rad")
    if not all(abs(x) <= MOST_M for x in leg.mount.xyz_m):
        fail(f"{where}: mount.xyz_m is {list(leg.mount.xyz_m)}; expected metres, up to 5")
    if not _is_angle(leg.mount.yaw_rad):
        fail(f"{where}: mount.yaw_rad is {leg.mount.yaw_rad}; expected -6.28 to 6.28 rad")


def _is_angle(value: float) -> bool:
    """Return whether a value is within a turn each way; False for NaN."""
    return -2 * math.pi <= value <= 2 * math.pi


def _check_chain(leg: Leg, where: str, fail: _Fail) -> None:
    for axis in leg.axes or ():
        if not isinstance(axis, str) and not 1e-3 <= math.hypot(*axis) < math.inf:
            fail(f"{where}: axes has {list(axis)}; expected a direction such as [0, 1, 0]")
    if leg.lengths_m is not None and not all(0 < x <= MOST_M for x in leg.lengths_m):
        fail(f"{where}: lengths_m is {list(leg.lengths_m)}; expected metres above 0, up to 5")
    origins = leg.origins_m
    if origins is not None and leg.lengths_m is not None:
        fail(
            f"{where}: has lengths_m and origins_m; give one: lengths_m of links that lie along x, "
            "origins_m of any others"
        )
    if origins is not None and not all(abs(x) <= MOST_M for origin in origins for x in origin):
        fail(f"{where}: origins_m is {[list(o) for o in origins]}; expected metres, up to 5")
    chain = leg.chain
    if chain is None:
        return
    if chain.reach_m < 1e-3:
        fail(
            f"{where}: reaches {chain.reach_m:g} m; expected the way from each joint to the next, m"
        )
    if not any(chain.origins_m[-1]):
        fail(
            f"{where}: origins_m ends with [0, 0, 0], so that '{leg.joints[-1]}' moves nothing; "
            "expected the way from this joint to the foot's tip, m"
        )
    if not chain.raises_foot:
        if chain.is_straight:
            fail(f"{where}: no joint pitches, so that its foot never rises; leave lengths_m out")
        key = "lengths_m" if origins is None else "origins_m"
        fail(f"{where}: no joint raises the foot; look at axes, or leave {key} out")


def _check_ros2(robot: Robot, fail: _Fail) -> None:
    shared = robot.ros2
    if shared is not None:
        if not 0 <= shared.domain <= _MOST_DOMAINS:
            fail(f"[ros2] domain is {shared.domain}; expected 0 to {_MOST_DOMAINS} (ROS_DOMAIN_ID)")
        if re.fullmatch(_CHUNK, shared.node) is None:
            fail(f"[ros2] node is '{shared.node}'; expected letters, digits and '_'")
        for key in _TOPICS:
            _check_topic(getattr(shared, key), f"[ros2] {key}", fail, leg="leg")
        mapped = [leg.id for leg in robot.legs if leg.ros2 is not None]
        for key in ("phase", "truth"):  # a Bool is about one leg
            if len(mapped) > 1 and "{leg}" not in (getattr(shared, key) or "{leg}"):
                fail(f"[ros2] {key} is one topic for {len(mapped)} legs; write {{leg}} into it")
    owner: dict[tuple[str, str], str] = {}
    for leg in robot.legs:
        own = leg.ros2
        if own is None:
            continue
        where = f"[[leg]] '{leg.id}'"
        if shared is None:
            fail(f"{where}: [leg.ros2] without [ros2]; write [ros2] and its state topic")
        if len(own.joints) != len(leg.joints):
            fail(f"{where}: ros2.joints has {len(own.joints)} values for {len(leg.joints)} joints")
        for key in _TOPICS:
            _check_topic(getattr(own, key), f"{where}: ros2.{key}", fail, leg=leg.id)
            topic = getattr(shared, key)
            if topic is not None and getattr(own, key) is None and "{leg}" in topic:
                _check_topic(topic, f"{where}: [ros2] {key}", fail, leg=leg.id)
        state = own.state or shared.state
        if state is None:
            fail(
                f"{where}: no state topic; write state in [ros2] or [leg.ros2], such as "
                '"/leg_controller/controller_state"'
            )
        state = state.replace("{leg}", leg.id)
        for joint in own.joints:
            if not joint:
                fail(f"{where}: ros2.joints has an empty name; write those that {state} has")
            before = owner.setdefault((state, joint), leg.id)
            if before != leg.id or own.joints.count(joint) > 1:
                fail(
                    f"{where}: ros2.joints has '{joint}' of {state} twice (leg '{before}' has it, "
                    "too); each joint belongs to one leg"
                )
        order = own.command_joints or shared.command_joints
        lacking = [joint for joint in own.joints if order is not None and joint not in order]
        if lacking:
            fail(f"{where}: command_joints lacks {', '.join(lacking)} of ros2.joints")


def _check_topic(topic: str | None, where: str, fail: _Fail, *, leg: str) -> None:
    if topic is not None and _TOPIC.fullmatch(topic.replace("{leg}", leg)) is None:
        fail(
            f"{where} is '{topic}'; expected a topic such as /joint_states, with a leading slash, "
            "of letters, digits, '_' and '{leg}'"
        )


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    period_s: float
    quantum_rad: float | None = None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robot: _Head
    leg: tuple[Leg, ...]
    servo: ServoLaw = ServoLaw()
    detector: DetectorSettings = DetectorSettings()
    port: dict[str, Port] = {}
    ros2: Ros2 | None = None


def load_robot(path: str | Path) -> Robot:
    """Load and check a robot description.

    Args:
        path: a ``robot.toml``, or the name of a robot that ships.

    Raises:
        ConfigurationError: in one line, what is wrong in the file and what is expected there.
    """
    path = Path(path)
    if is_shipped(path):
        return shipped_robot(path.name)
    names = ", ".join(_shipped_names())
    advice = f"give the path of a robot.toml, or a shipped robot's name ({names})"
    return _robot_of(read_toml(path, advice), str(path))


@functools.cache  # a description cannot change
def shipped_robot(name: str = "hexapod") -> Robot:
    """Load a robot that ships in ``adaptive_contact_models``.

    Raises:
        ConfigurationError: no robot of that name ships.
    """
    models = resources.files("adaptive_contact_models")
    file = models.joinpath(name, "robot.toml")
    if not file.is_file():
        raise ConfigurationError(
            f"no robot '{name}' ships with adaptive-contact; there are "
            f"{', '.join(_shipped_names())}, others are described in a robot.toml"
        )
    return parse_robot(file.read_text(encoding="utf-8"), source=f"{name}/robot.toml")


def is_shipped(path: str | Path) -> bool:
    """Return whether a path is the name of a robot that ships, and of no file."""
    path = Path(path)
    return str(path) in _shipped_names() and not path.is_file()


def recorded_as(name: str) -> Robot | None:
    """Load the shipped robot of this name, its folder's or its own; None if there is none."""
    robots = {folder: shipped_robot(folder) for folder in _shipped_names()}
    return next((one for at, one in robots.items() if name in (at, one.name)), None)


def _shipped_names() -> list[str]:
    models = resources.files("adaptive_contact_models")
    folders = (entry for entry in models.iterdir() if entry.joinpath("robot.toml").is_file())
    return sorted(folder.name for folder in folders)


def parse_robot(text: str, *, source: str) -> Robot:
    """Parse and check the text of a robot description; ``source`` names it in errors.

    Raises:
        ConfigurationError: see :func:`load_robot`.
    """
    return _robot_of(parse_toml(text, source), source)


def _robot_of(table: dict[str, Any], source: str) -> Robot:
    try:
        file = msgspec.convert(table, _File, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{source}: {_explain(str(error))}") from error
    step_rad = file.robot.quantum_rad
    robot = Robot(
        name=file.robot.name,
        period_s=file.robot.period_s,
        quantum_rad=ASSUMED_STEP_RAD if step_rad is None else step_rad,
        legs=file.leg,
        servo=file.servo,
        detector=file.detector,
        ports=file.port,
        ros2=file.ros2,
        steps_known=step_rad is not None,
    )
    check(robot, source)
    return robot


_TABLES: Final = _File.__struct_fields__
_FIELDS: Final = sorted(
    {
        *_TABLES,
        *(name for kind in (_Head, Leg, Mount, Limits, Angles, ServoBus, ServoLaw,
                       DetectorSettings, Port, Ros2, LegRos2)
          for name in kind.__struct_fields__),
    }
)  # fmt: skip


def _explain(text: str) -> str:
    """Turn msgspec's words into a person's: where, and the nearest known name."""
    text = text.replace("Object contains unknown field", "unknown key")
    text = text.replace("Object missing required field", "missing key")
    text = text.replace("$.", "").replace("`$`", "the top level").replace("[...]", "")
    if "unknown key" in text:
        wrong = text.split("`")[1]
        if wrong in _TABLES:  # TOML takes what stands below a table for a part of it
            return f"{text}; write it above the first [table], or as a table of its own"
        if wrong in _FIELDS:
            return f"{text}; it belongs to another table, see docs/robot.md"
        near = difflib.get_close_matches(wrong, _FIELDS, n=1)
        hint = f"did you mean `{near[0]}`?" if near else "remove it"
        return f"{text}; {hint}"
    if "missing key" in text:
        name = text.split("`")[1]
        return f"{text}; {_EXAMPLES.get(name, 'docs/robot.md has an example')}"
    key = re.split(r"[.\[]", text.rstrip("`0123456789[]"))[-1]
    if "Invalid enum value" in text:
        return f"{text}; expected {_CHOICES.get(key, 'one that docs/robot.md names')}"
    wrong_type = re.fullmatch(r"Expected `(.+)`(?: of length 3)?, got `?(\w+)`? - at `(.+)`", text)
    if wrong_type:
        expected, got, where = wrong_type.groups()
        kinds = [_KINDS.get(kind, kind) for kind in expected.split(" | ") if kind != "null"]
        found = f"has {got} values" if got.isdigit() else f"is {_KINDS.get(got, got)}"
        wanted = "3 numbers" if got.isdigit() else " or ".join(kinds)
        return f"{where} {found}; expected {_CHOICES.get(key, wanted)}"
    return text


_EXAMPLES: Final = {
    "robot": "begin with [robot], its name and period_s",
    "leg": "describe each with [[leg]], id and joints",
    "id": 'such as id = "rf"',
    "joints": 'such as joints = ["coxa", "femur", "tibia"]',
    "name": 'such as name = "mybot"',
    "period_s": "such as period_s = 0.02",
}

_CHOICES: Final = {
    "axes": f"{', '.join(get_args(AxisWord))}, or a direction such as [0, 1, 0], for each joint",
    "origins_m": "the way to the next joint, m, such as [0, 0, -0.2], for each joint",
    "protocol": '1 (AX, RX, MX), 2 (X-series, MX with that firmware), "sts" or "scs" (Feetech)',
    "distro": ", ".join(get_args(get_type_hints(Ros2)["distro"])),
}

# What TOML calls msgspec's types.
_KINDS: Final = {
    "int": "a whole number",
    "float": "a number",
    "str": 'a text ("...")',
    "bool": "true or false",
    "array": "a list ([...])",
    "object": "a table",
}
