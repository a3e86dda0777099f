"""Runs described in TOML files: where, how, how long, and what drifts.

The shipped scenarios' names and seeds are permanent: a figure published for one can be made again.
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.drift_spec import drift_from
from adaptive_contact_sim.gait import GAITS
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import MotionSettings, SimulationSettings

__all__ = ["Scenario", "load_scenario", "parse_scenario", "shipped_scenarios"]

T = TypeVar("T")

_TABLES = ("pose", "walk", "terrain", "encoder")
_TOP = ("about", "mode", "robot", "seconds", "seed", "robot_seed", "drift", *_TABLES)


@dataclass(frozen=True)
class Scenario:
    """A described run.

    Attributes:
        name, about: what it is called, and one line on what it is for.
        seconds: how long it runs, None for until stopped.
        settings: what to simulate.
    """

    name: str
    about: str
    seconds: float | None
    settings: SimulationSettings


def shipped_scenarios() -> dict[str, Scenario]:
    """All scenarios that ship with the simulator, by name."""
    folder = resources.files("adaptive_contact_sim").joinpath("scenarios")
    found = {}
    for file in sorted(folder.iterdir(), key=lambda f: f.name):
        if file.name.endswith(".toml"):
            name = file.name.removesuffix(".toml")
            found[name] = parse_scenario(file.read_text(encoding="utf-8"), name=name)
    return found


def load_scenario(name: str) -> Scenario:
    """Load a scenario: a shipped one's name, or the path of a file.

    Raises:
        ConfigurationError: in one line, what is wrong and what is expected.
    """
    path = Path(name)
    if path.suffix != ".toml":
        shipped = shipped_scenarios()
        if name in shipped:
            return shipped[name]
        near = difflib.get_close_matches(name, shipped, n=1)
        hint = f"did you mean '{near[0]}'?" if near else "`adaptive-contact sim list` shows them"
        raise ConfigurationError(f"no scenario '{name}' ships, and it is no .toml file; {hint}")
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror}); give the path of a scenario file"
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: is not UTF-8 text; expected a scenario file") from error
    return parse_scenario(text, name=path.stem, source=str(path))


def parse_scenario(text: str, *, name: str, source: str | None = None) -> Scenario:
    """Parse and check a scenario; ``source`` names it in errors.

    Raises:
        ConfigurationError: in one line, what is wrong and what is expected.
    """
    source = source or f"scenario {name}"
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source}: not valid TOML: {error}") from error
    _only(table, _TOP, source)
    mode = table.get("mode")
    if mode not in ("pose", "walk"):
        raise ConfigurationError(f'{source}: mode is {mode!r}; expected "pose" or "walk"')
    other = "walk" if mode == "pose" else "pose"
    if other in table or (mode == "pose" and "terrain" in table):
        found = other if other in table else "terrain"
        raise ConfigurationError(
            f"{source}: has a table [{found}], but mode is {mode!r}; remove one"
        )
    where, own = f"{source}: [{mode}]", table.get(mode, {})
    robot = table.get("robot", "hexapod")
    if not isinstance(robot, str):
        raise ConfigurationError(f"{source}: robot is {robot!r}; expected a name")
    try:
        # A gait that is none is told by what reads the table.
        gait = own.get("gait") if isinstance(own, dict) else None
        base = SimulationSettings.of(
            robot, "pose" if mode == "pose" else "walk", gait if gait in GAITS else None
        )
    except ConfigurationError as error:
        raise ConfigurationError(f"{source}: {error}") from error
    motion: MotionSettings = _settings(own, base.motion, where)
    seconds = table.get("seconds")
    if seconds is not None and not (_is_number(seconds) and 0 < seconds <= 1e6):
        raise ConfigurationError(f"{source}: seconds is {seconds!r}; expected 0 to 1000000 s")
    drift = table.get("drift", [])
    if not isinstance(drift, list) or not all(isinstance(d, dict) for d in drift):
        raise ConfigurationError(f"{source}: drift is not a list of tables; write [[drift]]")
    layout = simulated_robot(robot).layout
    settings = replace(
        base,
        motion=motion,
        seed=_whole(table, "seed", source),
        robot_seed=_whole(table, "robot_seed", source),
        terrain=_settings(table.get("terrain", {}), base.terrain, f"{source}: [terrain]"),
        encoder=_settings(table.get("encoder", {}), base.encoder, f"{source}: [encoder]"),
        drift=tuple(
            drift_from(d, where=f"{source}: [[drift]] {i}", layout=layout)
            for i, d in enumerate(drift, start=1)
        ),
    )
    about = table.get("about", "")
    return Scenario(
        name=name,
        about=about if isinstance(about, str) else "",
        seconds=None if seconds is None else float(seconds),
        settings=settings,
    )


def _settings(table: Any, base: T, where: str) -> T:
    """Change settings by their table, its own checks included."""
    kind = type(base)
    if not isinstance(table, dict):
        raise ConfigurationError(f"{where} is not a table; write its settings below {where[-20:]}")
    known = msgspec.inspect.type_info(kind)
    assert isinstance(known, msgspec.inspect.DataclassType)
    _only(table, [entry.name for entry in known.fields], where)
    try:
        given = msgspec.convert(table, kind, strict=True)
        return replace(base, **{name: getattr(given, name) for name in table})  # type: ignore[type-var]
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error


def _only(table: Mapping[str, Any], known: Any, where: str) -> None:
    names = list(known)
    for name in table:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"expected {', '.join(names)}"
            raise ConfigurationError(f"{where}: unknown setting '{name}'; {hint}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _whole(table: Mapping[str, Any], name: str, source: str) -> int:
    value = table.get(name, 0)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ConfigurationError(
            f"{source}: {name} is {value!r}; expected a whole number, 0 or more"
        )
    return value
