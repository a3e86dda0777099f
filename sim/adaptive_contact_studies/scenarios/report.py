"""Figures as people read them; a table on the terminal and one in the report say the same.

``docs/adaptation.md``, written from the results: every number in it comes from the JSON.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from rich.table import Table

from adaptive_contact.diagnose.change_classifier import KINDS
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import cannot_write, write_file
from adaptive_contact_studies.scenarios.judge import NOTHING
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.runner import Folders
from adaptive_contact_studies.scenarios.runs import FULL_SIZES, walks_without_change
from adaptive_contact_studies.scenarios.spec import Variant

__all__ = [
    "SUMMARY",
    "alarms",
    "leg_runs",
    "percent",
    "rate",
    "report_text",
    "results_table",
    "swings",
    "write_report",
]

Tree = dict[str, Any]

_HEADS: Final = (
    *("leg-runs", "recall before", "after", "false alarms before", "after"),
    *("recovery", "on the way", "lock-out", "contact learned %", "goals"),
)


def alarms(count: int) -> str:
    """So many false alarms."""
    return f"{count} false alarm{'' if count == 1 else 's'}"


def leg_runs(tree: Tree) -> str:
    """Such as ``20``, or ``19 of 20; 1 diverged``: what is behind the figures of a scenario."""
    there, asked = tree["leg_runs"], tree["leg_runs_asked"]
    return str(there) if there == asked else f"{there} of {asked}; {asked - there} diverged"


def percent(value: float | None, digits: int = 1) -> str:
    """Such as ``99.2``; a dash for nothing."""
    return "–" if value is None else f"{100.0 * value:.{digits}f}"


def plain_number(value: float | None) -> str:
    """With as many digits as it is worth; ``never`` for a count that was never reached."""
    if value is None:
        return "never"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"


def rate(summary: Tree) -> str:
    """False alarms per robot-hour, such as ``3.1``."""
    value = summary["per_robot_hour"]
    return "–" if value is None else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def swings(recovery: Tree | None) -> str:
    """Swings to recovery, median and 95th percentile, such as ``2 / 5``."""
    if recovery is None:
        return "–"
    median, p95 = recovery["swings_median"], recovery["swings_p95"]
    return f"{plain_number(median)} / {plain_number(p95)}"


def phases_around(tree: Tree, variant: str) -> tuple[Tree, Tree]:
    """Figures of the first phase, and of those a scenario is judged by."""
    own = tree["variants"][variant]
    first = next(iter(tree["phases"]))
    return own["phases"][first], own["judged"]


def results_table(results: Tree) -> Table:
    """All scenarios, the full learner against the frozen one."""
    table = Table(
        title="The full learner, and the frozen one in grey; recall in %, false alarms per "
        "robot-hour",
        title_justify="left",
        caption="\n".join(_together(pool) for pool in results["pooled"].values()) or None,
        caption_justify="left",
        pad_edge=False,
    )
    table.add_column("scenario", no_wrap=True)
    for head in _HEADS:
        table.add_column(head, justify="right")
    for name, tree in results["scenarios"].items():
        full, frozen = tree["variants"]["full"], tree["variants"]["frozen"]
        before, after = phases_around(tree, "full")
        _, grey = phases_around(tree, "frozen")
        recovery = next(iter(full["recovery"].values()), None)
        met = [goal["met"] for goal in tree["goals"]]
        verdict = f"{sum(met)}/{len(met)}"
        table.add_row(
            name,
            leg_runs(tree),
            percent(before["recall"]),
            f"{percent(after['recall'])} [dim]{percent(grey['recall'])}[/]",
            rate(before),
            f"{rate(after)} [dim]{rate(grey)}[/]",
            swings(recovery),
            "–" if recovery is None else plain_number(recovery["alarms_median"]),
            f"{full['longest_lock_out']} [dim]{frozen['longest_lock_out']}[/]",
            percent(full["touching_share"], 2),
            f"[green]{verdict}[/]" if all(met) else f"[red]{verdict}[/]",
        )
    return table


def _together(pool: Tree) -> str:
    """What several scenarios are held to together, in a line."""
    met = all(goal["met"] for goal in pool["goals"])
    return (
        f"{' + '.join(pool['scenarios'])}: {alarms(pool['false_alarms'])} in "
        f"{pool['robot_hours']:.1f} robot-hours, {rate(pool)} per hour: "
        f"{'met' if met else 'not met'}"
    )


_ADVICE: Final = "give another folder with --docs"

SUMMARY: Final = "summary"
# How a page is called among the pictures of the documentation.
PICTURE: Final = "adaptation-{name}.png"

_INTRODUCTION: Final = """\
# Following the leg

