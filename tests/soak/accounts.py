"""The books of a soak: every sample, event, state and link, from what was heard of them.

Whoever is killed meanwhile, what one status says and the next does must go together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from adaptive_contact.robot import Robot
from adaptive_contact.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

from .conduct import Broken, Take


def statuses_of(leg: str, seq_of: Mapping[int, int], take: Take) -> list[tuple[int, LearnerStatus]]:
    """A leg's statuses and their arrival, but for those at the start of a life, of no sample."""
    of_leg = [(at_ns, status) for at_ns, status in take.heard.statuses if status.leg == leg]
    return [(at_ns, status) for at_ns, status in of_leg if status.t_ns in seq_of]


def uncounted(leg: str, seq_of: Mapping[int, int], take: Take) -> int:
    """The worst difference between ticks gone through and samples accounted for."""
    told = statuses_of(leg, seq_of, take)
    off = [seq_of[status.t_ns] - status.ticks - status.missed for _, status in told]
    return max((abs(one - off[0]) for one in off), default=0)


def inconsistent(take: Take, seq_of: dict[str, dict[int, int]]) -> int:
    """Events on samples that were never sent, with an onset in the future, or heard twice."""
    events = [event for _, event in take.heard.events]
    seen = Counter((event.leg, event.t_ns, event.contact) for event in events)
    wrong = sum(
        seq_of.get(event.leg, {}).get(event.t_ns) != event.seq or event.onset_ns > event.t_ns
        for event in events
    )
    return wrong + sum(count - 1 for count in seen.values())


def forgotten_s(
    leg: str, seq_of: Mapping[int, int], take: Take, fault: Broken, robot: Robot
) -> float:
    """How much a leg went back by at a kill, s, from its accepted samples before and after.

    Both statuses are up to a second off, to either side: what came after the last one before the
    kill is lost as well, what came before the first one after it has been learned since.
    """
    told = statuses_of(leg, seq_of, take)
    before = [status.ticks for at_ns, status in told if at_ns < fault.from_ns]
    after = [status.ticks for at_ns, status in told if at_ns > fault.to_ns]
    if not (before and after):
        return float("inf")  # nobody knows
    return (before[-1] - after[0]) * robot.period_s


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
