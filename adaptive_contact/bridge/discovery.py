"""Asks a bus which servos answer, and makes a robot description of them."""

from __future__ import annotations

import dataclasses
import functools
import statistics
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from typing import NamedTuple

import msgspec

from adaptive_contact.bridge import handshake
from adaptive_contact.bridge.bus import Bus, Pong
from adaptive_contact.bridge.handshake import (
    BUSY,
    USUAL_BAUDS,
    Place,
    astray_text,
    doubled_text,
    find_all,
    find_elsewhere,
    named,
)
from adaptive_contact.bridge.modes import followed, read_slope
from adaptive_contact.bridge.packets import MAX_ID
from adaptive_contact.bridge.tables import ServoModel, model_of_number
from adaptive_contact.errors import BusError, ConfigurationError
from adaptive_contact.robot import Leg, Port, Robot, ServoBus, ServoLaw
from adaptive_contact.robot.description import Protocol


@dataclasses.dataclass(frozen=True)
class Found:
    """Describes what answers on a port."""

    name: str  # of the port
    port: Port  # device, baud rate and protocol at which they answer
    pongs: dict[int, Pong]  # by id
    # how steep each servo's controller is, by id, where it reports that
    slopes_rad: dict[int, float]
    follows: dict[int, int]  # by secondary id: whom
    done: tuple[str, ...] = ()  # what was written
    # ids that answer at another baud rate and protocol, by these
    elsewhere: dict[Place, list[int]] = dataclasses.field(default_factory=dict)

    @property
    def known(self) -> int:
        """Count the servos of known models."""
        return sum(model is not None for model in self.servos.values())

    @functools.cached_property
    def servos(self) -> dict[int, ServoModel | None]:
        """Return the models by id; None for one without a control table here."""
        of = self.port.protocol
        return {s: model_of_number(pong.model_number, of) for s, pong in self.pongs.items()}

    def words(self, servo: int) -> str:
        """Describe a servo."""
        return named(self.pongs[servo], self.port.protocol)


class Wanted(NamedTuple):
    """Names the servos of one leg, from the body outwards, and their port if it was given."""

    port: str | None
    ids: tuple[int, ...]


def wanted_legs(text: str) -> tuple[Wanted, ...]:
    """Parse ``--ids``: ``2,4,6/8,10,12``, with a port's name where there are several.

    Raises:
        ConfigurationError: it cannot be read.
    """
    legs: list[Wanted] = []
    for leg in text.split("/"):
        port, colon, rest = leg.rpartition(":")
        words = [word.strip() for word in rest.split(",")]
        if not all(word.isascii() and word.isdigit() for word in words):
            raise ConfigurationError(
                f"--ids {text}: '{leg}' is no list of ids; give each leg's ids from the body "
                "outwards, and '/' between legs, such as 2,4,6/8,10,12 (with several ports "
                "left:2,4,6/right:2,4,6)"
            )
        legs.append(Wanted(port.strip() if colon else None, tuple(map(int, words))))
    return tuple(legs)


def find_servos(
    name: str,
    device: str,
    bauds: Sequence[int] = USUAL_BAUDS,
    *,
    ids: Sequence[int] = (),
    configure: bool = False,
) -> Found:
    """Ask a port at all usual rates, in both protocols, who is there.

    Feetech servos answer in protocol 1, too: servos of no known model are asked in theirs.

    Writes nothing, but with ``configure`` the status return level of servos that answer no reads.

    Args:
        name: of the port.
        device: its path.
        bauds: rates to try.
        ids: of servos that ought to be there; those that are not are looked for at other rates.
            Without, ids that are missing in the row are.
        configure: let servos answer reads.

    Raises:
        BusError: the port cannot be opened, no servo answers, or one answers too late only.
    """
    feetech_only = find_spec("scservo_sdk") and not find_spec("dynamixel_sdk")
    # Feetech's answer the pings of protocol 1, and say what they are; protocol 1's answer theirs.
    protocols: tuple[Protocol, ...] = ("sts",) if feetech_only else (1, 2)
    places: list[Place] = [(baud, protocol) for baud in bauds for protocol in protocols]
    found = next(
        (one for place in places if (one := _probe_port(name, device, place, ids, configure))), None
    )
    if found is None:
        raise BusError(
            f"port {name}: no servo answers on {device} at {', '.join(map(str, bauds))} baud; "
            "check power and cable, or give the rate with --baud"
        )
    rivals: list[Place] = []
    if found.port.protocol in (1, "sts") and found.known < len(found.pongs):
        rivals += [(found.port.baud, "sts"), (found.port.baud, "scs")]
    # The one that was found first may be the odd one.
    rivals += [
        at for at, there in found.elsewhere.items() if at[0] in bauds and len(there) > found.known
    ]
    for place in rivals:
        other = _probe_port(name, device, place, ids, configure)
        if other is not None and other.known > found.known:
            found = other
    return found


