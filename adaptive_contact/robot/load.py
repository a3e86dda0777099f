"""Robots read from TOML, with errors that say what is wrong where and what is expected there.

Only ``name``, ``period_s``, ``quantum_rad`` and the legs' ids and joints are needed; all else is
optional.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Final, get_args

import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot.checks import check
from adaptive_contact.robot.description import (
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

__all__ = ["is_shipped", "load_robot", "parse_robot", "recorded_as", "shipped_robot"]


class _Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    period_s: float
    quantum_rad: float


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

    Returns:
        The robot.

    Raises:
        ConfigurationError: in one line, what is wrong in the file and what is expected there.
    """
    path = Path(path)
    if is_shipped(path):
        return shipped_robot(path.name)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror}); give the path of a robot.toml, or a "
            f"shipped robot's name ({', '.join(_shipped_names())})"
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
        raise ConfigurationError(
            f"no robot '{name}' ships with adaptive-contact; there are "
            f"{', '.join(_shipped_names())}, others are described in a robot.toml"
        )
    return parse_robot(file.read_text(encoding="utf-8"), source=f"{name}/robot.toml")


def is_shipped(path: str | Path) -> bool:
    """Tell the name of a robot that ships from the path of a file."""
    path = Path(path)
    return str(path) in _shipped_names() and not path.is_file()


def recorded_as(name: str) -> Robot | None:
    """Load the shipped robot of this name, its folder's or its own; None if there is none."""
    robots = {folder: shipped_robot(folder) for folder in _shipped_names()}
    return next((one for at, one in robots.items() if name in (at, one.name)), None)


def _shipped_names() -> list[str]:
    models = resources.files("adaptive_contact_models")
    return sorted(entry.name for entry in models.iterdir() if _ships(entry))


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
    except RecursionError as error:
        raise ConfigurationError(
            f"{source}: nested too deeply; expected the tables of a robot.toml"
        ) from error
    try:
        file = msgspec.convert(table, _File, strict=True)
    except RecursionError as error:
        raise ConfigurationError(
            f"{source}: nested too deeply; expected the tables of a robot.toml"
        ) from error
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
        ros2=file.ros2,
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
        near = difflib.get_close_matches(wrong, [name for name in _FIELDS if name != wrong], n=1)
        hint = f"did you mean `{near[0]}`?" if near else "remove it"
        return f"{text}; {hint}"
    if "missing key" in text:
        name = text.split("`")[1]
        return f"{text}; {_EXAMPLES.get(name, 'docs/robot.md has an example')}"
    if "Invalid enum value" in text and ".axes" in text:
        return f"{text}; expected {', '.join(get_args(AxisWord))}, or a direction such as [0, 1, 0]"
    wrong_type = re.fullmatch(r"Expected `(\S+)`, got `(\S+)` - at `(.+)`", text)
    if wrong_type:
        expected, got, where = wrong_type.groups()
        return f"{where} is {_KINDS.get(got, got)}; expected {_KINDS.get(expected, expected)}"
    return text


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