What the learner does when a leg changes while it works, measured: steps of every kind the
simulator knows, slow changes, contacts and nothing but contacts, a leg that stands, a foot that is
caught, bad readings, missing and wrong baselines, and hours in which nothing changes.
This page is written by `adaptive-contact scenarios report` from the figures of
`adaptive-contact scenarios run --all` (`make scenarios`); nothing in it is typed by hand.
"""

_SMALL: Final = {
    "brief": """\
**These are figures of the short form (`scenarios run --all --brief`)**: {leg_runs} leg-runs, half
a minute around a step, ramps over one minute instead of ten, 60 swings in contact instead of 500,
minutes without change instead of ten robot-hours. Ramps are thus ten times as steep as they should
be, and a false alarm more or less moves a rate by hundreds per robot-hour. `make scenarios` makes
the full form, two hours on two idle cores.
""",
    "quick": """\
**These are figures of a quick look (`--quick`): short recordings, few leg-runs. They show that
everything runs, and prove nothing.**
""",
}

_WHY: Final = """\
What stands in the way of each, and what was tried, is in
[decision 13](decisions/0013-what-is-missed-and-why.md).
"""

_KINDS: Final = """\
Leg-runs by the kind of change that the status reported last (`drift.kind`): rubbing is `friction`;
supply, winding and compliance are `drive`; mud is `load`. Backlash, slipped horns and lost readings
have no kind. No kind is reported of a leg that was never found changed, or while no kind explains
enough and more than the others.
"""

_METHOD: Final = """\
## How it is measured

Every recording is simulated once and replayed through five learners side by side:

| learner | what it does |
|---|---|
| `frozen` | the baseline, never updated |
| `ungated` | recursive least squares over every tick, contacts and all |
| `refit` | gated; sparse refits only, no recursion |
| `rls` | gated; recursion only, no refits |
| `full` | the product |

- Events are judged as in [scoring.md](scoring.md). Recall is that of the counted rows, with its
  95 % Clopper–Pearson interval; false alarms are per robot-hour (540,000 judged ticks), with
  their 95 % Poisson interval.
- *Before* is the first phase of a scenario, *after* the phases it is judged by: for a step, from
  the 21st swing after it on. For scenarios without a change it is all of the recording.
- *Recall lost* is against the frozen learner, with the shipped baseline, on the same recording
  without what the scenario does (same seeds, same motion, same noise); its interval is a bootstrap
  over recordings, as legs of one share a body.
- A change *counts* if it makes the frozen learner lose 5 points of recall, or raise ten times the
  false alarms; the others must do no harm. *Harm* is the same rule, applied to the full learner:
  against the frozen learner on the recording without the change, and against itself there, which
  raises far fewer false alarms in pose.
- *Recovery* is the number of swings of that leg after which 20 swings hold at most one error;
  *on the way* are the false alarms until then. Where every swing ends in contact the 20 swings
  need no free ones. "never": not before the recording ended.
- A *lock-out* is the longest run of swings with a missed touch or a false alarm, from the change
  on; swings that could not have shown a blind leg are passed over.
- A learner is *valid* after the first swing that begins 20 of which it says so, one after the
  other: a single ambiguous swing minutes later is not part of its start.
