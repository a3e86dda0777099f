"""``PYTHONPATH=tests python -m soak [--minutes M] [--out FOLDER] [--seed N]``."""

from __future__ import annotations

import dataclasses
import shutil
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.files import write_file
from adaptive_contact.robot import shipped_robot

from . import SoakPlan, Verdict, conduct, judge
from .kept import keep_heard
from .memory import Grown, Point


def soak(
    minutes: Annotated[float, typer.Option(help="Of walking, in real time.")] = 30.0,
    out: Annotated[Path, typer.Option(metavar="FOLDER")] = Path("out/soak"),
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Walk for a long time, break everything once, and see that nothing was lost."""
    plan = SoakPlan(out, minutes, seed)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    shutil.rmtree(out / "state", ignore_errors=True)  # a soak begins with the shipped baseline
    out.mkdir(parents=True, exist_ok=True)
    take = conduct(plan, lambda line: typer.echo(line), stop)
    typer.echo(take.simulator)
    keep_heard(take, out / "heard.jsonl")  # first: a verdict may fail
    verdict = judge(take, plan, shipped_robot())
    text = msgspec.json.format(msgspec.json.encode(dataclasses.asdict(verdict)), indent=2)
    write_file(out / "soak.json", text + b"\n")
    _print(verdict)
    if verdict.failures:
        raise typer.Exit(1)


def _print(found: Verdict) -> None:
    missed = f"{found.missed_touches} of {found.touches} touches missed"
    lines = [
        f"{found.samples} samples, {found.missed_samples} lost and counted, "
        f"{found.uncounted} uncounted; rejects {found.rejects or 'none'}",
        f"{found.events} events, {found.events_lost} lost, {found.inconsistent} inconsistent; "
        f"outside windows and ramps: {found.false_alarms} false alarms in {found.judged_ticks} "
        f"swing ticks, {missed}",
        f"of touches in rows that do not count, {found.others_missed} of {found.others} missed",
        f"releases: {found.wrong_releases} of {found.releases} of a leg that stood loaded",
        _arrived(found),
        f"refits: {found.refits}; state: {found.state}",
        "outages and recovery "
        + ", ".join(
            f"{out:.1f} s, {back:.2f} s"
            for out, back in zip(found.outage_s, found.recovery_s, strict=True)
        ),
        *(
            f"{' '.join(anyway)} late after a fault, by touches missed without it, too"
            for anyway in found.late_anyway
            if anyway
        ),
        *(f"false alarm of {leg} at {at_s:.2f} s" for leg, at_s in found.alarms),
        *(f"touch of {leg} at {at_s:.2f} s missed" for leg, at_s in found.misses),
        *(f"loaded {leg} released at {at_s:.2f} s" for leg, at_s in found.wrong_released),
        *(
            f"{'during' if one.ramp else 'after'} {one.after}: {one.missed} of {one.touches} "
            f"touches missed, {one.false_alarms} false alarms, {one.wrong_releases} wrong releases"
            for one in found.sections
        ),
        *(
            f"memory of {whose} " + ", ".join(map(_grew, rows))
            for whose, rows in (
                ("the service", found.memory_mb),
                ("its child processes", found.worker_mb),
            )
        ),
        *(
            f"life {life + 1} of the service, MB: "
            + ", ".join(f"{one.mb:.1f} at {one.after_s:.0f} s" for one in _some(curve))
            for life, curve in enumerate(found.memory_curve)
        ),
        *(f"a kill cost {lost_s:.1f} s of learning" for lost_s in found.forgotten_s),
        f"in to out p99 {found.p99_ms} ms",
        *(f"NOT WELL: {line}" for line in found.failures),
    ]
    for line in lines:
        typer.echo(line)


def _arrived(found: Verdict) -> str:
    took = found.arrivals
    line = f"arrival: {took.late} of {took.events} events more than 0.25 s after their samples"
    if took.p99_s is not None and took.slowest_s is not None:
        line += f", p99 {1e3 * took.p99_s:.0f} ms, slowest {1e3 * took.slowest_s:.0f} ms"
    return (
        f"{line}; {found.cut_off} subscribers cut off; the source fell behind by "
        f"{found.source_behind_s:.2f} s"
    )


def _grew(one: Grown) -> str:
    slope = "" if one.slope_mb_min is None else f", {one.slope_mb_min:+.3f} MB/min at the end"
    return f"{one.growth_mb:+.1f} MB to {one.last_mb:.1f} MB{slope}"


def _some(curve: list[Point]) -> list[Point]:
    """Ten points of a curve and its last; all of them are in ``soak.json``."""
    return [*curve[:: max(1, len(curve) // 10)][:10], *curve[-1:]]


if __name__ == "__main__":
    try:
        typer.run(soak)
    except AdaptiveContactError as error:
        sys.exit(f"soak: {error}")
