"""Formats a :class:`~adaptive_contact.service.watch.View` as a table for a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from rich import box
from rich.cells import cell_len
from rich.console import Group
from rich.table import Table
from rich.text import Text

from adaptive_contact.durations import duration
from adaptive_contact.printable import printable
from adaptive_contact.service.watch import LegView, View
from adaptive_contact.wire import Status

_COLOURS: Final[dict[Status, str]] = {
    "valid": "green",
    "learning": "cyan",
    "adapting": "yellow",
    "ambiguous": "magenta",
    "silent": "red",
}
# Columns, those first that get a place before others.
_FIRST: Final = (
    *("leg", "state", "status", "last contact", "seen", "false", "p", "missed", "rejects", "Hz"),
    *("changed", "latency", "× floor", "model", "residual"),
)


def headline(view: View) -> Text:
    """Format the line over the table: the service, and what is wrong with it as a whole."""
    if not view.connected:
        return Text("router lost, reconnecting", style="bold red")
    service = view.service
    if service is None:
        return Text(
            "waiting for the service"
            if view.alive
            else "no service is running here; start "
            "`adaptive-contact serve`, or check --connect and --namespace",
            style="yellow",
        )
    delay, state = service.event_latency, service.state
    unheard = sum(leg.unheard for leg in view.legs)
    contacts = "contact" if unheard == 1 else "contacts"
    runs = [
        f"{printable(service.robot)}  up {duration(service.uptime_s)}  {service.events} events",
        None if delay is None else f"in to out {delay.p50:.2f} ms (p99 {delay.p99:.2f})",
    ]
    wrong = [
        not view.alive and "service gone",
        service.events_lost and f"{service.events_lost} events lost",
        service.slow_puts and f"{service.slow_puts} events held up",
        service.cut_off and f"{service.cut_off} links of subscribers dropped",
        unheard and f"{unheard} {contacts} reported but not received here",
        service.stalls and f"worker stood still {service.stalls} times",
        service.rejects and f"refused: {counts_of(service.rejects)}",
        service.callback_faults and f"{service.callback_faults} callback faults",
    ]
    lines = [
        service.note,
        *(f"nobody reads {key}: {question}" for key, question in service.strays.items()),
        *(f"state refused: {refused}" for refused in (state.refused if state else ())),
        state and state.exposed,
    ]
    return Text.assemble(
        "  ".join(filter(None, runs)),
        ("".join(f"  {words}" for words in wrong if words), "bold red"),
        ("".join(f"\n{printable(line)}" for line in lines if line), "bold red"),
    )


def table(view: View, width: int = 160) -> Group:
    """Format the service in a line, a row per leg, and the legs' notes under them.

    Args:
        view: what is known.
        width: columns of the terminal; columns of the table that do not fit are left out, the least
            important first, and named.  Those in which nothing is known are left out, too.
    """
    rows = [_cells(leg) for leg in view.legs]
    columns = [
        name
        for name in _cells(LegView(leg=""))
        if name == "leg" or any(row[name].plain != "-" for row in rows)
    ]
    room = width + 2  # a gap between columns is padding and the box's own
    fits: list[str] = []
    for name in sorted(columns, key=_FIRST.index):
        takes = 2 + max([cell_len(name), *(row[name].cell_len for row in rows)])
        if not fits or takes <= room:
            fits.append(name)
            room -= takes
    grid = Table(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), expand=False
    )
    shown = [name for name in columns if name in fits]
    for name in shown:
        left = name in ("leg", "state", "status", "changed")
        grid.add_column(name, justify="left" if left else "right", no_wrap=len(shown) > 1)
    for leg, row in zip(view.legs, rows, strict=True):
        grid.add_row(*(row[name] for name in shown), style="dim" if leg.stale else "")
    below = [line for leg in view.legs for line in _remarks(leg)]
    if len(fits) < len(columns):
        missing = ", ".join(name for name in columns if name not in fits)
        below.append(Text(f"not shown at {width} columns: {missing}", style="dim"))
    return Group(headline(view), Text(), grid, *([Text(), *below] if below else []))


def _cells(leg: LegView) -> dict[str, Text]:
    """Format a leg's columns, from left to right; a dash where a figure is not known."""
    floors = zip(leg.residual_rms, leg.noise_floor, strict=False)
    ratios = [rms / floor for rms, floor in floors if floor > 0.0]  # none before there is a model
    residual_deg = math.degrees(max(leg.residual_rms)) if ratios else None
    since, age_s = leg.changed_s, leg.contact_age_s
    changed = (leg.kind, None if since is None else f"{duration(since)} ago")
    restarts = f", {leg.restarts} restart{'s' * (leg.restarts > 1)}" if leg.restarts else ""
    return {
        "leg": Text(printable(leg.leg), style="bold"),
        "state": _state(leg),
        "status": _status(leg),
        "p": _number("{:.2f}", leg.p),
        "changed": Text(printable(", ".join(filter(None, changed))) or "-"),
        "last contact": Text("-" if age_s is None else f"{duration(max(age_s, 0.0))} ago"),
        "latency": _number("{:.0f} ms ({:.0f})", leg.latency_ms, leg.median_latency_ms),
        "seen": _number("{}/{}", leg.seen, leg.touches or None),
        "false": _number("{}", leg.false_alarms),
        "residual": _number("{:.2f}°", residual_deg),
        "× floor": _number("{:.1f}", max(ratios, default=None)),
        "model": _number("v{}", leg.model_version),
        "Hz": _number("{:.1f}", leg.rate_hz),
        "missed": Text(f"{leg.missed}{restarts}"),
        "rejects": _number("{}", sum(leg.rejects.values()) or None),
    }


def _number(form: str, *values: float | None) -> Text:
    """Format numbers; a dash where one of them is not known."""
    return Text("-" if None in values else form.format(*values))


def _remarks(leg: LegView) -> list[Text]:
    """Format a leg's note, and why its samples were refused."""
    lines = []
    name = printable(leg.leg)
    if leg.note:
        lines.append(Text.assemble((f"{name}: ", "bold"), (printable(leg.note), "yellow")))
    if leg.rejects:
        lines.append(Text.assemble((f"{name}: ", "bold"), f"refused: {counts_of(leg.rejects)}"))
    return lines


def _state(leg: LegView) -> Text:
    """Format free or contact; of an ambiguous leg how many contacts have been withheld."""
    if leg.contact is None:
        return Text("unknown", style="dim")
    if leg.contact:
        return Text("CONTACT", style="bold reverse")
    if leg.withheld and leg.status == "ambiguous":
        return Text(f"{leg.withheld} withheld", style="yellow")
    return Text("free")


def _status(leg: LegView) -> Text:
    if leg.status is None:
        return Text("waiting", style="dim")
    if leg.stale:
        return Text(f"{leg.status}, stale", style="red")
    return Text(leg.status, style=_COLOURS[leg.status])


def counts_of(counts: Mapping[str, int]) -> str:
    """Format all reasons by number, the largest first."""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{printable(reason)} {number}" for reason, number in ordered if number)
