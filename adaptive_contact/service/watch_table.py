"""Formats a :class:`~adaptive_contact.service.watch.View` as a table for a terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple

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
# Residuals this far above the model's own level are worth a glance, and a look.
_HIGH, _VERY_HIGH = 1.5, 2.5


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
    line = Text(
        f"{printable(service.robot)}  up {duration(service.uptime_s)}  {service.events} events"
    )
    if service.event_latency is not None:
        delay = service.event_latency
        line.append(f"  in to out {delay.p50:.2f} ms (p99 {delay.p99:.2f})")
    if not view.alive:
        line.append("  service gone", style="bold red")
    if service.events_lost:
        line.append(f"  {service.events_lost} events lost", style="bold red")
    if service.slow_puts:
        line.append(f"  {service.slow_puts} events held up", style="yellow")
    if service.cut_off:
        line.append(f"  {service.cut_off} links of subscribers dropped", style="bold red")
    unheard = sum(leg.unheard for leg in view.legs)
    if unheard:
        contacts = "contact" if unheard == 1 else "contacts"
        line.append(f"  {unheard} {contacts} reported but not received here", style="bold red")
    if service.stalls:
        line.append(f"  worker stood still {service.stalls} times", style="bold red")
    if service.rejects:
        line.append(f"  refused: {counts_of(service.rejects)}", style="yellow")
    if service.callback_faults:
        line.append(f"  {service.callback_faults} callback faults", style="bold red")
    if service.note is not None:
        line.append(f"\n{printable(service.note)}", style="bold red")
    for key, question in service.strays.items():
        line.append(f"\nnobody reads {printable(key)}: {printable(question)}", style="bold red")
    for refused in [] if service.state is None else service.state.refused:
        line.append(f"\nstate refused: {printable(refused)}", style="yellow")
    if service.state is not None and service.state.exposed is not None:
        line.append(f"\n{printable(service.state.exposed)}", style="bold red")
    return line


class _Column(NamedTuple):
    """Defines one column; the lower its rank, the sooner it gets a place."""

    name: str
    rank: int
    cell: Callable[[LegView], Text]
    right: bool = True


def table(view: View, width: int = 160) -> Group:
    """Format the service in a line, a row per leg, and the legs' notes under them.

    Args:
        view: what is known.
        width: columns of the terminal; columns of the table that do not fit are left out, the least
            important first, and named.
    """
    legs, columns = view.legs, _columns(view.legs)
    cells = {column: [column.cell(leg) for leg in legs] for column in columns}
    room = width + 2  # a gap between columns is padding and the box's own
    kept: list[_Column] = []
    for column in sorted(columns, key=lambda column: column.rank):
        takes = 2 + max([cell_len(column.name), *(cell.cell_len for cell in cells[column])])
        if not kept or takes <= room:
            kept.append(column)
            room -= takes
    fits = [column for column in columns if column in kept]
    grid = Table(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0), expand=False
    )
    for column in fits:
        grid.add_column(
            column.name, justify="right" if column.right else "left", no_wrap=len(fits) > 1
        )
    for i, leg in enumerate(legs):
        grid.add_row(*(cells[column][i] for column in fits), style="dim" if leg.stale else "")
    below = [line for leg in legs for line in _remarks(leg)]
    if len(fits) < len(columns):
        left = ", ".join(column.name for column in columns if column not in fits)
        below.append(Text(f"not shown at {width} columns: {left}", style="dim"))
    return Group(headline(view), Text(), grid, *([Text(), *below] if below else []))


def _columns(legs: Sequence[LegView]) -> list[_Column]:
    """Return the columns from left to right; those that need truth only where there is some."""
    columns = [
        _Column("leg", 0, lambda leg: Text(printable(leg.leg), style="bold"), right=False),
        _Column("state", 1, _state, right=False),
        _Column("status", 2, _status, right=False),
    ]
    if any(leg.p is not None for leg in legs):
        columns.append(_Column("p", 6, lambda leg: _number("{:.2f}", leg.p)))
    if any(leg.changed_s is not None or leg.kind is not None for leg in legs):
        columns.append(_Column("changed", 10, _change, right=False))
    columns.append(_Column("last contact", 3, lambda leg: _ago(leg.contact_age_s)))
    if any(leg.touches is not None for leg in legs):
        columns += [
            _Column(
                "latency",
                11,
                lambda leg: _number("{:.0f} ms ({:.0f})", leg.latency_ms, leg.median_latency_ms),
            ),
            _Column("seen", 4, lambda leg: _number("{}/{}", leg.seen, leg.touches or None)),
            _Column("false", 5, _false),
        ]
    return [
        *columns,
        # There is no floor before there is a model.
        _Column("residual", 14, lambda leg: _number("{:.2f}°", _residual_deg(leg))),
        _Column("× floor", 12, _ratio),
        _Column("model", 13, lambda leg: _number("v{}", leg.model_version)),
        _Column("Hz", 9, lambda leg: _number("{:.1f}", leg.rate_hz)),
        _Column("missed", 7, _lost),
        _Column("rejects", 8, _rejects),
    ]


def _number(form: str, *values: float | None) -> Text:
    """Format numbers; a dash where one of them is not known."""
    known = None not in values
    return Text(form.format(*values) if known else "-", style="" if known else "dim")


def _remarks(leg: LegView) -> list[Text]:
    """Format a leg's note, and why its samples were refused."""
    lines = []
    name = printable(leg.leg)
    if leg.note:
        lines.append(Text.assemble((f"{name}: ", "bold"), (printable(leg.note), "yellow")))
    if leg.rejects:
        lines.append(Text.assemble((f"{name}: ", "bold"), f"refused: {counts_of(leg.rejects)}"))
    return lines


def _rejects(leg: LegView) -> Text:
    total = sum(leg.rejects.values())
    return Text(str(total) if total else "-", style="yellow" if total else "dim")


def _lost(leg: LegView) -> Text:
    """Format samples missed; what a source lost while it restarted is not counted."""
    words = f"{leg.missed}"
    if leg.restarts:
        words += f", {leg.restarts} {'restart' if leg.restarts == 1 else 'restarts'}"
    return Text(words, style="yellow" if leg.missed or leg.restarts else "dim")


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


def _change(leg: LegView) -> Text:
    """Format what the leg has changed in, as far as is known, and when."""
    when = None if leg.changed_s is None else f"{duration(leg.changed_s)} ago"
    words = ", ".join(filter(None, (leg.kind, when)))
    return Text(printable(words)) if words else Text("-", style="dim")


def _false(leg: LegView) -> Text:
    alarms = leg.false_alarms
    return Text("-" if alarms is None else str(alarms), style="bold red" if alarms else "green")


def _ratio(leg: LegView) -> Text:
    ratios = [
        rms / floor
        for rms, floor in zip(leg.residual_rms, leg.noise_floor, strict=False)
        if floor > 0
    ]
    if not ratios:
        return Text("-", style="dim")
    ratio = max(ratios)
    style = "red" if ratio > _VERY_HIGH else "yellow" if ratio > _HIGH else "green"
    return Text(f"{ratio:.1f}", style=style)


def _residual_deg(leg: LegView) -> float | None:
    return math.degrees(max(leg.residual_rms)) if any(leg.noise_floor) else None


def _ago(age_s: float | None) -> Text:
    return Text("-", style="dim") if age_s is None else Text(f"{duration(max(age_s, 0.0))} ago")


def counts_of(counts: Mapping[str, int]) -> str:
    """Format all reasons by number, the largest first."""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{printable(reason)} {number}" for reason, number in ordered if number)