def _probe_port(
    name: str, device: str, place: Place, ids: Sequence[int], configure: bool
) -> Found | None:
    """Find the servos of a port at one baud rate and protocol; None where none answers."""
    port = Port(device=device, baud=place[0], protocol=place[1])
    bus = Bus(name, port)
    bus.open()
    try:
        wanted = () if not configure else ids or None
        pongs, done = find_all(bus, handshake.ALL_IDS, configure=wanted)
        if not pongs and not bus.late:
            return None
        row = range(min(max({*pongs, *bus.late}) + handshake.BEYOND, MAX_ID) + 1)
        late = sorted(servo for servo in bus.late if servo not in pongs and servo in (ids or row))
        if late:  # a description without them would be of another robot
            raise BusError(f"port {name}: answers of servo {_ranges(late)} come too late: {BUSY}")
        doubled = [servo for servo, pong in pongs.items() if pong.doubled]
        if doubled:
            raise BusError(f"port {name}: {doubled_text(doubled)}")
        slopes, follows = {}, {}
        for servo, pong in pongs.items():
            model = model_of_number(pong.model_number, port.protocol)
            if model is None or not pong.reads:
                continue
            if (slope := read_slope(bus, servo, model)) is not None:
                slopes[servo] = slope
            if (first := followed(bus, servo, model)) is not None:
                follows[servo] = first
    finally:
        bus.close()
    missing = [servo for servo in ids or row[1:] if servo not in pongs]
    elsewhere = find_elsewhere(name, port, missing)
    return Found(name, port, pongs, slopes, follows, tuple(done), elsewhere)


def group(
    found: Sequence[Found],
    joints: int,
    legs: Sequence[str] = (),
    names: Sequence[str] = (),
    wanted: Sequence[Wanted] = (),
) -> Robot:
    """Take servos in the order of their ids for legs, so many joints each.

    Args:
        found: what answers, port by port.
        joints: per leg.
        legs: ids; ``leg1`` and so on where left out.
        names: of the joints; the usual ones where left out.
        wanted: which servos make a leg; the others are ignored.

    Raises:
        BusError: the servos do not make whole legs, or one is of no known model.
    """
    parts = _chosen(found, wanted) if wanted else _dealt(found, joints)
    if legs and len(legs) != len(parts):
        raise BusError(
            f"{len(legs)} legs are named, but the servos make {len(parts)}; correct --legs, "
            f"{'--ids' if wanted else '--joints'}"
        )
    models = [_models(one, part) for one, part in parts]
    quantum = _quantum(models[0])
    made: list[Leg] = []
    used: dict[str, set[int]] = {}
    for (one, part), own_models in zip(parts, models, strict=True):
        name = legs[len(made)] if legs else f"leg{len(made) + 1}"
        alike = len({model.name for model in own_models}) == 1
        servos = ServoBus(
            ids=part,
            model=own_models[0].name if alike else tuple(model.name for model in own_models),
            port=one.name,
        )
        own = None if _quantum(own_models) == quantum else _quantum(own_models)
        own_names = tuple(names) or _joint_names(len(part))
        leg = Leg(id=name, joints=own_names, servos=servos, quantum_rad=own)
        made.append(msgspec.structs.replace(leg, axes=leg.joint_axes))
        used.setdefault(one.name, set()).update(part)
    slopes = [s for one in found for servo, s in one.slopes_rad.items() if servo in used[one.name]]
    ports = {
        one.name: msgspec.structs.replace(
            one.port, ignore=tuple(sorted(set(one.servos) - used[one.name]))
        )
        for one in found
        if one.name in used
    }
    return Robot(
        name="my-robot",
        period_s=0.02,
        quantum_rad=quantum,
        legs=tuple(made),
        servo=ServoLaw(round(statistics.median(slopes), 3)) if slopes else ServoLaw(),
        ports=ports,
    )


def _dealt(found: Sequence[Found], joints: int) -> list[tuple[Found, tuple[int, ...]]]:
    """Assign all servos that follow no other to legs, in the order of their ids."""
    parts: list[tuple[Found, tuple[int, ...]]] = []
    for one in found:
        ids = sorted(one.servos.keys() - one.follows.keys())
        _models(one, ids)
        if len(ids) % joints:
            raise BusError(
                f"port {one.name}: {len(ids)} servos do not make legs of {joints} joints "
                f"(ids {', '.join(map(str, ids))}); give --joints, or find the one that is "
                "missing, or name the servos of the legs with --ids"
            )
        parts += [(one, tuple(ids[at : at + joints])) for at in range(0, len(ids), joints)]
    return parts


