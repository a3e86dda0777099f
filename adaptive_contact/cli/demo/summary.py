"""The result in words: what the title of the report says.

The figures: ``summary.json`` for programs, a table for the person who ran the demo.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import msgspec
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptive_contact.cli.demo.conduct import Take
from adaptive_contact.cli.demo.settings import DemoSettings, drift_words
from adaptive_contact.cli.demo.verdict import RECOVERY_SWINGS, Judged, Verdict, others
from adaptive_contact.files import write_file
from adaptive_contact.score import Summary
from adaptive_contact.score.tables import as_json
from adaptive_contact.service.server import version


def touches_words(verdict: Verdict) -> str:
    """How well contacts are found before the drift."""
    total = verdict.service.before.total
    counted = total.counted
    latency = counted.latency
    delay = "" if latency is None else f", half within {latency.median_ms:.0f} ms"
    return (
        f"Before the drift: {counted.found} of {counted.touches} touches found from servo "
        f"positions{delay}, {_alarms(total)}"
    )


def outcome_words(settings: DemoSettings, verdict: Verdict) -> tuple[str, ...]:
    """What the drift did, and what became of it; one line each."""
    leg = verdict.drift_leg
    service, frozen = verdict.service, verdict.frozen
    what = f"After the drift ({drift_words(settings)} on leg {leg})"
    if not _hurt(frozen, leg):
        after = service.after.total
        return (f"{what}: no harm done, {_share(after)} touches found, {_alarms(after)}.",)
    old, own = frozen.after.legs[leg], service.after.legs[leg]
    rest = others(service.after, leg)
    swings = service.swings_after
    if service.recovery is None and swings < RECOVERY_SWINGS:
        back = f"The service, with only {_swings(swings)} left to judge it by"
    elif service.recovery is None:
        back = "The service has not caught up by the end"
    elif service.recovery == 0:
        back = "The service follows the leg at once"
    else:
        back = f"The service follows the leg and is back after {_swings(service.recovery)}"
    return (
        f"{what}: a frozen model finds {_share(old)} touches of {leg}, with {_alarms(old)}.",
        f"{back}: {_share(own)}, {_alarms(own)}. The other legs: {_share(rest)}, {_alarms(rest)}.",
    )


def percent(share: float | None) -> str:
    """A share for a person; only all is 100 %."""
    return "-" if share is None else f"{math.floor(100 * share)} %"


def _hurt(judged: Judged, leg: str) -> bool:
    """Whether the drift did harm to a detector: it was not reliable from the drift on."""
    errors = judged.after.legs[leg].lost_swings
    if judged.swings_after < RECOVERY_SWINGS:
        return errors > 0
    return judged.recovery != 0 or errors > 2


def _swings(count: int) -> str:
    return "1 swing" if count == 1 else f"{count} swings"


def _share(summary: Summary) -> str:
    return f"{summary.counted.found} of {summary.counted.touches}"


def _alarms(summary: Summary) -> str:
    count = summary.false_alarms
    return "no false alarm" if count == 0 else f"{count} false alarm{'s' if count > 1 else ''}"


VERSION: Final = 1


def figures(settings: DemoSettings, take: Take, verdict: Verdict) -> dict[str, Any]:
    """Everything that was found, as a tree of numbers and texts; what is not known is None."""
    walk = settings.simulated.walk
    return {
        "v": VERSION,
        "result": [touches_words(verdict), *outcome_words(settings, verdict)],
        "settings": {
            "seconds": settings.seconds,
            "seed": settings.seed,
            "robot": settings.robot,
            "motion": f"{walk.gait if walk else ''} walk on rough ground, stop on truth",
            "drift": {
                "leg": settings.leg,
                "injected": msgspec.to_builtins(settings.drifts),
                "holds": take.holds,
                "t_ns": take.drift_ns,
                "after_s": (verdict.drift_ns - verdict.start_ns) / 1e9,
            },
            "version": version(),
        },
        "recording": settings.recording.name,
        "simulator": take.simulator,
        "service": {
            **_detector(verdict.service),
            "model_versions": verdict.versions,
            "status": msgspec.to_builtins(take.service),
        },
        "frozen": _detector(verdict.frozen),
    }


def write_summary(path: Path, tree: dict[str, Any]) -> None:
    """Write the figures.

    Raises:
        AdaptiveContactError: the file cannot be written.
    """
    data = msgspec.json.format(msgspec.json.encode(tree), indent=2) + b"\n"
    write_file(path, data, advice="give a folder with --out that is writable and has room")


def as_table(settings: DemoSettings, verdict: Verdict) -> RenderableType:
    """Before and after, leg by leg, and the same for the frozen model."""
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    shown.add_column("leg")
    for when in ("before", "after"):
        shown.add_column(f"touches {when}", justify="right")
        shown.add_column("found", justify="right")
        shown.add_column("median", justify="right")
        shown.add_column("false", justify="right")
    for leg in verdict.service.whole.legs:
        drifted = leg == verdict.drift_leg
        shown.add_row(
            f"{leg}, drifted" if drifted else leg,
            *_cells(verdict.service.before.legs[leg]),
            *_cells(verdict.service.after.legs[leg]),
            style="bold yellow" if drifted else "",
        )
    for name, judged in (("all", verdict.service), ("all, model frozen", verdict.frozen)):
        shown.add_section()
        shown.add_row(name, *_cells(judged.before.total), *_cells(judged.after.total))
    return Group(
        Text(touches_words(verdict), style="bold"),
        *(Text(line, style="bold") for line in outcome_words(settings, verdict)),
        shown,
    )


def _detector(judged: Judged) -> dict[str, Any]:
    return {
        "before": as_json(judged.before),
        "after": as_json(judged.after),
        "whole": as_json(judged.whole),
        "recovery": {"swings": judged.recovery, "reliable_swings": RECOVERY_SWINGS},
    }


def _cells(summary: Summary) -> tuple[str, ...]:
    counted = summary.counted
    median = f"{counted.latency.median_ms:.0f} ms" if counted.latency else "-"
    return (
        str(counted.touches),
        percent(counted.recall),
        median,
        str(summary.false_alarms),
    )
