"""Asking a bus who is there, and writing a robot description down, with comments."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import msgspec

from adaptive_contact.bridge.bus import Bus, Pong
from adaptive_contact.bridge.handshake import scan, scan_again
from adaptive_contact.bridge.law import read_slope
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.tables import ServoModel, model_of_number
from adaptive_contact.errors import BusError
from adaptive_contact.robot import Leg, Port, Robot, ServoBus, ServoLaw

__all__ = ["Found", "describe", "find_servos", "group", "steepness", "write_robot"]

# Rates tried where none is given, those that servos are delivered with first.
USUAL_BAUDS: Final = (1_000_000, 57_600, 115_200, 2_000_000, 4_000_000)
# Servos are numbered one after the other: so far beyond the last heard, all are asked again.
_BEYOND: Final = 8


@dataclasses.dataclass(frozen=True)
class Found:
    """What answers on a port.

    Attributes:
        name: of the port.
        port: device, baud rate and protocol at which they answer.
        servos: model by id; None for a model number that is not known.
        numbers: model number by id.
        slopes_rad: how steep each servo's controller is, by id, where it tells.
    """

    name: str
    port: Port
    servos: dict[int, ServoModel | None]
    numbers: dict[int, int | None]
    slopes_rad: dict[int, float] = dataclasses.field(default_factory=dict)


def find_servos(name: str, device: str, bauds: Sequence[int] = USUAL_BAUDS) -> Found:
    """Ask a port at all usual rates, in both protocols, who is there; writes nothing.

    Raises:
        BusError: the port cannot be opened, or nobody answers.
    """
    for baud in bauds:
        for protocol in (1, 2):
            port = Port(device=device, baud=baud, protocol=1 if protocol == 1 else 2)
            bus = Bus(name, port)
            bus.open()
            try:
                pongs = scan(bus)
                if pongs:
                    last = min(max(pongs) + _BEYOND, MAX_ID)
                    return _found(bus, port, scan_again(bus, pongs, range(last + 1)))
            finally:
                bus.close()
    raise BusError(
        f"port {name}: no servo answers on {device} at {', '.join(map(str, bauds))} baud; check "
        "power and cable, or give the rate with --baud"
    )


def steepness(found: Iterable[Found]) -> dict[str, float]:
    """How steep servos are, by model: the median, rad."""
    by_model: dict[str, list[float]] = {}
    for one in found:
        for servo, slope in one.slopes_rad.items():
            model = one.servos[servo]
            assert model is not None
            by_model.setdefault(model.name, []).append(slope)
    return {name: round(statistics.median(slopes), 3) for name, slopes in by_model.items()}


def group(
    found: Sequence[Found],
    joints: int,
    legs: Sequence[str] = (),
    names: Sequence[str] = (),
) -> Robot:
    """Take servos in the order of their ids for legs, so many joints each.

    Args:
        found: what answers, port by port.
        joints: per leg.
        legs: ids; ``leg1`` and so on where left out.
        names: of the joints; the usual ones where left out.

    Raises:
        BusError: the servos do not make whole legs, or one is of no known model.
    """
    names = tuple(names) or _joint_names(joints)
    quantum = next((_quantum(m) for one in found for m in one.servos.values() if m), 0.0)
    made: list[Leg] = []
    for one in found:
        unknown = [f"{s} (model number {one.numbers[s]})" for s, m in one.servos.items() if not m]
        if unknown:
            raise BusError(
                f"port {one.name}: servo {', '.join(unknown)} is of no known model; see "
                "docs/bridge.md for those that are"
            )
        ids = sorted(one.servos)
        if len(ids) % joints:
            raise BusError(
                f"port {one.name}: {len(ids)} servos do not make legs of {joints} joints "
                f"(ids {', '.join(map(str, ids))}); give --joints, or find the one that is missing"
            )
        for first in range(0, len(ids), joints):
            part = ids[first : first + joints]
            models = {model.name: model for s in part if (model := one.servos[s]) is not None}
            if len(models) > 1:
                raise BusError(
                    f"port {one.name}: servos {', '.join(map(str, part))} would make a leg of "
                    f"different models ({', '.join(sorted(models))}); write robot.toml by hand"
                )
            [model] = models.values()
            name = legs[len(made)] if len(made) < len(legs) else f"leg{len(made) + 1}"
            servos = ServoBus(ids=tuple(part), model=model.name, port=one.name)
            own = None if _quantum(model) == quantum else _quantum(model)
            leg = Leg(id=name, joints=tuple(names), servos=servos, quantum_rad=own)
            made.append(msgspec.structs.replace(leg, axes=leg.joint_axes))
    if legs and len(legs) != len(made):
        raise BusError(
            f"{len(legs)} legs are named, but the servos make {len(made)}; correct --legs, --joints"
        )
    slopes = [slope for one in found for slope in one.slopes_rad.values()]
    return Robot(
        name="my-robot",
        period_s=0.02,
        quantum_rad=quantum,
        legs=tuple(made),
        servo=ServoLaw(round(statistics.median(slopes), 3)) if slopes else ServoLaw(),
        ports={one.name: one.port for one in found},
    )


def write_robot(robot: Robot, *, comments: bool = True) -> str:
    """A description as TOML text.

    Args:
        robot: what to write.
        comments: explain each line, and show what is still to be filled in.
    """
    say = _Commented(comments)
    say.line("[robot]")
    say.line(f"name = {_text(robot.name)}")
    say.line(f"period_s = {robot.period_s:g}", "control tick; 0.02 is 50 Hz")
    say.line(f"quantum_rad = {robot.quantum_rad:g}", "position step of the servos")
    say.line("")
    say.line("[servo]")
    say.line(
        f"slope_rad = {robot.servo.slope_rad:g}",
        "position error at which the servo drives with all it has",
    )
    for name, port in robot.ports.items():
        say.line("")
        # A bare name with a dot would be a table in a table.
        say.line(f"[port.{_text(name) if '.' in name else name}]")
        say.line(f"device = {_text(port.device)}")
        say.line(f"baud = {port.baud}")
        say.line(f"protocol = {port.protocol}", "1: AX and MX, 2: X-series")
        if port.fast:
            say.line("fast = true")
        if port.timeout_ms != Port(device="").timeout_ms:
            say.line(f"timeout_ms = {port.timeout_ms:g}")
    for i, leg in enumerate(robot.legs):
        _write_leg(say, leg, first=i == 0)
    return say.text


def describe(found: Iterable[Found]) -> list[str]:
    """What answers, one line per port."""
    lines = []
    for one in found:
        models: dict[str, list[int]] = {}
        for servo, model in sorted(one.servos.items()):
            name = model.name if model else f"unknown model {one.numbers[servo]}"
            models.setdefault(name, []).append(servo)
        told = "; ".join(f"{len(ids)} x {name}, ids {_ranges(ids)}" for name, ids in models.items())
        lines.append(
            f"port {one.name} ({one.port.device}): {told}; {one.port.baud} baud, protocol "
            f"{one.port.protocol}"
        )
    return lines


# -- private -----------------------------------------------------------------------------------


def _found(bus: Bus, port: Port, pongs: dict[int, Pong]) -> Found:
    doubled = [servo for servo, pong in pongs.items() if pong.doubled]
    if doubled:
        raise BusError(
            f"port {bus.name}: several servos answer to id {', '.join(map(str, doubled))} (or "
            "their line is disturbed); connect them one by one and give each an id of its own"
        )
    numbers = {servo: pong.model_number for servo, pong in pongs.items()}
    models = {s: None if n is None else model_of_number(n) for s, n in numbers.items()}
    slopes = {s: read_slope(bus, s, model) for s, model in models.items() if model is not None}
    told = {servo: slope for servo, slope in slopes.items() if slope is not None}
    return Found(bus.name, port, models, numbers, told)


class _Commented:
    def __init__(self, comments: bool) -> None:
        self._comments = comments
        self._lines: list[str] = []

    def line(self, text: str, comment: str | None = None) -> None:
        if comment is not None and self._comments:
            text = f"{text:<28} # {comment}"
        self._lines.append(text)

    def note(self, text: str) -> None:
        if self._comments:
            self._lines.append(f"# {text}")

    @property
    def text(self) -> str:
        return "\n".join(self._lines) + "\n"


def _write_leg(say: _Commented, leg: Leg, *, first: bool) -> None:
    say.line("")
    say.line("[[leg]]")
    say.line(f"id = {_text(leg.id)}")
    joints = ", ".join(_text(name) for name in leg.joints)
    say.line(f"joints = [{joints}]", "from the body outwards" if first else None)
    if leg.axes is not None:
        axes = ", ".join(
            _text(axis) if isinstance(axis, str) else _numbers(axis) for axis in leg.axes
        )
        what = "yaw turns left and right, pitch up" if leg.origins_m is None else "with all at 0"
        say.line(f"axes = [{axes}]", what if first else None)
    if leg.lengths_m is not None:
        say.line(f"lengths_m = {_numbers(leg.lengths_m)}")
    elif leg.origins_m is not None:
        origins = ", ".join(_numbers(origin) for origin in leg.origins_m)
        say.line(
            f"origins_m = [{origins}]", "from joint to joint, and to the foot" if first else None
        )
    else:
        if first:
            say.note("Measure the links, axis to axis and last axis to foot tip, and fill in, m:")
        say.note(f"lengths_m = {_numbers([0.1] * len(leg.joints))}")
    if leg.quantum_rad is not None:
        say.line(f"quantum_rad = {leg.quantum_rad:g}")
    mount = leg.mount
    if any(mount.xyz_m) or mount.yaw_rad:
        say.line(f"mount = {{ xyz_m = {_numbers(mount.xyz_m)}, yaw_rad = {mount.yaw_rad:g} }}")
    if leg.limits is not None:
        lower, upper = _numbers(leg.limits.lower_rad), _numbers(leg.limits.upper_rad)
        say.line(f"limits = {{ lower_rad = {lower}, upper_rad = {upper} }}")
    elif first:
        say.note("How far the bridge may ever drive the joints, rad:")
        most = len(leg.joints)
        say.note(f"limits = {{ lower_rad = {[-1.0] * most}, upper_rad = {[1.0] * most} }}")
    servos = leg.servos
    if servos is None:
        return
    say.line("[leg.servos]")
    say.line(f"ids = {list(servos.ids)}")
    say.line(f"model = {_text(servos.model)}")
    if servos.port is not None:
        say.line(f"port = {_text(servos.port)}")
    ones = [1] * len(leg.joints)
    directions = list(servos.directions) if servos.directions is not None else ones
    offsets = servos.offsets_rad if servos.offsets_rad is not None else [0.0] * len(leg.joints)
    say.line(f"directions = {directions}", "-1 where the angle grows the wrong way")
    say.line(f"offsets_rad = {_numbers(offsets)}", "joint angle with the horn in its centre")
    if servos.max_step_rad != ServoBus(ids=()).max_step_rad:
        say.line(f"max_step_rad = {servos.max_step_rad:g}")


def _quantum(model: ServoModel) -> float:
    return round(model.step_rad, 6)


def _joint_names(joints: int) -> tuple[str, ...]:
    usual: Mapping[int, tuple[str, ...]] = {
        2: ("hip", "knee"),
        3: ("coxa", "femur", "tibia"),
    }
    return usual.get(joints, tuple(f"joint{i + 1}" for i in range(joints)))


def _numbers(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{float(x):.6g}" if x % 1 else f"{float(x):.1f}" for x in values) + "]"


def _text(value: str) -> str:
    return msgspec.json.encode(value).decode()


def _ranges(ids: Sequence[int]) -> str:
    parts: list[list[int]] = []
    for i in ids:
        if parts and i == parts[-1][-1] + 1:
            parts[-1].append(i)
        else:
            parts.append([i])
    return ", ".join(f"{p[0]}" if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)
