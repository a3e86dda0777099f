"""The robot described in one TOML file.

Only ``name``, ``period_s``, ``quantum_rad`` and the legs' ids and joints are needed; all else is
optional.  A description is frozen and checked once, on load.
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Final, Literal, get_args

import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import is_leg_id

__all__ = [
    "DetectorSettings",
    "Leg",
    "Limits",
    "Mount",
    "Robot",
    "ServoBus",
    "ServoLaw",
    "load_robot",
    "shipped_robot",
]

Axis = Literal["yaw", "pitch"]

# One robot-hour is 540,000 judged swing leg-ticks: six legs at 50 Hz, half of the time in swing.
ROBOT_HOUR_TICKS: Final = 540_000


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a leg sits on the body: position in metres, yaw of its zero direction in rad."""

    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """(J,) rad joint limits."""

    lower_rad: tuple[float, ...]
    upper_rad: tuple[float, ...]


class ServoBus(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A leg's servos on their bus.

    A joint's angle is ``direction * (position - centre) + offset``, the servo's position and
    centre being those of its horn.

    Attributes:
        ids: (J,) on the bus.
        model: of all of them, or their family, such as ``XL-330``.
        directions: (J,) 1 or -1.
        offsets_rad: (J,) angle of the joint with the horn in its centre.
        port: name of a ``[port.NAME]``; may be left out where there is one.
        max_step_rad: how far the bridge lets a goal move in one control tick.
    """

    ids: tuple[int, ...]
    model: str = "AX-12A"
    directions: tuple[int, ...] | None = None
    offsets_rad: tuple[float, ...] | None = None
    port: str | None = None
    max_step_rad: float = 0.15


class ServoLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The servo's control law as far as the robot's owner can read it off the registers.

    Attributes:
        slope_rad: position error at which the drive saturates (AX-12A: compliance slope 32 of
            1023 steps over 300 degrees, 0.164 rad).  The library offers its neighbours too, so
            a rough value is enough.
    """

    slope_rad: float = 0.164


class DetectorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the owner asks of the detector.

    Attributes:
        false_alarms_per_hour: aim per robot-hour (540,000 swing leg-ticks).
    """

    false_alarms_per_hour: float = 1.0


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One leg: its joints from the body outwards, and what is known of them."""

    id: str
    joints: tuple[str, ...]
    lengths_m: tuple[float, ...] | None = None
    axes: tuple[Axis, ...] | None = None
    quantum_rad: float | None = None
    mount: Mount = Mount()
    limits: Limits | None = None
    servos: ServoBus | None = None

    @property
    def joint_axes(self) -> tuple[Axis, ...]:
        """The axis of every joint; without ``axes``: a yaw first where there are 3 or more."""
        if self.axes is not None:
            return self.axes
        first: Axis = "yaw" if len(self.joints) >= 3 else "pitch"
        pitch: Axis = "pitch"
        return (first, *(pitch for _ in self.joints[1:]))


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    period_s: float
    quantum_rad: float


class Port(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A serial port of the bridge.

    Attributes:
        device: such as ``/dev/ttyUSB0``.
        baud: bits per second.
        protocol: Dynamixel protocol, 1 (AX, MX) or 2 (X-series).
        fast: read with fast sync read (X-series, firmware 45 or newer).
        timeout_ms: how long an answer may take beyond its bytes.
    """

    device: str
    baud: int = 1_000_000
    protocol: Literal[1, 2] = 1
    fast: bool = False
    timeout_ms: float = 5.0


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    robot: _Head
    leg: tuple[Leg, ...]
    servo: ServoLaw = ServoLaw()
    detector: DetectorSettings = DetectorSettings()
    port: dict[str, Port] = {}


class Robot(msgspec.Struct, frozen=True):
    """A checked robot description."""

    name: str
    period_s: float
    quantum_rad: float
    legs: tuple[Leg, ...]
    servo: ServoLaw = ServoLaw()
    detector: DetectorSettings = DetectorSettings()
    ports: dict[str, Port] = {}

    @property
    def leg_ids(self) -> tuple[str, ...]:
        """Ids in the file's order."""
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
        """Position step of a leg's servos, rad."""
        own = self.leg(leg_id).quantum_rad
        return self.quantum_rad if own is None else own


def load_robot(path: str | Path) -> Robot:
    """Load and check a robot description.

    Args:
        path: a ``robot.toml``.

    Returns:
        The robot.

    Raises:
        ConfigurationError: in one line, what is wrong in the file and what is expected there.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror}); give the path of a robot.toml"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: is not UTF-8 text; expected a robot.toml") from error
    return parse_robot(text, source=str(path))


def shipped_robot(name: str = "hexapod") -> Robot:
    """Load a robot that ships in ``adaptive_contact_models``.

    Raises:
        ConfigurationError: no robot of that name ships.
    """
    models = resources.files("adaptive_contact_models")
    file = models.joinpath(name, "robot.toml")
    if not file.is_file():
        ships = [entry.name for entry in models.iterdir() if _ships(entry)]
        raise ConfigurationError(
            f"no robot '{name}' ships with adaptive-contact; there are {', '.join(sorted(ships))}, "
            "others are described in a robot.toml"
        )
    return parse_robot(file.read_text(encoding="utf-8"), source=f"{name}/robot.toml")


def _ships(folder: Traversable) -> bool:
    return folder.joinpath("robot.toml").is_file()


def parse_robot(text: str, *, source: str) -> Robot:
    """Parse and check the text of a robot description; ``source`` names it in errors.

    Raises:
        ConfigurationError: see :func:`load_robot`.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source}: not valid TOML: {error}") from error
    try:
        file = msgspec.convert(table, _File, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{source}: {_explain(str(error))}") from error
    robot = Robot(
        name=file.robot.name,
        period_s=file.robot.period_s,
        quantum_rad=file.robot.quantum_rad,
        legs=file.leg,
        servo=file.servo,
        detector=file.detector,
        ports=file.port,
    )
    _check(robot, source)
    return robot


_FIELDS: Final = sorted(
    {
        *("robot", "leg", "servo", "detector", "port"),
        *(name for kind in (_Head, Leg, Mount, Limits, ServoBus, ServoLaw, DetectorSettings, Port)
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
        near = difflib.get_close_matches(wrong, [name for name in _FIELDS if name != wrong], n=1)
        hint = f"did you mean `{near[0]}`?" if near else "remove it"
        return f"{text}; {hint}"
    if "missing key" in text:
        name = text.split("`")[1]
        return f"{text}; {_EXAMPLES.get(name, 'docs/robot.md has an example')}"
    if "Invalid enum value" in text and ".axes" in text:
        return f"{text}; expected {', '.join(get_args(Axis))}"
    wrong_type = re.fullmatch(r"Expected `(\S+)`, got `(\S+)` - at `(.+)`", text)
    if wrong_type:
        expected, got, where = wrong_type.groups()
        return f"{where} is {_KINDS.get(got, got)}; expected {_KINDS.get(expected, expected)}"
    return text


_TABLES: Final = ("robot", "leg", "servo", "detector", "port")
_EXAMPLES: Final = {
    "robot": "begin with [robot], its name and period_s",
    "leg": "describe each with [[leg]], id and joints",
    "id": 'such as id = "rf"',
    "joints": 'such as joints = ["coxa", "femur", "tibia"]',
    "name": 'such as name = "mybot"',
    "period_s": "such as period_s = 0.02",
    "quantum_rad": "such as quantum_rad = 0.00511",
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


def _check(robot: Robot, source: str) -> None:
    def fail(what: str) -> None:
        raise ConfigurationError(f"{source}: {what}")

    if not robot.name:
        fail("[robot] name is empty; give the robot a name")
    if not 1e-4 <= robot.period_s <= 1.0:
        fail(f"[robot] period_s is {robot.period_s}; expected 0.0001 to 1 s (0.02 for 50 Hz)")
    if not robot.legs:
        fail("no [[leg]]; describe at least one")
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


def _check_ports(robot: Robot, fail: object) -> None:
    assert callable(fail)
    for name, port in robot.ports.items():
        if not is_leg_id(name):
            fail(f"[port.{name}]: a name is 1 to 32 letters, digits, '_', '.' or '-'")
        if port.fast and port.protocol == 1:
            fail(f"[port.{name}] fast is for protocol 2; remove it, or set protocol = 2")
        if not 0.5 <= port.timeout_ms <= 100.0:
            fail(f"[port.{name}] timeout_ms is {port.timeout_ms}; expected 0.5 to 100 (usual: 5)")
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
            if not 0 <= servo <= 252:
                fail(f"{where}: servo id {servo}; ids are 0 to 252")
            before = owner.setdefault((servos.port, servo), leg.id)
            if before != leg.id or servos.ids.count(servo) > 1:
                fail(
                    f"{where}: servo id {servo} is used twice on a port (by leg '{before}'); give "
                    "every servo an id of its own"
                )


def _check_leg(robot: Robot, leg: Leg, where: str, fail: object) -> None:
    assert callable(fail)
    joints = len(leg.joints)
    quantum = robot.quantum(leg.id)
    if joints == 0:
        fail(f"{where}: joints is empty; name at least one")
    if len(set(leg.joints)) != joints:
        fail(f"{where}: joints {list(leg.joints)} repeat a name; names must differ")
    if not 1e-6 <= quantum <= 0.2:
        fail(f"{where}: quantum_rad is {quantum}; expected 1e-6 to 0.2 rad (AX-12A: 0.00511)")
    sized: list[tuple[str, tuple[object, ...] | None]] = [
        ("lengths_m", leg.lengths_m),
        ("axes", leg.axes),
        ("limits.lower_rad", leg.limits.lower_rad if leg.limits else None),
        ("limits.upper_rad", leg.limits.upper_rad if leg.limits else None),
        ("servos.ids", leg.servos.ids if leg.servos else None),
        ("servos.directions", leg.servos.directions if leg.servos else None),
        ("servos.offsets_rad", leg.servos.offsets_rad if leg.servos else None),
    ]
    for name, values in sized:
        if values is not None and len(values) != joints:
            fail(f"{where}: {name} has {len(values)} values for {joints} joints")
    if leg.lengths_m is not None and not all(0 < x <= 5 for x in leg.lengths_m):
        fail(f"{where}: lengths_m is {list(leg.lengths_m)}; expected metres above 0, up to 5")
    if leg.limits is not None:
        for low, high in zip(leg.limits.lower_rad, leg.limits.upper_rad, strict=True):
            if not -2 * math.pi <= low < high <= 2 * math.pi:
                fail(
                    f"{where}: limits {low} .. {high} rad; expected lower below upper, within 2 pi"
                )
    directions = None if leg.servos is None else leg.servos.directions
    if directions is not None and any(d not in (-1, 1) for d in directions):
        fail(f"{where}: servos.directions are {list(directions)}; use 1 or -1")
