"""Defines ``adaptive-contact doctor``: names what looks wrong on the wire."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from adaptive_contact.checks.findings import Finding, Level
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import seconds_option
from adaptive_contact.cli._output import print_json
from adaptive_contact.errors import needs
from adaptive_contact.printable import printable

if TYPE_CHECKING:
    from adaptive_contact.service.doctor import Diagnosis

_COLOURS: Final[dict[Level, str]] = {"error": "bold red", "warning": "yellow", "note": "dim"}


@opt.flatten
def doctor(
    *,
    network: opt.Network,
    seconds: Annotated[
        float, seconds_option("--seconds", "How long to listen.", least=0.5, most=600.0)
    ] = 3.0,
    json: opt.JsonOption = False,
) -> None:
    """Find out who publishes what, which legs look wrong, and why.

    Exit code 0: nothing worse than a note; 1: warnings or errors; 2: no router.
    """
    from adaptive_contact.service.link import Link, NoRouterError

    with needs("doctor", "doctor", "numpy"):
        from adaptive_contact.service.doctor import Diagnosis, examine

    try:
        with Link.open(network.client(wait=False)) as link:
            diagnosis = examine(link, seconds)
    except NoRouterError as error:
        found = error.finding
        diagnosis = Diagnosis(router=found.reach, router_line=found.line)
    if json:
        print_json(diagnosis)
    else:
        print_diagnosis(diagnosis)
    raise typer.Exit(diagnosis.exit_code)


def print_diagnosis(diagnosis: Diagnosis) -> None:
    """Print what was found, for the operator."""
    console = table_console(pipe_width=140)
    if diagnosis.router != "connected":
        console.print(Text(f"router   {diagnosis.router_line}", style="bold red"))
        return
    console.print(f"router   {diagnosis.router_line}")
    service = diagnosis.service
    if service is not None:
        names = printable(" ".join(service.legs))
        robot = printable(service.robot)
        console.print(Text(f"service  up {service.uptime_s:.0f} s, robot {robot}, legs {names}"))
    else:
        console.print("service  none" if not diagnosis.service_alive else "service  says nothing")
    if diagnosis.keys:
        console.print(traffic_table(diagnosis))
    print_findings(diagnosis.findings, console)
    if diagnosis.exit_code == 0:
        console.print(Text("all is well", style="green"))


def print_findings(findings: Sequence[Finding], console: Console) -> None:
    """Print what is wrong, each with its remedy."""
    for finding in findings:
        line = Text(f"{finding.level}: ", style=_COLOURS[finding.level])
        legs = printable(" ".join(finding.legs))
        line.append(f"{legs}: " if legs else "", style="bold")
        line.append(printable(finding.what), style="not bold not dim default")
        console.print(line)
        console.print(Text(f"    -> {printable(finding.remedy)}", style="dim"))


def traffic_table(diagnosis: Diagnosis) -> Table:
    """Make the table of the keys that were heard."""
    shown = Table(box=box.SIMPLE_HEAD)
    shown.add_column("key", no_wrap=True)  # the others give way on a narrow terminal
    for name in ("messages/s", "bytes/s", "mean size"):
        shown.add_column(name, justify="right")
    shown.add_column("encoding")
    for key in diagnosis.keys:
        shown.add_row(
            Text(printable(key.key)),
            f"{key.rate_hz:.1f}",
            f"{key.bytes_per_s:.0f}",
            f"{key.mean_bytes:.0f} B",
            Text(printable(", ".join(key.encodings))),
        )
    return shown
