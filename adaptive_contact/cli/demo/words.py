"""The result in words: what the title of the report says."""

from __future__ import annotations

import math

from adaptive_contact.cli.demo.settings import DemoSettings, drift_words
from adaptive_contact.cli.demo.verdict import Judged, Verdict, others
from adaptive_contact.score import Summary


def touches_words(settings: DemoSettings, verdict: Verdict) -> str:
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
    if service.recovery is None:
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
    return judged.recovery != 0 or errors > 2


def _swings(count: int) -> str:
    return "1 swing" if count == 1 else f"{count} swings"


def _share(summary: Summary) -> str:
    return f"{summary.counted.found} of {summary.counted.touches}"


def _alarms(summary: Summary) -> str:
    count = summary.false_alarms
    return "no false alarm" if count == 0 else f"{count} false alarm{'s' if count > 1 else ''}"