- *Contact learned* is the share of the ticks a learner took for free on which the leg touched
  anything between the sample before and this one, by the simulator's truth. A foot that is caught
  counts as touching for as long as it is held. The swings that a cold start makes its first
  model of are not in it: decision 14 has what these held.
- In pose the three legs of a tripod move in a run, each with its own trials and obstacles, while
  the robot stands on the other three; runs take turns between the tripods and the workspaces, and
  about half of the swings meet an obstacle. A foot is caught of a leg that moves alone. In a walk
  all six legs count, all change together, and every swing ends on the ground.
"""


def write_report(results: Tree, folders: Folders, docs: Path) -> Path:
    """Write the page, and put its pictures beside it.

    Args:
        results: all figures.
        folders: where the pictures are.
        docs: folder of the documentation.

    Returns:
        The path of the page.

    Raises:
        ConfigurationError: it cannot be written.
    """
    path, pictures = docs / "adaptation.md", docs / "pictures"
    shown = set()
    try:
        pictures.mkdir(parents=True, exist_ok=True)
        for name in (SUMMARY, *results["scenarios"]):
            page = folders.pages / f"{name}.png"
            if page.is_file():
                write_file(pictures / PICTURE.format(name=name), page.read_bytes(), advice=_ADVICE)
                shown.add(name)
        write_file(path, report_text(results, shown), advice=_ADVICE)
    except OSError as error:
        raise ConfigurationError(cannot_write(path, error, _ADVICE)) from error
    return path


def report_text(results: Tree, pictures: set[str]) -> str:
    """The page's text.

    Args:
        results: all figures.
        pictures: scenarios that have a page of plots; with :data:`SUMMARY` for the summary.
    """
    table = results["scenarios"]
    parts = [_INTRODUCTION]
    if results["size"] != "full":
        parts.append(_SMALL[results["size"]].format(leg_runs=results["leg_runs"]))
    parts += _lacking(results)
    parts += [_verdict(results), *_pooled(results["pooled"])]
    parts += [f"- {problem}\n" for problem in results["problems"]]
    if SUMMARY in pictures:
        parts.append(f"![Summary](pictures/{PICTURE.format(name=SUMMARY)})\n")
    parts += ["## The full learner\n", _full_table(table)]
    parts += [*_kinds_table(table), "## All learners\n", _variants_table(table)]
    parts += [_METHOD, "## Scenario by scenario\n"]
    parts += [_scenario(name, tree, name in pictures) for name, tree in table.items()]
    parts.append(
        "## Made with\n\n"
        f"Learner `{results['learner']}`, simulator `{results['simulator']}` (hashes of the "
        f"learner's source with the shipped baseline, and of the simulator's behaviour); at least "
        f"{results['leg_runs']} leg-runs behind every figure; seeds from 7000 on, which nothing "
        "was learned from or tuned on; one rule was seen on them first and then checked on others "
        "([decision 14](decisions/0014-what-a-first-model-is-made-of.md)).\n"
    )
    return "\n".join(parts)


def _lacking(results: Tree) -> list[str]:
    """What the full form would have besides, if these are figures of a part of it."""
    wanted = FULL_SIZES.leg_runs
    absent = [name for name in scenarios(FULL_SIZES) if name not in results["scenarios"]]
    words = []
    if results["size"] == "full" and results["leg_runs"] < wanted:
        words.append(f"{results['leg_runs']} leg-runs of each scenario instead of {wanted}")
    steady = results["scenarios"].get("steady-walk")
    walks = walks_without_change(FULL_SIZES)
    if results["size"] == "full" and steady is not None and steady["recordings"] < walks:
        words.append(f"{steady['recordings']} walks without a change instead of {walks}")
    if absent:
        words.append(f"not run: {', '.join(absent)}")
    if not words:
        return []
    return [f"**A part of it**: {'; '.join(words)}. `make scenarios` makes the whole.\n"]


def _verdict(results: Tree) -> str:
    table = results["scenarios"]
    goals = [(_link(name), goal) for name in table for goal in table[name]["goals"]]
    pools = results["pooled"].values()
    goals += [(_names(pool), goal) for pool in pools for goal in pool["goals"]]
    missed = [(name, goal) for name, goal in goals if not goal["met"]]
    text = f"{len(goals) - len(missed)} of {len(goals)} goals are met.\n"
    if not missed:
        return text
    rows = [
        f"| {name} | {goal['what']} | {plain_number(goal['limit'])} | "
        f"{plain_number(goal['measured'])} |"
        for name, goal in missed
    ]
    head = "| not met | figure of the full learner | at most | measured |\n|---|---|---|---|"
    return "\n".join([text, head, *rows, "", _WHY])


def _link(name: str) -> str:
    """To the scenario's heading; an anchor is lower case."""
    return f"[{name}](#{name.lower()})"