def _chosen(
    found: Sequence[Found], wanted: Sequence[Wanted]
) -> list[tuple[Found, tuple[int, ...]]]:
    """Make the legs of ``--ids``, each on the port where its servos are."""
    parts = []
    for port, ids in wanted:
        text = ",".join(map(str, ids))
        here = [one for one in found if port in (one.name, None)]
        if not here:
            names = ", ".join(one.name for one in found)
            raise BusError(f"--ids names port '{port}'; --device gives {names}")
        on = [one for one in here if set(ids) <= set(one.servos)]
        if len(on) > 1:
            raise BusError(
                f"--ids {text}: ports {', '.join(one.name for one in on)} all have these servos; "
                f"name the port, such as {on[0].name}:{text}"
            )
        if not on:
            near = max(here, key=lambda one: len(set(ids) & set(one.servos)))
            lacking = [str(servo) for servo in ids if servo not in near.servos]
            raise BusError(
                f"--ids {text}: port {near.name} has no servo {', '.join(lacking)} (ids there are "
                f"{_ranges(sorted(near.servos))}); check its cable, power, id and baud rate"
            )
        _models(on[0], ids)
        parts.append((on[0], ids))
    return parts


def _models(one: Found, ids: Sequence[int]) -> tuple[ServoModel, ...]:
    """Return the models of some servos of a port.

    Raises:
        BusError: one of them cannot be used.
    """
    mute = [str(servo) for servo in ids if servo in one.pongs and not one.pongs[servo].reads]
    if mute:
        raise BusError(
            f"port {one.name}: servo {', '.join(mute)} answers to pings but not to reads (its "
            "status return level is 0); run this once with --configure, which sets it to 2, or "
            "name the servos of the legs with --ids"
        )
    unknown = [f"{servo} ({one.words(servo)})" for servo in ids if one.servos[servo] is None]
    if unknown:
        raise BusError(
            f"port {one.name}: servo {', '.join(unknown)} is of no known model; see docs/bridge.md "
            "for those that are, or name the servos of the legs with --ids"
        )
    protocol = one.port.protocol
    models = {servo: model for servo in ids if (model := one.servos[servo]) is not None}
    other = [f"{s} ({model.name})" for s, model in models.items() if model.protocol != protocol]
    if other:  # Dynamixel: others have their numbers elsewhere
        own = 2 if protocol == 1 else 1
        raise BusError(
            f"port {one.name}: servo {', '.join(other)} answers in protocol {protocol}, and is "
            f"supported in protocol {own} only; set its Protocol Type with DYNAMIXEL Wizard "
            "(servos of one port need one protocol), or name the servos of the legs with --ids"
        )
    return tuple(models.values())


def describe(found: Iterable[Found]) -> list[str]:
    """Describe what answers, one line per port."""
    lines = []
    for one in found:
        models: dict[str, list[int]] = {}
        for servo, model in sorted(one.servos.items()):
            name = model.name if model else f"unknown model ({one.words(servo)})"
            models.setdefault(name, []).append(servo)
        held = "; ".join(f"{len(ids)} x {name}, ids {_ranges(ids)}" for name, ids in models.items())
        lines.append(
            f"port {one.name} ({one.port.device}): {held}; {one.port.baud} baud, protocol "
            f"{one.port.protocol}"
        )
        lines += [f"port {one.name}: {line}" for line in one.done]
        lines += [
            f"port {one.name}: servo {servo} follows servo {first} by its secondary id, and makes "
            "no joint of its own; where it is one, set that to 255 with DYNAMIXEL Wizard"
            for servo, first in one.follows.items()
        ]
        lines += [
            f"port {one.name}: {astray_text(one.port, place, ids)}"
            for place, ids in one.elsewhere.items()
        ]
    return lines


# -- private -----------------------------------------------------------------------------------


def _quantum(models: Sequence[ServoModel]) -> float:
    """Return a leg's position step: the largest of its servos', as one number stands for all."""
    return round(max(model.step_rad for model in models), 6)


def _joint_names(joints: int) -> tuple[str, ...]:
    usual: Mapping[int, tuple[str, ...]] = {2: ("hip", "knee"), 3: ("coxa", "femur", "tibia")}
    return usual.get(joints, tuple(f"joint{i + 1}" for i in range(joints)))


def _ranges(ids: Sequence[int]) -> str:
    parts: list[list[int]] = []
    for i in ids:
        if parts and i == parts[-1][-1] + 1:
            parts[-1].append(i)
        else:
            parts.append([i])
    return ", ".join(f"{p[0]}" if len(p) == 1 else f"{p[0]}-{p[-1]}" for p in parts)
