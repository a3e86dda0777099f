"""Asking a bus who is there, and taking its servos for legs."""

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
from adaptive_contact.robot.write import write_robot

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


def _quantum(model: ServoModel) -> float:
    return round(model.step_rad, 6)


def _joint_names(joints: int) -> tuple[str, ...]:
    usual: Mapping[int, tuple[str, ...]] = {
        2: ("hip", "knee"),
        3: ("coxa", "femur", "tibia"),
    }
    return usual.get(joints, tuple(f"joint{i + 1}" for i in range(joints)))


def _ranges(ids: Sequence[int]) -> str:
    parts: list[list[int]] = []
    for i in ids:
        if parts and i == parts[-1][-1] + 1:
            parts[-1].append(i)
        else:
            parts.append([i])
    return ", ".join(f"{p[0]}" if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)
