"""Reads robots from TOML; errors say what is wrong where, and what is expected there.

Only ``name``, ``period_s`` and the legs' ids and joints are needed; all else is optional.
"""

from __future__ import annotations

import functools
import math
import re
import reprlib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final, NoReturn, get_args, get_type_hints

import msgspec
from msgspec import Meta

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import parse_toml, read_toml
from adaptive_contact.printable import did_you_mean
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
    Step,
    Text,
)
from adaptive_contact.wire import is_leg_id

# Most legs that one service was tried with (`make many`).
MAX_LEGS: Final = 64
_TOPICS: Final = ("state", "command", "phase", "truth")

_Fail = Callable[[str], NoReturn]


def check(robot: Robot, source: str) -> None:
    """Refuse a description whose parts contradict each other; ``source`` names it in errors.

    Bounds of single values are those of their types.

    Raises:
        ConfigurationError: in one line, what was found, what was expected.
    """

    def fail(what: str) -> NoReturn:
        raise ConfigurationError(f"{source}: {what}")

    _check_text(robot.name, "[robot] name", fail)
    _check_ports(robot, fail)
    for low, high in (("hangs_push", "carries_push"), ("touches_below", "touches_above")):
        least, most = getattr(robot.detector, low), getattr(robot.detector, high)
        if least > most:
            fail(f"[detector] {low} is {least:g}; expected at most {high}, which is {most:g}")
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
        _check_leg(leg, where, fail)
    _check_ros2(robot, fail)


def _check_text(text: str, where: str, fail: _Fail) -> None:
    """Refuse a text that a person cannot read and a terminal would obey."""
    if not text.strip() or not text.isprintable():
        fail(f"{where} is {text!r}; expected letters that can be printed")


def _check_ports(robot: Robot, fail: _Fail) -> None:
    for name, port in robot.ports.items():
        if not is_leg_id(name):
            fail(f"[port.{name}]: a name is 1 to 32 letters, digits, '_', '.' or '-'")
        _check_text(port.device, f"[port.{name}] device", fail)
        if port.fast and port.protocol != 2:
            fail(f"[port.{name}] fast is for protocol 2; remove it, or set protocol = 2")
    owner: dict[tuple[str | None, int], str] = {}
    for leg in robot.legs:
        servos = leg.servos
        if servos is None:
            continue
        where = f"[[leg]] '{leg.id}'"
        known = ", ".join(robot.ports) or "none"
        if servos.port is not None and servos.port not in robot.ports:
            fail(f"{where}: servos.port is '{servos.port}'; there is no such [port.NAME] ({known})")
        if servos.port is None and len(robot.ports) > 1:
            fail(f"{where}: servos.port is missing; name one of {known}")
        # A leg may leave out the only port.
        on = servos.port or next(iter(robot.ports), None)
        for servo in servos.ids:
            if on is not None and servo in robot.ports[on].ignore:
                fail(
                    f"{where}: servo id {servo} is in ignore of [port.{on}], too; take it out of "
                    "one of them"
                )
            before = owner.setdefault((on, servo), leg.id)
            if before != leg.id or servos.ids.count(servo) > 1:
                fail(
                    f"{where}: servo id {servo} is used twice on a port (by leg '{before}'); give "
                    "every servo an id of its own"
                )


def _check_leg(leg: Leg, where: str, fail: _Fail) -> None:
    joints = len(leg.joints)
    for joint in leg.joints:
        _check_text(joint, f"{where}: the name of a joint", fail)
    if len(set(leg.joints)) != joints:
        fail(f"{where}: joints {list(leg.joints)} repeat a name; names must differ")
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
        ("ros2.joints", leg.ros2.joints if leg.ros2 else None),
    ]
    for name, values in sized:
        if values is not None and len(values) != joints:
            fail(f"{where}: {name} has {len(values)} values for {joints} joints")
    _check_chain(leg, where, fail)
    if leg.limits is not None:
        for low, high in zip(leg.limits.lower_rad, leg.limits.upper_rad, strict=True):
            if low >= high:
                fail(f"{where}: limits {low} .. {high} rad; expected lower below upper")


def _check_chain(leg: Leg, where: str, fail: _Fail) -> None:
    for axis in leg.axes or ():
        if not isinstance(axis, str) and not 1e-3 <= math.hypot(*axis) < math.inf:
            fail(f"{where}: axes has {list(axis)}; expected a direction such as [0, 1, 0]")
    if leg.origins_m is not None and leg.lengths_m is not None:
        fail(
            f"{where}: has lengths_m and origins_m; give one: lengths_m of links that lie along x, "
            "origins_m of any others"
        )
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
        key = "lengths_m" if leg.origins_m is None else "origins_m"
        fail(f"{where}: no joint raises the foot; look at axes, or leave {key} out")


