"""What the full learner is held to, and whether it is met.

The results file: figures and goals of every scenario that was run, and what they belong to.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact.robot import ROBOT_HOUR_TICKS
from adaptive_contact.score.summary import AlarmFigures
from adaptive_contact_studies.scenarios.judge import LOCK_OUT_SWINGS, Judgement, figures
from adaptive_contact_studies.scenarios.learners import HEXAPOD, reference_baseline
from adaptive_contact_studies.scenarios.recording import simulator_fingerprint
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.replay import learner_fingerprint
from adaptive_contact_studies.scenarios.runner import FULL, RESULTS
from adaptive_contact_studies.scenarios.runs import Sizes
from adaptive_contact_studies.scenarios.spec import Expect, Scenario, Variant

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
    """A figure, and what it should be at most."""

    what: str  # of the full learner, with its unit
    limit: float  # that it should not exceed
    # None for one that is not finite: a leg that never recovered, for instance
    measured: float | None

    @property
    def met(self) -> bool:
        """Whether it is."""
        return self.measured is not None and self.measured <= self.limit


def goals(scenario: Scenario, tree: Tree) -> list[Goal]:
    """The goals of a scenario, from its figures."""
    full = tree["variants"][Variant.FULL.value]
    recall = Goal("recall lost, points", RECALL_POINTS, full["recall_lost_points"])
    harm = Goal("harm", 0.0, float(full["harmful"]))
    match scenario.expect:
        case Expect.RECOVER if tree["counts_as_one_to_recover_from"]:
            made = [*_recover(full), recall, harm]
        case Expect.RECOVER | Expect.UNHARMED:
            made = [recall, harm]
        case Expect.FOLLOW:
            lock_out = float(full["longest_lock_out"])
            made = [recall, Goal("longest lock-out, swings", LOCK_OUT_SWINGS, lock_out), harm]
        case Expect.UNPOISONED:
            made = [recall]
        case Expect.START:
            made = _start(full["start"])
        case Expect.QUIET:
            rate = full["judged"]["per_robot_hour"]
            made = [Goal("false alarms per robot-hour", ALARMS_PER_HOUR, rate), recall]
    if scenario.poisonous:
        made.append(Goal("contact ticks learned, share", TOUCHING_SHARE, full["touching_share"]))
    if full["caught_swings"]:
        untold = 1.0 - full["caught_told"] / full["caught_swings"]
        made.append(Goal("caught swings not called ambiguous, share", CAUGHT_UNTOLD, untold))
    return made


def pooled(table: Mapping[str, Tree]) -> Tree:
    """Figures and goals over several scenarios together, by the name of what is pooled.

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
    alarms = AlarmFigures.of(
        sum(one["false_alarms"] for one in judged), sum(one["judged_ticks"] for one in judged)
    )
    what = "false alarms per robot-hour, all that is steady"
    goal = Goal(what, ALARMS_PER_HOUR, alarms.per_hour)
    steady = {
        "scenarios": names,
        "false_alarms": alarms.false_alarms,
        "robot_hours": alarms.judged_ticks / ROBOT_HOUR_TICKS,
        "per_robot_hour": alarms.per_hour,
        "per_robot_hour_interval": [v if math.isfinite(v) else None for v in alarms.interval],
        "goals": [asdict(goal) | {"met": goal.met}],
    }
    return {"steady": steady}


def _recover(full: Tree) -> list[Goal]:
    made = []
    several = len(full["recovery"]) > 1
    for mark, recovery in full["recovery"].items():
        of = f" ({mark})" if several else ""
        alarms = recovery["alarms_median"]
        made += [
            Goal(f"swings to recovery, median{of}", RECOVERY_MEDIAN, recovery["swings_median"]),
            Goal(f"swings to recovery, p95{of}", RECOVERY_P95, recovery["swings_p95"]),
            Goal(f"false alarms on the way, median{of}", ALARMS_ON_THE_WAY, alarms),
        ]
    return made


def _start(start: Tree) -> list[Goal]:
    own, reference = start["when_valid"]["recall"], start["reference"]["recall"]
    lost = None if own is None or reference is None else 100.0 * (reference - own)
    return [
        Goal("swings until valid, p95", VALID_SWINGS, start["swings_p95"]),
        Goal("recall lost once valid, points", RECALL_POINTS, lost),
        Goal("harm once valid", 0.0, float(start["harmful"])),
    ]


