"""Drifts as people write them: ``friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s``.

Kind, then settings, then when it begins (at once where left out; ``s``, ``ms`` or ``min``).
``leg`` and ``joint`` may be ``all``, which is also what leaving them out means.

Runs described in TOML files: where, how, how long, and what drifts.

The shipped scenarios' names and seeds are permanent: a figure published for one can be made again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec

from adaptive_contact.durations import DURATIONS, seconds_of
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import parse_toml, read_toml
from adaptive_contact.printable import did_you_mean
from adaptive_contact.wire import Drift
from adaptive_contact_sim.drift import KINDS, Injection, check
from adaptive_contact_sim.elements import HEXAPOD, Layout
from adaptive_contact_sim.gait import GAITS
from adaptive_contact_sim.limits import check_number
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import MotionSettings, SimulationSettings

_EXAMPLE: Final = "friction:leg=rf,joint=femur,value=4@20s"


def split_spec(text: str, where: str, example: str) -> tuple[dict[str, Any], str | None]:
    """Take ``KIND:KEY=VALUE,KEY=VALUE@WHEN`` apart.

    Args:
        text: as a person writes it.
        where: what to name in errors.
        example: shown in errors.

    Returns:
        Its kind and settings, texts all, by name; and when it begins, None where it is left out.

    Raises:
        ConfigurationError: what was found, and what is expected.
    """
    spec, at, when = text.partition("@")
    kind, _, rest = spec.partition(":")
    fields: dict[str, Any] = {"kind": kind.strip()}
    for item in rest.split(",") if rest.strip() else ():
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not value:
            raise ConfigurationError(
                f"{where}: '{item.strip()}' is not KEY=VALUE; expected such as {example}"
            )
        if key in fields:
            raise ConfigurationError(f"{where}: {key} is given twice; give it once")
        fields[key] = value
    return fields, when if at else None


def parse_drift(text: str, layout: Layout = HEXAPOD) -> Injection:
    """Read one drift from its short form.

    Returns:
        The drift and when it begins.

    Raises:
        ConfigurationError: in one line, what was found and what is expected.
    """
    where = f"drift '{text}'"
    fields, when = split_spec(text, where, _EXAMPLE)
    begins_s = 0.0 if when is None else seconds_of(when)
    if begins_s is None or begins_s < 0.0:
        raise ConfigurationError(
            f"{where}: begins at '{when}'; expected a time such as 20s, 500ms or 2min"
        )
    if "duration" in fields:
        fields["duration_s"] = seconds_of(fields.pop("duration"))
        if fields["duration_s"] is None:
            raise ConfigurationError(f"{where}: has no duration that can be read; give {DURATIONS}")
    return drift_from(fields, at_s=begins_s, where=where, layout=layout, strict=False)


def drift_from(
    fields: Mapping[str, Any],
    *,
    at_s: float | None = None,
    where: str,
    layout: Layout | None = HEXAPOD,
    strict: bool = True,
) -> Injection:
    """Make a drift from named fields, as a table of a scenario file has them.

    Args:
        fields: of :class:`adaptive_contact.wire.Drift`, and ``at_s`` unless it is given apart.
        at_s: when it begins.
        where: what to name in errors.
        layout: of the robot; None where only the simulator knows it.
        strict: numbers are numbers, no text of one.

    Raises:
        ConfigurationError: in one line, what was found and what is expected.
    """
    table = {name: value for name, value in fields.items() if value != "all"}
    start = table.pop("at_s", 0.0) if at_s is None else at_s
    _refuse_unknown(table, (*Drift.__struct_fields__, "at_s"), where)
    if isinstance(table.get("kind"), str):
        _refuse_unknown([table["kind"]], KINDS, where, "no drift")
    if "value" not in table:
        raise ConfigurationError(f"{where}: has no value; give a number (`sim list` has ranges)")
    try:
        drift = msgspec.convert({"v": 1, **table}, Drift, strict=strict)
        check(drift, layout)
        check_number("a drift's begin", msgspec.convert(start, float), 0.0, 1e6, "s")
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {error}; expected such as {_EXAMPLE}") from error
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    return Injection(drift, float(start))


def _refuse_unknown(
    given: Iterable[str], known: Iterable[str], where: str, what: str = "no setting"
) -> None:
    names = list(known)
    for name in given:
        if name not in names:
            hint = did_you_mean(name, names, f"expected {', '.join(names)}")
            raise ConfigurationError(f"{where}: {what} '{name}'; {hint}")


T = TypeVar("T")


class _File(msgspec.Struct):
    mode: str = ""
    about: str = ""
    robot: str = "hexapod"
    seconds: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    robot_seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    drift: list[dict[str, Any]] = []
    pose: dict[str, Any] = {}
    walk: dict[str, Any] = {}
    terrain: dict[str, Any] = {}
    encoder: dict[str, Any] = {}


@dataclass(frozen=True)
class Scenario:
    """A described run."""

    # name, about: what it is called, and one line on what it is for
    name: str
    about: str
    seconds: float | None  # how long it runs, None for until stopped
    settings: SimulationSettings  # what to simulate


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
        hint = did_you_mean(name, shipped, "`adaptive-contact sim list` shows them")
        raise ConfigurationError(f"no scenario '{name}' ships, and it is no .toml file; {hint}")
    table = read_toml(path, "give the path of a scenario file")
    return _scenario_of(table, path.stem, str(path))


def parse_scenario(text: str, *, name: str, source: str | None = None) -> Scenario:
    """Parse and check a scenario; ``source`` names it in errors.

    Raises:
        ConfigurationError: in one line, what is wrong and what is expected.
    """
    source = source or f"scenario {name}"
    return _scenario_of(parse_toml(text, source), name, source)


def _scenario_of(table: Mapping[str, Any], name: str, source: str) -> Scenario:
    _refuse_unknown(table, _File.__struct_fields__, source, "unknown setting")
    try:
        file = msgspec.convert(table, _File)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{source}: {error}") from error
    mode: Literal["pose", "walk"] = "pose" if file.mode == "pose" else "walk"
    if file.mode != mode:
        raise ConfigurationError(f'{source}: mode is {file.mode!r}; expected "pose" or "walk"')
    other = "walk" if mode == "pose" else "pose"
    if other in table or (mode == "pose" and "terrain" in table):
        found = other if other in table else "terrain"
        raise ConfigurationError(
            f"{source}: has a table [{found}], but mode is {mode!r}; remove one"
        )
    own = file.pose if mode == "pose" else file.walk
    # A gait that is none is reported by what reads it.
    gait = next((known for known in GAITS if known == own.get("gait")), None)
    try:
        base = SimulationSettings.from_robot(file.robot, mode, gait)
    except ConfigurationError as error:
        raise ConfigurationError(f"{source}: {error}") from error
    motion: MotionSettings = _settings(own, base.motion, f"{source}: [{mode}]")
    layout = simulated_robot(file.robot).layout
    settings = replace(
        base,
        motion=motion,
        seed=file.seed,
        robot_seed=file.robot_seed,
        terrain=_settings(file.terrain, base.terrain, f"{source}: [terrain]"),
        encoder=_settings(file.encoder, base.encoder, f"{source}: [encoder]"),
        drift=tuple(
            drift_from(d, where=f"{source}: [[drift]] {i}", layout=layout)
            for i, d in enumerate(file.drift, start=1)
        ),
    )
    return Scenario(name, file.about, file.seconds, settings)


def _settings(table: Mapping[str, Any], base: T, where: str) -> T:
    """Change settings by their table, its own checks included."""
    kind = type(base)
    known = msgspec.inspect.type_info(kind)
    assert isinstance(known, msgspec.inspect.DataclassType)
    _refuse_unknown(table, [entry.name for entry in known.fields], where, "unknown setting")
    try:
        given = msgspec.convert(table, kind, strict=True)
        return replace(base, **{name: getattr(given, name) for name in table})  # type: ignore[type-var]
    except (msgspec.ValidationError, ConfigurationError) as error:
        raise ConfigurationError(f"{where}: {error}") from error