def _check_ros2(robot: Robot, fail: _Fail) -> None:
    shared = robot.ros2
    mapped = {leg.id: leg.ros2 for leg in robot.legs if leg.ros2 is not None}
    if shared is None:
        for leg in mapped:
            fail(f"[[leg]] '{leg}': [leg.ros2] without [ros2]; write [ros2] and its state topic")
        return
    for key in ("phase", "truth"):  # a Bool is about one leg
        if len(mapped) > 1 and "{leg}" not in (getattr(shared, key) or "{leg}"):
            fail(f"[ros2] {key} is one topic for {len(mapped)} legs; write {{leg}} into it")
    owner: dict[tuple[str, str], str] = {}
    for leg, own in mapped.items():
        where = f"[[leg]] '{leg}'"
        topics = [getattr(own, key) or getattr(shared, key) or "" for key in _TOPICS]
        if any("{leg}" in topic for topic in topics) and not re.fullmatch(r"\w+", leg, re.ASCII):
            fail(f"{where}: the id is no part of a topic; write its ros2 topics without {{leg}}")
        state = topics[0].replace("{leg}", leg)
        if not state:
            fail(
                f"{where}: no state topic; write state in [ros2] or [leg.ros2], such as "
                '"/leg_controller/controller_state"'
            )
        for joint in own.joints:
            before = owner.setdefault((state, joint), leg)
            if before != leg or own.joints.count(joint) > 1:
                fail(
                    f"{where}: ros2.joints has '{joint}' of {state} twice (leg '{before}' has it, "
                    "too); each joint belongs to one leg"
                )
        order = own.command_joints or shared.command_joints
        lacking = [joint for joint in own.joints if order is not None and joint not in order]
        if lacking:
            fail(f"{where}: command_joints lacks {', '.join(lacking)} of ros2.joints")


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: Text
    period_s: Annotated[float, Meta(ge=1e-4, le=1.0)]
    quantum_rad: Step | None = None


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robot: _Head
    leg: Annotated[tuple[Leg, ...], Meta(min_length=1, max_length=MAX_LEGS)]
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
        raise ConfigurationError(f"{source}: {_explain(str(error), table)}") from error
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


def _explain(text: str, table: dict[str, Any]) -> str:
    """Turn msgspec's words into a person's: where, what is there, and what is expected."""
    text = text.replace("Object contains unknown field", "unknown key")
    text = text.replace("Object missing required field", "missing key")
    text = text.replace("$.", "").replace("`$`", "the top level")
    if "unknown key" in text:
        wrong, text = text.split("`")[1], text.replace("[...]", "")
        if wrong in _TABLES:  # TOML takes what stands below a table for a part of it
            return f"{text}; write it above the first [table], or as a table of its own"
        if wrong in _FIELDS:
            return f"{text}; it belongs to another table, see docs/robot.md"
        return f"{text}; {did_you_mean(wrong, _FIELDS, 'remove it')}"
    if "missing key" in text:
        name = text.split("`")[1]
        return f"{text}; {_EXAMPLES.get(name, 'docs/robot.md has an example')}"
    where = text.rsplit("`", 2)[-2]
    key = re.split(r"[.\[]", where.rstrip("0123456789[]"))[-1]
    values = _values(table, where)
    shown = where.replace("[...]", "")
    bound = re.search(r"(of length )?(>=?|<=?) (\S+) - at", text)
    if bound:
        found = " or ".join(str(len(x) if bound[1] else x) for x in values)
        of, hint = "has a length of" if bound[1] else "is", _HINTS.get(key, "")
        return f"{shown} {of} {found}; expected {_SIGNS[bound[2]]} {float(bound[3]):g}{hint}"
    expected = re.match(r"Expected `(.+)`(?: of length 3)?, got", text)
    kinds = [] if expected is None else expected[1].split(" | ")
    named = " or ".join(_KINDS.get(kind, kind) for kind in kinds if kind != "null")
    wanted = _CHOICES.get(key) or named or "one that docs/robot.md names"
    return f"{shown} is {' or '.join(map(reprlib.repr, values))}; expected {wanted}"


def _values(table: Any, where: str) -> list[Any]:
    """Return what stands at a path of msgspec's, in which ``[...]`` is any key."""
    found = [table]
    for part in re.findall(r"\.\.\.|[^.\[\]]+", where):
        if part == "...":
            found = [value for one in found for value in one.values()]
        else:
            key = int(part) if part.isdigit() else part
            found = [one[key] for one in found]
    return found


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
    "xyz_m": "3 numbers, m",
    "directions": "1 or -1",
    **dict.fromkeys(
        _TOPICS,
        "a topic such as /joint_states, with a leading slash, of letters, digits, '_' and '{leg}'",
    ),
    "node": "letters, digits and '_'",
    "protocol": '1 (AX, RX, MX), 2 (X-series, MX with that firmware), "sts" or "scs" (Feetech)',
    "distro": ", ".join(get_args(get_type_hints(Ros2)["distro"])),
}

_SIGNS: Final = {">=": "at least", ">": "more than", "<=": "at most"}
_HINTS: Final = {
    "period_s": " s (0.02 for 50 Hz)",
    "quantum_rad": " rad (AX-12A: 0.00511)",
    "leg": ": give each part of the robot a robot.toml, a service and a --namespace of its own",
    **dict.fromkeys(("lengths_m", "origins_m", "xyz_m"), " m, not mm"),
    **dict.fromkeys(("yaw_rad", "offsets_rad", "lower_rad", "upper_rad"), " rad, not degrees"),
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
