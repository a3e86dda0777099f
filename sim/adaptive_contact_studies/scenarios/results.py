"""What the full learner is held to: figures and goals of each scenario."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, NamedTuple

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_studies.scenarios.judge import figures, score_scenario
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.replay import HEXAPOD, replayed
from adaptive_contact_studies.scenarios.runs import Sizes
from adaptive_contact_studies.scenarios.spec import ReplaySpec, Scenario
from adaptive_contact_studies.work import LEARNER, SIMULATOR, Work, digest

Tree = dict[str, Any]

RECALL_POINTS: Final = 1.0
ALARMS_PER_HOUR: Final = 5.0


class Goal(NamedTuple):
    """A figure, and what it should be at most."""

    what: str  # of the full learner, with its unit
    limit: float  # that it should not exceed
    # None for one that is not finite: a leg that never recovered, for instance
    measured: float | None

    @property
    def tree(self) -> Tree:
        """As a results file has it."""
        met = self.measured is not None and self.measured <= self.limit
        return self._asdict() | {"met": met}


def goals(scenario: Scenario, tree: Tree) -> list[Goal]:
    """The goals of a scenario, from its figures."""
    full = tree["variants"]["full"]
    recall = Goal("recall lost, points", RECALL_POINTS, full["recall_lost_points"])
    harm = Goal("harm", 0.0, float(full["harmful"]))
    match scenario.expect:
        case "recover" if tree["counts_as_one_to_recover_from"]:
            made = [*_recover(full), recall, harm]
        case "recover" | "unharmed":
            made = [recall, harm]
        case "follow":
            lock_out = float(full["longest_lock_out"])
            made = [recall, Goal("longest lock-out, swings", 5, lock_out), harm]
        case "unpoisoned":
            made = [recall]
        case "start":
            made = _start(full["start"])
        case "quiet":
            rate = full["judged"]["per_robot_hour"]
            made = [Goal("false alarms per robot-hour", ALARMS_PER_HOUR, rate), recall]
    if scenario.poisonous:
        made.append(Goal("contact ticks learned, share", 0.001, full["touching_share"]))
    if full["caught_swings"]:
        untold = 1.0 - full["caught_told"] / full["caught_swings"]
        made.append(Goal("caught swings not called ambiguous, share", 0.1, untold))
    return made


def pooled(table: Mapping[str, Tree]) -> Tree:
    """Figures and goals over several scenarios together, by the name of what is pooled.

    Returns:
        ``steady``: the false alarms of the full learner over all that is quiet of the hexapod;
        nothing while one of these scenarios is not in the table.
    """
    names = [s.name for s in scenarios().values() if s.expect == "quiet" and s.robot == HEXAPOD]
    if not set(names) <= table.keys():
        return {}
    judged = [table[name]["variants"]["full"]["judged"] for name in names]
    alarms = AlarmFigures.from_counts(
        sum(one["false_alarms"] for one in judged), sum(one["judged_ticks"] for one in judged)
    )
    what = "false alarms per robot-hour, all that is steady"
    steady = {
        "scenarios": names,
        "false_alarms": alarms.false_alarms,
        "robot_hours": alarms.judged_ticks / ROBOT_HOUR_TICKS,
        "per_robot_hour": alarms.per_hour,
        "per_robot_hour_interval": [v if math.isfinite(v) else None for v in alarms.interval],
        "goals": [Goal(what, ALARMS_PER_HOUR, alarms.per_hour).tree],
    }
    return {"steady": steady}


def _recover(full: Tree) -> list[Goal]:
    made = []
    several = len(full["recovery"]) > 1
    for mark, recovery in full["recovery"].items():
        of = f" ({mark})" if several else ""
        alarms = recovery["alarms_median"]
        made += [
            Goal(f"swings to recovery, median{of}", 10.0, recovery["swings_median"]),
            Goal(f"swings to recovery, p95{of}", 20.0, recovery["swings_p95"]),
            Goal(f"false alarms on the way, median{of}", 2.0, alarms),
        ]
    return made


def _start(start: Tree) -> list[Goal]:
    own, reference = start["when_valid"]["recall"], start["reference"]["recall"]
    lost = None if own is None or reference is None else 100.0 * (reference - own)
    return [
        Goal("swings until valid, p95", 60.0, start["swings_p95"]),
        Goal("recall lost once valid, points", RECALL_POINTS, lost),
        Goal("harm once valid", 0.0, float(start["harmful"])),
    ]


def measure(work: Work, chosen: Iterable[Scenario], sizes: Sizes) -> Tree:
    """Record and replay what is not kept of some scenarios, and judge them.

    Returns:
        Figures and goals of each, as a tree.

    Raises:
        SimulationDivergedError: the physics of a recording blew up.
    """
    chosen = list(chosen)
    wanted: dict[str, ReplaySpec] = {}
    for scenario in chosen:
        wanted |= {repr(spec): spec for spec in (*scenario.replays, *scenario.references)}
    found = work.each("recording and replaying", replayed, [*wanted.values()])
    made = dict(zip(wanted, found, strict=True))
    table = {}
    for scenario in chosen:
        runs, twins = (
            [made[repr(spec)] for spec in specs]
            for specs in (scenario.replays, scenario.references)
        )
        tree = figures(score_scenario(scenario, runs, twins))
        table[scenario.name] = tree | {"goals": [goal.tree for goal in goals(scenario, tree)]}
    return {
        "sizes": asdict(sizes),
        "learner": digest(*LEARNER),
        "simulator": digest(*SIMULATOR),
        "pooled": pooled(table),
        "scenarios": table,
    }


def read_results(path: Path) -> Tree:
    """Read a results file.

    Raises:
        ConfigurationError: there is none, or it holds something else.
    """
    try:
        tree: Tree = json.loads(path.read_text(encoding="utf-8"))
        if {"sizes", "learner", "simulator", "pooled", "scenarios"} <= tree.keys():
            return tree
        error: object = "another version"
    except (OSError, ValueError, AttributeError) as problem:
        error = problem
    raise ConfigurationError(
        f"{path}: no results there ({error}); run `adaptive-contact scenarios run --all`"
    )
