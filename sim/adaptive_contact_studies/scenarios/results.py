"""The results file: figures and goals of every scenario that was run, and what they belong to."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, NamedTuple

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file
from adaptive_contact_studies.scenarios.figures import Judgement, figures
from adaptive_contact_studies.scenarios.goals import goals, pooled
from adaptive_contact_studies.scenarios.learners import reference_baseline
from adaptive_contact_studies.scenarios.recording import simulator_fingerprint
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.replay import learner_fingerprint
from adaptive_contact_studies.scenarios.runner import FULL, RESULTS
from adaptive_contact_studies.scenarios.runs import Sizes

__all__ = [
    "VERSION",
    "Belongs",
    "belongs",
    "best_form",
    "form_of",
    "merge",
    "read_results",
    "refuse_to_lose",
    "results",
    "write_results",
]

Tree = dict[str, Any]

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
    """What figures made now belong to.

    Args:
        sizes: they are made with.
        size: what those are called: ``full``, ``brief`` or ``quick``.
    """
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
    """The name of a form: of its size, with the number of leg-runs where that is not the usual.

    Args:
        size: ``full``, ``brief`` or ``quick``.
        sizes: that go by this name.
        leg_runs: asked for, None for the usual.
    """
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
        **belongs(sizes, size)._asdict(),
        "problems": list(problems),
        "pooled": pooled(table),
        "scenarios": table,
    }


def merge(new: Tree, path: Path) -> Tree:
    """New figures, with those of other scenarios that a file already has.

    Raises:
        ConfigurationError: what the file has is of another learner, simulator or size, and not
            all of it was made anew.
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

    Args:
        path: of the file with the old ones; there may be none.
        made: what the new ones belong to.
        names: scenarios that are made anew.

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