def _names(pool: Tree) -> str:
    return " + ".join(_link(name) for name in pool["scenarios"])


def _pooled(pools: Tree) -> list[str]:
    """What is asked of several scenarios together."""
    return [
        f"{_names(pool)} together: {alarms(pool['false_alarms'])} in "
        f"{pool['robot_hours']:.1f} robot-hours, {_alarms(pool)} per robot-hour "
        f"(at most {plain_number(pool['goals'][0]['limit'])}).\n"
        for pool in pools.values()
    ]


def _full_table(table: Tree) -> str:
    head = (
        "| scenario | leg-runs | counts | recall before | recall after | false alarms/h before "
        "| after | recovery, swings: median / p95 (of) | on the way: median / p95 "
        "| longest lock-out | contact learned | goals |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|"
    )
    rows = [head]
    for name, tree in table.items():
        full = tree["variants"][Variant.FULL.value]
        before, after = phases_around(tree, Variant.FULL.value)
        counts = {True: "yes", False: "no", None: "–"}[tree["counts_as_one_to_recover_from"]]
        met = [goal["met"] for goal in tree["goals"]]
        touching = full["touching_share"]
        rows.append(
            f"| {_link(name)} | {leg_runs(tree)} | {counts} | {_recall(before)} "
            f"| {_recall(after)} | {_alarms(before)} | {_alarms(after)} | {_recovery(tree, full)} "
            f"| {_on_the_way(full)} | {full['longest_lock_out']} "
            f"| {'–' if touching is None else f'{100 * touching:.2f} %'} "
            f"| {sum(met)} of {len(met)} |"
        )
    return "\n".join([*rows, ""])


def _kinds_table(table: Tree) -> list[str]:
    """What the full learner took changes for, if it reported any."""
    rows = []
    for name, tree in table.items():
        for mark, recovery in tree["variants"][Variant.FULL.value]["recovery"].items():
            taken = recovery["taken_for"]
            if set(taken) <= {NOTHING}:
                continue
            counts = " | ".join(str(taken.get(kind, 0)) for kind in (*KINDS, NOTHING))
            rows.append(f"| {_link(name)} | {mark} | {counts} |")
    if not rows:
        return []
    head = f"| scenario | after | {' | '.join(KINDS)} | no kind |"
    rule = "|---|---|" + "---|" * (len(KINDS) + 1)
    return ["## What changes were taken for\n", _KINDS, "\n".join([head, rule, *rows, ""])]


