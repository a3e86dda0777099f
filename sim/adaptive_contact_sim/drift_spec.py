"""Drifts as people write them: ``friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s``.

Kind, then settings, then when it begins (at once where left out; ``s``, ``ms`` or ``min``).
``leg`` and ``joint`` may be ``all``, which is also what leaving them out means.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from adaptive_contact.durations import DURATIONS, seconds_of
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift
from adaptive_contact_sim.drift import KINDS, Injection, check
from adaptive_contact_sim.elements import HEXAPOD, Layout

__all__ = ["drift_from", "parse_drift"]

_EXAMPLE: Final = "friction:leg=rf,joint=femur,value=4@20s"
_KEYS: Final = {
    "leg": str,
    "joint": str,
    "value": float,
    "shape": str,
    "duration": float,
    "seed": int,
}


def parse_drift(text: str, layout: Layout = HEXAPOD) -> Injection:
    """Read one drift from its short form.

    Args:
        text: ``KIND:KEY=VALUE,...@TIME``.
        layout: of the robot.

    Returns:
        The drift and when it begins.

    Raises:
        ConfigurationError: in one line, what was found and what is expected.
    """
    spec, at, when = text.partition("@")
    kind, colon, rest = spec.partition(":")
    kind = kind.strip()
    _known(kind, KINDS, "drift", f"drift '{text}'")
    fields: dict[str, Any] = {"kind": kind}
    for item in rest.split(",") if colon else []:
        key, equals, value = (part.strip() for part in item.partition("="))
        if not equals or not value:
            raise ConfigurationError(
                f"drift '{text}': '{item.strip()}' is not KEY=VALUE; expected such as {_EXAMPLE}"
            )
        _known(key, _KEYS, "setting", f"drift '{text}'")
        if key in fields:
            raise ConfigurationError(f"drift '{text}': {key} is given twice; give it once")
        fields[key] = _number(key, value, text) if _KEYS[key] is not str else value
    if "duration" in fields:
        fields["duration_s"] = fields.pop("duration")
    begins_s = _time(when, text) if at else 0.0
    return drift_from(fields, at_s=begins_s, where=f"drift '{text}'", layout=layout)


def drift_from(
    fields: Mapping[str, Any],
    *,
    at_s: float | None = None,
    where: str,
    layout: Layout | None = HEXAPOD,
) -> Injection:
    """Make a drift from named fields, as a table of a scenario file has them.

    Args:
        fields: of :class:`adaptive_contact.wire.Drift`, and ``at_s`` unless it is given apart.
        at_s: when it begins.
        where: what to name in errors.
        layout: of the robot; None where only the simulator knows it.

    Raises:
        ConfigurationError: in one line, what was found and what is expected.
    """
    table = {name: value for name, value in fields.items() if value != "all"}
    start = table.pop("at_s", 0.0) if at_s is None else at_s
    _refuse_unknown(table, (*Drift.__struct_fields__, "at_s"), where)
    if isinstance(table.get("kind"), str):
        _known(table["kind"], KINDS, "drift", where)
    if "value" not in table:
        kind = next((k for name, k in KINDS.items() if name == table.get("kind")), None)
        unit = "" if kind is None else f" ({kind.unit}, {kind.low:g} to {kind.high:g})"
        raise ConfigurationError(f"{where}: has no value; give a number{unit}")
    if isinstance(start, bool) or not isinstance(start, int | float) or not math.isfinite(start):
        raise ConfigurationError(f"{where}: begins at {start!r}; expected seconds, 0 or later")
    try:
        drift = msgspec.convert({"v": 1, **table}, Drift, strict=True)
        check(drift, layout)
    except msgspec.ValidationError as error:
        raise ConfigurationError(f"{where}: {error}; expected such as {_EXAMPLE}") from error
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    return Injection(drift, float(start))


def _known(name: str, known: Iterable[str], what: str, where: str) -> None:
    names = list(known)
    if name in names:
        return
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'?" if near else f"expected one of {', '.join(names)}"
    raise ConfigurationError(f"{where}: no {what} '{name}'; {hint}")


def _refuse_unknown(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    names = list(known)
    for name in table:
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"expected {', '.join(names)}"
            raise ConfigurationError(f"{where}: no setting '{name}'; {hint}")


def _number(key: str, value: str, text: str) -> float | int:
    number: float | int | None
    if key == "duration":
        number = seconds_of(value)
        if number is None:
            raise ConfigurationError(f"drift '{text}': duration is '{value}'; expected {DURATIONS}")
        return number
    whole = _KEYS[key] is int
    try:
        number = int(value) if whole else float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        expected = "a whole number" if whole else "a number"
        raise ConfigurationError(f"drift '{text}': {key} is '{value}'; expected {expected}")
    return number


def _time(when: str, text: str) -> float:
    seconds = seconds_of(when)
    if seconds is None or seconds < 0.0:
        raise ConfigurationError(
            f"drift '{text}': begins at '{when}'; expected a time such as 20s, 500ms or 2min"
        )
    return seconds
