"""The results file: figures and goals of every scenario that was run, and what they belong to."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim.trials.figures import Judgement, figures
from adaptive_contact_sim.trials.goals import goals
from adaptive_contact_sim.trials.learners import reference_baseline
from adaptive_contact_sim.trials.recording import simulator_fingerprint
from adaptive_contact_sim.trials.registry import scenarios
from adaptive_contact_sim.trials.replay import learner_fingerprint
from adaptive_contact_sim.trials.runs import Sizes

__all__ = ["VERSION", "merge", "read_results", "results", "write_results"]

Tree = dict[str, Any]

VERSION: Final = 1
# What has to agree for figures to stand in one table.
_BELONGS: Final = ("v", "size", "leg_runs", "learner", "simulator", "baseline")


def results(
    judgements: Sequence[Judgement], sizes: Sizes, *, size: str, problems: Sequence[str] = ()
) -> Tree:
    """The tree of some scenarios' figures.

    Args:
        judgements: of the scenarios.
        sizes: they were made with.
        size: what those are called: ``full``, ``brief`` or ``quick``.
        problems: runs that have no recording, one line each.
    """
    table = {}
    for judgement in judgements:
        tree = figures(judgement)
        made = goals(judgement.scenario, tree)
        tree["goals"] = [asdict(goal) | {"met": goal.met} for goal in made]
        table[judgement.scenario.name] = tree
    return {
        "v": VERSION,
        "size": size,
        "leg_runs": sizes.leg_runs,
        "learner": learner_fingerprint(),
        "simulator": simulator_fingerprint(),
        "baseline": reference_baseline().origin,
        "problems": list(problems),
        "scenarios": table,
    }


def merge(new: Tree, path: Path) -> Tree:
    """New figures, with those of other scenarios that a file already has.

    Figures of another learner, simulator or size are left out: one table, one learner.
    """
    try:
        old = read_results(path)
    except ConfigurationError:
        return new
    if any(old.get(name) != new[name] for name in _BELONGS):
        return new
    both = old["scenarios"] | new["scenarios"]
    order = [name for name in scenarios() if name in both]
    problems = sorted({*old["problems"], *new["problems"]})
    return new | {"problems": problems, "scenarios": {name: both[name] for name in order}}


def write_results(tree: Tree, path: Path) -> None:
    """Write a results file, whole or not at all.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        part.replace(path)
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be written ({error.strerror}); give another folder with --out"
        ) from error


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