def _variants_table(table: Tree) -> str:
    names = [variant.value for variant in Variant]
    lines = [
        "Recall in %, after; false alarms per robot-hour, after; swings to recovery, median.\n",
        "| scenario | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for name, tree in table.items():
        cells = []
        for variant in names:
            own = tree["variants"].get(variant)
            if own is None:
                cells.append("–")
                continue
            recovery = next(iter(own["recovery"].values()), None)
            cell = f"{percent(own['judged']['recall'])}; {rate(own['judged'])}"
            if recovery is not None:
                cell += f"; {plain_number(recovery['swings_median'])}"
            cells.append(cell)
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _scenario(name: str, tree: Tree, picture: bool) -> str:
    full = tree["variants"][Variant.FULL.value]
    about = tree["about"]
    lines = [
        f"### {name}\n",
        f"{about[0].upper()}{about[1:]}. {_leg_runs(tree)} of {tree['recordings']} recordings, "
        f"{tree['simulated_s'] / 60:.0f} simulated minutes.",
    ]
    for goal in tree["goals"]:
        verdict = "met" if goal["met"] else "**not met**"
        lines.append(
            f"- {goal['what']}: {plain_number(goal['measured'])} "
            f"(at most {plain_number(goal['limit'])}): {verdict}"
        )
    lost, interval = full["recall_lost_points"], full["recall_lost_interval"]
    if lost is not None:
        low, high = interval
        lines.append(f"- recall lost: {lost:.2f} points (95 %: {low:.2f} to {high:.2f})")
    for mark, recovery in full["recovery"].items():
        lines.append(
            f"- after '{mark}': {recovery['recovered']} of {tree['leg_runs']} leg-runs recovered, "
            f"after {swings(recovery)} swings (median / p95)"
        )
    if full["touching_ticks_confirmed"]:
        lines.append(
            f"- contact learned: {full['touching_ticks_confirmed']} of {full['confirmed_ticks']} "
            f"ticks, {full['touching_since_before']} of them already in touch at the sample before"
        )
    if full["caught_swings"]:
        lines.append(
            f"- called ambiguous: {full['caught_told']} of {full['caught_swings']} swings while "
            "the foot was held, from the fifth on"
        )
    start = full.get("start")
    if start is not None:
        then = start["when_valid"]
        lines.append(
            f"- valid: {start['valid']} of {tree['leg_runs']} leg-runs, after "
            f"{plain_number(start['swings_median'])} swings (median), "
            f"{plain_number(start['swings_p95'])} (p95); from then on recall {_recall(then)} "
            f"against {_recall(start['full_reference'])} with its own baseline (frozen: "
            f"{_recall(start['reference'])}), false alarms per robot-hour {_alarms(then)} against "
            f"{_alarms(start['full_reference'])} (frozen: {_alarms(start['reference'])}); "
            f"{full['ever_doubted']} leg-runs called themselves other than valid at least once"
        )
    if picture:
        lines.append(f"\n![{name}](pictures/{PICTURE.format(name=name)})")
    return "\n".join([*lines, ""])


def _leg_runs(tree: Tree) -> str:
    count = f"{tree['leg_runs']} leg-runs"
    missing = tree["leg_runs_asked"] - tree["leg_runs"]
    if not missing:
        return count
    return f"{tree['leg_runs']} of {tree['leg_runs_asked']} leg-runs ({missing} diverged)"


def _recall(summary: Tree) -> str:
    if summary["recall"] is None:
        return "–"
    low, high = summary["recall_interval"]
    return f"{percent(summary['recall'])} % ({percent(low)}–{percent(high)})"


def _alarms(summary: Tree) -> str:
    low, high = summary["per_robot_hour_interval"]
    if high is None:
        return "–"
    digits = 1 if high < 100 else 0
    return f"{rate(summary)} ({low:.{digits}f}–{high:.{digits}f})"


def _recovery(tree: Tree, full: Tree) -> str:
    if not full["recovery"]:
        return "–"
    return "; ".join(
        f"{swings(r)} ({r['recovered']} of {tree['leg_runs']})" for r in full["recovery"].values()
    )


def _on_the_way(full: Tree) -> str:
    if not full["recovery"]:
        return "–"
    return "; ".join(
        f"{plain_number(r['alarms_median'])} / {plain_number(r['alarms_p95'])}"
        for r in full["recovery"].values()
    )
