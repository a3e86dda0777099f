"""A :class:`~adaptive_contact.service.watch.View` as a table for a terminal."""

from __future__ import annotations

import math
from typing import Final

from rich import box
from rich.table import Table
from rich.text import Text

from adaptive_contact.printable import printable
from adaptive_contact.service.watch import LegView, View
from adaptive_contact.wire import Status

__all__ = ["headline", "table"]

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
    """One line over the table: the service, and what is wrong with it as a whole."""
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
        f"{printable(service.robot)}  up {_duration(service.uptime_s)}  {service.events} events"
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
        line.append(f"  {unheard} {contacts} told and not heard here", style="bold red")
    if service.stalls:
        line.append(f"  worker stood still {service.stalls} times", style="bold red")
    if service.rejects:
        line.append(f"  refused: {_counts(service.rejects)}", style="yellow")
    if service.callback_faults:
        line.append(f"  {service.callback_faults} callback faults", style="bold red")
    if service.note is not None:
        line.append(f"\n{printable(service.note)}", style="bold red")
    for refused in [] if service.state is None else service.state.refused:
        line.append(f"\nstate refused: {printable(refused)}", style="yellow")
    if service.state is not None and service.state.exposed is not None:
        line.append(f"\n{printable(service.state.exposed)}", style="bold red")
    return line


def table(view: View) -> Table:
    """One row per leg; columns that need truth only where there is some."""
    with_truth = any(leg.touches is not None for leg in view.legs)
    with_changes = any(leg.changed_s is not None or leg.kind is not None for leg in view.legs)
    shown = Table(title=headline(view), title_justify="left", title_style="", box=box.SIMPLE_HEAD)
    shown.add_column("leg")
    shown.add_column("state")
    shown.add_column("status")
    if with_changes:
        shown.add_column("changed")
    shown.add_column("last contact", justify="right")
    if with_truth:
        shown.add_column("latency", justify="right")
        shown.add_column("seen", justify="right")
        shown.add_column("false", justify="right")
    shown.add_column("residual", justify="right")
    shown.add_column("× floor", justify="right")
    shown.add_column("model", justify="right")
    shown.add_column("Hz", justify="right")
    shown.add_column("missed", justify="right")
    shown.add_column("rejects")
    shown.add_column("note", overflow="fold")
    for leg in view.legs:
        cells = [
            Text(printable(leg.leg), style="bold"),
            _state(leg),
            _status(leg),
            *([_change(leg)] if with_changes else []),
            _age(leg.contact_age_s),
        ]
        if with_truth:
            cells += _against_truth(leg)
        cells += _model(leg)
        cells += [
            Text("-" if leg.rate_hz is None else f"{leg.rate_hz:.1f}"),
            _lost(leg),
            Text(_counts(leg.rejects) or "-", style="yellow" if leg.rejects else "dim"),
            Text(printable(leg.note or ""), style="yellow"),
        ]
        shown.add_row(*cells, style="dim" if leg.stale else "")
    return shown


def _lost(leg: LegView) -> Text:
    """Samples missed; what a source lost while it began anew, no number tells."""
    words = f"{leg.missed}"
    if leg.restarts:
        words += f", {leg.restarts} {'restart' if leg.restarts == 1 else 'restarts'}"
    return Text(words, style="yellow" if leg.missed or leg.restarts else "dim")


def _state(leg: LegView) -> Text:
    """Free or contact; and of an ambiguous leg how many contacts have been withheld."""
    if leg.contact is None:
        return Text("?", style="dim")
    if leg.contact:
        return Text("CONTACT", style="bold reverse")
    if leg.withheld and leg.status == "ambiguous":
        return Text(f"{leg.withheld} withheld", style="yellow")
    return Text("free")


def _status(leg: LegView) -> Text:
    if leg.status is None:
        return Text("?", style="dim")
    if leg.stale:
        return Text(f"{leg.status}, stale", style="red")
    return Text(leg.status, style=_COLOURS[leg.status])


def _change(leg: LegView) -> Text:
    """What the leg has changed in, as far as can be told, and when."""
    when = None if leg.changed_s is None else f"{_duration(leg.changed_s)} ago"
    words = ", ".join(filter(None, (leg.kind, when)))
    return Text(printable(words)) if words else Text("-", style="dim")


def _age(age_s: float | None) -> Text:
    return Text("-", style="dim") if age_s is None else Text(f"{_duration(max(age_s, 0.0))} ago")


def _against_truth(leg: LegView) -> list[Text]:
    if leg.touches is None:
        return [Text("-", style="dim")] * 3
    if leg.latency_ms is None or leg.median_latency_ms is None:
        latency = Text("-", style="dim")
    else:
        latency = Text(f"{leg.latency_ms:.0f} ms ({leg.median_latency_ms:.0f})")
    alarms = leg.false_alarms or 0
    return [
        latency,
        Text(f"{leg.seen}/{leg.touches}"),
        Text(str(alarms), style="bold red" if alarms else "green"),
    ]


def _model(leg: LegView) -> list[Text]:
    version = Text("-" if leg.model_version is None else f"v{leg.model_version}")
    if not any(leg.noise_floor):  # no model yet
        return [Text("-", style="dim"), Text("-", style="dim"), version]
    worst = math.degrees(max(leg.residual_rms))
    ratios = [
        rms / floor
        for rms, floor in zip(leg.residual_rms, leg.noise_floor, strict=False)
        if floor > 0
    ]
    ratio = max(ratios, default=math.nan)
    style = "red" if ratio > _VERY_HIGH else "yellow" if ratio > _HIGH else "green"
    return [
        Text(f"{worst:.2f}°"),
        Text("-", style="dim") if math.isnan(ratio) else Text(f"{ratio:.1f}", style=style),
        version,
    ]


def _counts(counts: dict[str, int]) -> str:
    """All reasons by number, the largest first: no loss is out of sight behind others."""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{printable(reason)} {number}" for reason, number in ordered if number)


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    if seconds < 3600:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h"
