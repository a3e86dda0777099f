"""Prepares commands that use servos on a bus: robot, ports, handshake."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from adaptive_contact.bridge.plan import DEFAULT_PORT, PortPlan, plan_ports
from adaptive_contact.cli._options import option
from adaptive_contact.cli._output import print_line
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Robot

DeviceOption = Annotated[
    list[str] | None,
    option(
        "--device",
        "Serial port instead of robot.toml's, such as /dev/ttyUSB0 or left=/dev/ttyUSB1; "
        "repeatable.",
        "[PORT=]PATH",
    ),
]
BaudOption = Annotated[
    int | None,
    option("--baud", "Baud rate instead of robot.toml's.", "BAUD", min=1_200, max=12_000_000),
]


def described_in(config: Path | None) -> str:
    """Name the file of a description for the operator."""
    return "the shipped robot, as there is no --config" if config is None else str(config)


def plans_of(
    robot: Robot, config: Path | None, device: list[str] | None, baud: int | None = None
) -> tuple[PortPlan, ...]:
    """Plan what each port has to do; an error names the robot's file.

    Raises:
        ConfigurationError: there is no port, no servo, or something is unknown.
    """
    devices = devices_of(device)
    try:
        return plan_ports(robot, devices, baud=baud)
    except ConfigurationError as error:
        raise ConfigurationError(f"{described_in(config)}: {error}") from error


def devices_of(given: list[str] | None) -> dict[str, str]:
    """Parse the devices of ``--device``, by port.

    Raises:
        ConfigurationError: a port is given twice.
    """
    devices: dict[str, str] = {}
    for text in given or ():
        name, equals, path = text.partition("=")
        if not equals:
            name, path = DEFAULT_PORT, text
        if name in devices:
            raise ConfigurationError(f"--device gives port '{name}' twice; give each once")
        devices[name] = path
    return devices


def shake_hands(
    plans: Sequence[PortPlan],
    by: str = "adaptive-contact",
    *,
    configure: bool = False,
    drive: bool = False,
) -> None:
    """Make sure that the servos are those described, and say what was set or should be.

    Args:
        plans: what is expected on each port.
        by: which command says so.
        configure: write what should be set differently, EEPROM included.
        drive: they are to be driven, not only observed.

    Raises:
        BusError: something stands in the way.
    """
    from adaptive_contact.bridge.handshake import check_ports

    findings = check_ports(plans, configure=configure, drive=drive)
    for line in findings.advice:
        print_line(f"{by}: {line}", err=True)
    findings.raise_errors()
