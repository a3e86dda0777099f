"""What the full learner is held to, and whether it is met."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score import poisson_mean
from adaptive_contact_studies.scenarios.figures import LOCK_OUT_SWINGS
from adaptive_contact_studies.scenarios.learners import HEXAPOD
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.spec import Expect, Scenario, Variant

__all__ = ["Goal", "goals", "pooled"]

Tree = dict[str, Any]

RECOVERY_MEDIAN: Final = 10.0
RECOVERY_P95: Final = 20.0
ALARMS_ON_THE_WAY: Final = 2.0
RECALL_POINTS: Final = 1.0
TOUCHING_SHARE: Final = 0.001
VALID_SWINGS: Final = 60.0
ALARMS_PER_HOUR: Final = 5.0
CAUGHT_UNTOLD: Final = 0.1


@dataclass(frozen=True)
class Goal:
    """A figure, and what it should be at most.

    Attributes:
        what: of the full learner, with its unit.
        limit: that it should not exceed.
        measured: None for one that is not finite: a leg that never recovered, for instance.
    """

    what: str
    limit: float
    measured: float | None

    @property
    def met(self) -> bool:
        """Whether it is."""
        return self.measured is not None and self.measured <= self.limit


def goals(scenario: Scenario, tree: Tree) -> list[Goal]:
    """The goals of a scenario, from its figures.

    Args:
        scenario: which.
        tree: of :func:`~adaptive_contact_studies.scenarios.figures.figures`.
    """
    full = tree["variants"][Variant.FULL.value]
    made = {
        Expect.RECOVER: _recover,
        Expect.FOLLOW: _follow,
        Expect.UNPOISONED: _unpoisoned,
        Expect.UNHARMED: _unharmed,
        Expect.START: _start,
        Expect.QUIET: _quiet,
    }[scenario.expect](tree, full)
    if scenario.poisonous:
        made.append(_touching(full))
    if full["caught_swings"]:
        untold = 1.0 - full["caught_told"] / full["caught_swings"]
        made.append(Goal("caught swings not called ambiguous, share", CAUGHT_UNTOLD, untold))
    return made


def pooled(table: Mapping[str, Tree]) -> Tree:
    """Figures and goals over several scenarios together, by the name of what is pooled.

    Args:
        table: of figures, by name of the scenario.

    Returns:
        ``steady``: the false alarms of the full learner over all that is quiet of the hexapod;
        nothing while one of these scenarios is not in the table.
    """
    names = [
        s.name for s in scenarios().values() if s.expect is Expect.QUIET and s.robot == HEXAPOD
    ]
    if not set(names) <= table.keys():
        return {}
    judged = [table[name]["variants"][Variant.FULL.value]["judged"] for name in names]
    alarms = sum(one["false_alarms"] for one in judged)
    hours = sum(one["judged_ticks"] for one in judged) / ROBOT_HOUR_TICKS
    mean = poisson_mean(alarms)
    rate = alarms / hours if hours else None
    goal = Goal("false alarms per robot-hour, all that is steady", ALARMS_PER_HOUR, rate)
    steady = {
        "scenarios": names,
        "false_alarms": alarms,
        "robot_hours": hours,
        "per_robot_hour": rate,
        "per_robot_hour_interval": [mean.low / hours, mean.high / hours] if hours else [0.0, None],
        "goals": [asdict(goal) | {"met": goal.met}],
    }
    return {"steady": steady}


def _recover(tree: Tree, full: Tree) -> list[Goal]:
    if not tree["counts_as_one_to_recover_from"]:
        return _unharmed(tree, full)
    made = []
    several = len(full["recovery"]) > 1
    for mark, recovery in full["recovery"].items():
        of = f" ({mark})" if several else ""
        made += [
            Goal(f"swings to recovery, median{of}", RECOVERY_MEDIAN, recovery["swings_median"]),
            Goal(f"swings to recovery, p95{of}", RECOVERY_P95, recovery["swings_p95"]),
            Goal(
                f"false alarms on the way, median{of}",
                ALARMS_ON_THE_WAY,
                recovery["alarms_median"],
            ),
        ]
    return [*made, *_unharmed(tree, full)]


def _follow(_: Tree, full: Tree) -> list[Goal]:
    return [
        _recall(full),
        Goal("longest lock-out, swings", LOCK_OUT_SWINGS, float(full["longest_lock_out"])),
        Goal("harm", 0.0, float(full["harmful"])),
    ]


def _unpoisoned(_: Tree, full: Tree) -> list[Goal]:
    return [_recall(full)]


def _unharmed(_: Tree, full: Tree) -> list[Goal]:
    return [_recall(full), Goal("harm", 0.0, float(full["harmful"]))]


def _start(_: Tree, full: Tree) -> list[Goal]:
    start = full["start"]
    own, reference = start["when_valid"]["recall"], start["reference"]["recall"]
    lost = None if own is None or reference is None else 100.0 * (reference - own)
    return [
        Goal("swings until valid, p95", VALID_SWINGS, start["swings_p95"]),
        Goal("recall lost once valid, points", RECALL_POINTS, lost),
        Goal("harm once valid", 0.0, float(start["harmful"])),
    ]


def _quiet(_: Tree, full: Tree) -> list[Goal]:
    rate = full["judged"]["per_robot_hour"]
    return [Goal("false alarms per robot-hour", ALARMS_PER_HOUR, rate), _recall(full)]


def _recall(full: Tree) -> Goal:
    return Goal("recall lost, points", RECALL_POINTS, full["recall_lost_points"])


def _touching(full: Tree) -> Goal:
    return Goal("contact ticks learned, share", TOUCHING_SHARE, full["touching_share"])
