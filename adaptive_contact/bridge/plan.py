"""Plans, from a robot's description, what each port's process has to do."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import msgspec

from adaptive_contact.bridge.tables import MODELS, ServoModel, models_named
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import AngleFrame, Leg, Port, Robot
from adaptive_contact.robot.description import Protocol

# Name of the port of a description without any.
DEFAULT_PORT: Final = "main"


@dataclass(frozen=True)
class JointPlan:
    """Describes one servo, as a joint."""

    servo: int  # id on the bus
    name: str  # of the joint
    # what the servo may answer to be; all have the same control table
    models: tuple[ServoModel, ...]
    # direction, offset_rad: angle = direction * (position - centre) + offset
    direction: int
    offset_rad: float
    # lower_rad, upper_rad: how far goals may go
    lower_rad: float = -math.inf
    upper_rad: float = math.inf

    @property
    def model(self) -> ServoModel:
        """Return the control table to use."""
        return self.models[0]

    def angle(self, steps: int) -> float:
        """Convert a position in steps to the joint's angle, rad."""
        model = self.model
        return self.direction * (steps - model.centre) * model.step_rad + self.offset_rad

    def steps(self, angle_rad: float) -> int:
        """Convert a joint's angle to the nearest position, steps, also beyond the servo's range."""
        model = self.model
        return model.centre + round(self.direction * (angle_rad - self.offset_rad) / model.step_rad)


@dataclass(frozen=True)
class LegPlan:
    """Lists one leg's servos, from the body outwards."""

    id: str
    joints: tuple[JointPlan, ...]
    max_step_rad: float


@dataclass(frozen=True)
class PortPlan:
    """Describes what one process does."""

    name: str
    port: Port
    legs: tuple[LegPlan, ...]
    period_s: float

    @property
    def joints(self) -> tuple[JointPlan, ...]:
        """Return all joints on this port."""
        return tuple(joint for leg in self.legs for joint in leg.joints)


def plan_ports(
    robot: Robot, devices: Mapping[str, str] | None = None, *, baud: int | None = None
) -> tuple[PortPlan, ...]:
    """Assign the robot's legs to its ports.

    Args:
        robot: its description.
        devices: devices instead of the description's, by port; a robot without ports has one
            called ``main``.
        baud: instead of the description's.

    Raises:
        ConfigurationError: there is no port, no servo, or something is unknown.
    """
    ports = dict(robot.ports)
    for name, device in (devices or {}).items():
        if name in ports:
            ports[name] = msgspec.structs.replace(ports[name], device=device)
        elif not ports and name == DEFAULT_PORT:
            ports[name] = Port(device=device, protocol=protocol_of(robot))
        else:
            raise ConfigurationError(
                f"robot '{robot.name}' has no port '{name}'; its ports are "
                f"{', '.join(ports) or DEFAULT_PORT}"
            )
    if not ports:
        raise ConfigurationError(
            f"robot '{robot.name}' has no port; add [port.main] with device = \"/dev/ttyUSB0\" to "
            "its robot.toml, or give --device /dev/ttyUSB0"
        )
    owners: dict[str, str] = {}
    for name, port in ports.items():
        # Links differ where their adapter is one.
        before = owners.setdefault(os.path.realpath(port.device), name)
        if before != name:
            raise ConfigurationError(
                f"[port.{name}] and [port.{before}] are one device ({port.device}); give each its "
                "own, or put all legs on one port"
            )
    plans = []
    for name, port in ports.items():
        if baud is not None:
            port = msgspec.structs.replace(port, baud=baud)
        legs = tuple(
            _leg(leg, name, port)
            for leg in robot.legs
            if leg.servos is not None and leg.servos.port in (name, None)
        )
        if legs:
            plans.append(PortPlan(name, port, legs, robot.period_s))
    if not plans:
        raise ConfigurationError(
            f"robot '{robot.name}' has no servos; add servos = {{ ids = [...] }} to its legs, or "
            "let `adaptive-contact robot init` write the file"
        )
    return tuple(plans)


def _leg(leg: Leg, name: str, port: Port) -> LegPlan:
    servos = leg.servos
    assert servos is not None
    if not AngleFrame(leg).same:  # the bridge's samples and commands are in the description's frame
        raise ConfigurationError(
            f"[[leg]] '{leg.id}' has [leg.angles], which are for sources that are no bridge: they "
            "would turn the bridge's samples twice; remove them, and count them into directions "
            "and offsets_rad of [leg.servos]"
        )
    joints = []
    for j, (servo, joint) in enumerate(zip(servos.ids, leg.joints, strict=True)):
        direction = 1 if servos.directions is None else servos.directions[j]
        offset = 0.0 if servos.offsets_rad is None else servos.offsets_rad[j]
        models = _models(f"[[leg]] '{leg.id}'", servos.models[j], name, port)
        plan = JointPlan(servo, joint, models, direction, offset)
        ends = [plan.angle(plan.model.lowest), plan.angle(plan.model.highest)]
        lower, upper = min(ends), max(ends)
        if leg.limits is not None:
            lower = max(lower, leg.limits.lower_rad[j])
            upper = min(upper, leg.limits.upper_rad[j])
        if lower >= upper:
            raise ConfigurationError(
                f"[[leg]] '{leg.id}': joint '{joint}' cannot move: its limits and the range of "
                f"{plan.model.name} ({min(ends):.2f} to {max(ends):.2f} rad) do not meet; check "
                "servos.offsets_rad and limits"
            )
        joints.append(replace(plan, lower_rad=lower, upper_rad=upper))
    return LegPlan(leg.id, tuple(joints), servos.max_step_rad)


def _models(where: str, wanted: str, name: str, port: Port) -> tuple[ServoModel, ...]:
    """Return what a model of the description may be on a port."""
    try:
        models = models_named(wanted)
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from error
    model = models[0]
    if model.protocol != port.protocol:
        other = next((m for m in MODELS if m.name == f"{model.name}(2.0)"), None)
        also = f', or model = "{other.name}" if it has that firmware' if other else ""
        raise ConfigurationError(
            f"{where}: {wanted} uses protocol {model.protocol}, [port.{name}] is set to "
            f"{port.protocol}; set protocol = {model.protocol!r} there{also}"
        )
    if port.fast and model.compact:
        raise ConfigurationError(
            f"{where}: {wanted} knows no fast sync read; remove fast from [port.{name}]"
        )
    return models


def protocol_of(robot: Robot) -> Protocol:
    """Return the protocol of the robot's servos, for a port that is not described."""
    for leg in robot.legs:
        if leg.servos is not None:
            return models_named(leg.servos.models[0])[0].protocol
    return 1