VERSION: Final = 3
_SIZES: Final = (FULL, "brief", "quick")


class Belongs(NamedTuple):
    """What has to agree for figures to stand in one table."""

    v: int
    size: str
    leg_runs: int
    sizes: dict[str, float]
    learner: str
    simulator: str
    baseline: str


def belongs(sizes: Sizes, size: str) -> Belongs:
    """What figures made now belong to."""
    return Belongs(
        VERSION,
        size,
        sizes.leg_runs,
        asdict(sizes),
        learner_fingerprint(),
        simulator_fingerprint(),
        reference_baseline().origin,
    )


def form_of(size: str, sizes: Sizes, leg_runs: int | None) -> str:
    """The name of a form: of its size, with the number of leg-runs where that is not the usual."""
    return size if leg_runs in (None, sizes.leg_runs) else f"{size}-{leg_runs}"


def best_form(out: Path) -> str:
    """The form to publish of those that a folder has figures of: the full one before any other."""
    before, after = RESULTS.split("{form}")
    names = [path.name for path in out.glob(RESULTS.format(form="*"))]
    forms = [name.removeprefix(before).removesuffix(after) for name in names]
    ranked = [(rank, form) for form in forms if (rank := _rank(form)) is not None]
    return min(ranked)[1] if ranked else FULL


def results(
    judgements: Sequence[Judgement], sizes: Sizes, *, size: str, problems: Sequence[str] = ()
) -> Tree:
    """The tree of some scenarios' figures."""
    table = {}
    for judgement in judgements:
        tree = figures(judgement)
        made = goals(judgement.scenario, tree)
        tree["goals"] = [asdict(goal) | {"met": goal.met} for goal in made]
        table[judgement.scenario.name] = tree
    return {
        **belongs(sizes, size)._asdict(),
        "problems": list(problems),
        "pooled": pooled(table),
        "scenarios": table,
    }


def merge(new: Tree, path: Path) -> Tree:
    """New figures, with those of other scenarios that a file already has.

    Raises:
        ConfigurationError: what the file has is of another learner, simulator or size, and not
            all of it was made again.
    """
    made = Belongs(**{name: new[name] for name in Belongs._fields})
    refuse_to_lose(path, made, new["scenarios"])
    try:
        old = read_results(path)
    except ConfigurationError:
        return new
    if _others(old, made):
        return new
    both = old["scenarios"] | new["scenarios"]
    table = {name: both[name] for name in scenarios() if name in both}
    problems = sorted({*old["problems"], *new["problems"]})
    return new | {"problems": problems, "pooled": pooled(table), "scenarios": table}


def refuse_to_lose(path: Path, made: Belongs, names: Collection[str]) -> None:
    """Look whether new figures would push out old ones: one table, one learner.

    Raises:
        ConfigurationError: they would.
    """
    try:
        old = read_results(path)
    except ConfigurationError:
        return
    lost = [name for name in old["scenarios"] if name not in names]
    other = _others(old, made)
    if lost and other:
        raise ConfigurationError(
            f"{path}: holds {len(lost)} other scenarios ('{lost[0]}' first) of another "
            f"{' and '.join(other)}, and one table is of one; run --all, or move that file away"
        )


def write_results(tree: Tree, path: Path) -> None:
    """Write a results file, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    text = json.dumps(tree, indent=1, allow_nan=False) + "\n"
    write_file(path, text, advice="give another folder with --out")


def read_results(path: Path) -> Tree:
    """Read a results file.

    Raises:
        ConfigurationError: there is none, or it is of another version.
    """
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{path}: no results there ({error}); run `adaptive-contact scenarios run --all`"
        ) from error
    if not isinstance(tree, dict) or tree.get("v") != VERSION:
        raise ConfigurationError(
            f"{path}: not results of this version; run `adaptive-contact scenarios run --all`"
        )
    return tree


def _others(old: Tree, made: Belongs) -> list[str]:
    """In what old figures differ from new ones."""
    return [name for name, value in made._asdict().items() if old.get(name) != value]


def _rank(form: str) -> tuple[int, int] | None:
    """Where a form stands, the first being the best; None for what is no form."""
    size, _, leg_runs = form.partition("-")
    if size not in _SIZES or (leg_runs and not leg_runs.isdecimal()):
        return None
    return _SIZES.index(size), -int(leg_runs) if leg_runs else -sys.maxsize
