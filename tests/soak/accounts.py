"""The books of a soak: every sample, event, state and link, from what was heard of them.

Whoever is killed meanwhile, what one status says and the next does must go together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from adaptive_contact.robot import Robot
from adaptive_contact.status import ServiceStatus

from .conduct import Broken, Take


def uncounted(leg: str, seq_of: dict[int, int], take: Take) -> int:
    """The worst difference between ticks gone through and samples accounted for."""
    first: tuple[int, int] | None = None
    worst = 0
    for _, status in take.heard.statuses:
        if status.leg != leg or status.t_ns not in seq_of:
            continue  # nothing heard yet, at the start of a life
        seq, counted = seq_of[status.t_ns], status.ticks + status.missed
        if first is None:
            first = (seq, counted)
        worst = max(worst, abs((seq - first[0]) - (counted - first[1])))
    return worst


def inconsistent(take: Take, seq_of: dict[str, dict[int, int]]) -> int:
    """Events on samples that were never sent, with an onset in the future, or heard twice."""
    seen: Counter[tuple[str, int, bool]] = Counter()
    wrong = 0
    for _, event in take.heard.events:
        seen[event.leg, event.t_ns, event.contact] += 1
        sent = seq_of.get(event.leg, {}).get(event.t_ns)
        wrong += sent != event.seq or event.onset_ns > event.t_ns
    return wrong + sum(count - 1 for count in seen.values())


def forgotten_s(
    leg: str, seq_of: Mapping[int, int], take: Take, fault: Broken, robot: Robot
) -> float:
    """How much a leg went back by at a kill, s, from its accepted samples before and after.

    Both statuses are up to a second off, to either side: what came after the last one before the
    kill is lost as well, what came before the first one after it has been learned since.
    """
    before = after = None
    for at_ns, status in take.heard.statuses:
        if status.leg != leg or status.t_ns not in seq_of:
            continue
        if at_ns < fault.from_ns:
            before = status.ticks
        elif at_ns > fault.to_ns and after is None:
            after = status.ticks
    if before is None or after is None:
        return float("inf")  # nobody knows
    return (before - after) * robot.period_s


def last_words(services: Sequence[ServiceStatus]) -> list[ServiceStatus]:
    """The last status of each start of the service, in order."""
    return list({one.instance: one for one in services}.values())


def state_of(lives: Sequence[ServiceStatus]) -> dict[str, Any]:
    """How keeping state went, over all lives: one that was killed has saved, too."""
    kept = [one.state for one in lives if one.state is not None]
    if not kept:
        return {}
    return {
        "saved": sum(one.saved for one in kept),
        "failed": sum(one.failed for one in kept),
        "restored": kept[-1].restored,
        "refused": [line for one in kept for line in one.refused],
    }
