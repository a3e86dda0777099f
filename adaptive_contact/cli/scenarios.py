"""``adaptive-contact scenarios``: what the learner does when a leg changes, measured."""

from __future__ import annotations

import dataclasses
import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from adaptive_contact.cli._options import (
    Commands,
    ForceOption,
    JsonOption,
    ProcessesOption,
    option,
    refuse_to_replace,
)
from adaptive_contact.cli._output import say, say_json
from adaptive_contact.cli._sim_options import SchedulerOption, needs_studies
from adaptive_contact.errors import ConfigurationError, MissingExtraError

if TYPE_CHECKING:
    from rich.console import Console

    from adaptive_contact_studies.scenarios.judge import Judgement
    from adaptive_contact_studies.scenarios.runner import Done, Folders, Job

app = Commands(
    help="Drifts, contacts and trouble, replayed through the learner and lesser ones.",
    no_args_is_help=True,
)

OutOption = Annotated[Path, option("--out", "Recordings, replays, figures and pages.", "FOLDER")]
DEFAULT_OUT = Path("out/scenarios")
_DOCS = Path("docs")
# How a command ends that Ctrl-C stopped, as shells have it.
INTERRUPTED = 130


@app.command("list")
def list_(json: JsonOption = False) -> None:
    """Show all scenarios: their names, what happens, how much is simulated."""
    with needs_studies():
        from adaptive_contact_studies.scenarios.registry import scenarios

    known = scenarios().values()
    if json:
        rows = [
            {
                "name": s.name,
                "about": s.about,
                "motion": s.motion,
                "expect": s.expect.value,
                "leg_runs": len(s.leg_runs),
                "simulated_s": s.seconds,
                "variants": [v.value for v in s.variants],
            }
            for s in known
        ]
        say_json(jsonlib.dumps(rows, indent=2))
        return
    from rich import box
    from rich.table import Table

    from adaptive_contact.cli._console import table_console

    console = table_console()
    table = Table(
        *("scenario", "what happens", "motion", "leg-runs", "minutes"),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for s in known:
        minutes = f"{s.seconds / 60:.0f}"
        table.add_row(s.name, s.about, s.motion, str(len(s.leg_runs)), minutes)
    console.print(table)
    console.print(
        "`scenarios run NAME…` measures some, `scenarios run --all` all of them (two hours on two "
        "fast cores), `--goals` in half the time what the learner is held to, `--quick` looks "
        "whether everything runs.",
        highlight=False,
    )


@app.command()
def run(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Which (`scenarios list`).")
    ] = None,
    everything: Annotated[bool, option("--all", "All of them.")] = False,
    seeds: Annotated[
        int | None, option("--seeds", "Leg-runs of each. [20]", "N", min=1, max=200)
    ] = None,
    steady_walks: Annotated[
        int | None,
        option(
            "--steady-walks",
            "Walks in which nothing changes; a third of the work is theirs. [60: 10 hours]",
            "N",
            min=1,
            max=600,
        ),
    ] = None,
    quick: Annotated[
        bool, option("--quick", "Short recordings, two leg-runs: does it all run?")
    ] = False,
    brief: Annotated[
        bool, option("--brief", "Short recordings, six leg-runs: half an hour.")
    ] = False,
    only_goals: Annotated[
        bool,
        option("--goals", "The frozen and the full learner only: all goals, in half the time."),
    ] = False,
    processes: ProcessesOption = 2,
    scheduler: SchedulerOption = None,
    pages: Annotated[bool, option("--pages/--no-pages", "Draw plots.")] = True,
    out: OutOption = DEFAULT_OUT,
    json: JsonOption = False,
) -> None:
    """Record what is missing, replay it through every learner, judge, and draw.

    With --goals the learners between the frozen and the full one are left out; the figures are kept
    apart, as `report` compares them all.

    What was made is kept and never made again: after Ctrl-C, the same command goes on where it
    stopped, and ends with the same numbers.
    """
    with needs_studies():
        from adaptive_contact_studies.scenarios.judge import judge_scenario
        from adaptive_contact_studies.scenarios.registry import named, scenarios
        from adaptive_contact_studies.scenarios.report import results_table
        from adaptive_contact_studies.scenarios.results import (
            belongs,
            form_of,
            merge,
            refuse_to_lose,
            results,
            write_results,
        )
        from adaptive_contact_studies.scenarios.runner import Folders, jobs
        from adaptive_contact_studies.scenarios.runs import BRIEF_SIZES, FULL_SIZES, QUICK_SIZES
        from adaptive_contact_studies.scenarios.spec import GOALS_VARIANTS
        from adaptive_contact_studies.workers import on_cluster

    from adaptive_contact.cli._console import table_console

    if not names and not everything:
        raise ConfigurationError(
            "no scenario given; name some (`adaptive-contact scenarios list`), or give --all"
        )
    if quick and brief:
        raise ConfigurationError("--quick and --brief are two forms; give one of them")
    size = "quick" if quick else "brief" if brief else "full"
    sizes = {"quick": QUICK_SIZES, "brief": BRIEF_SIZES, "full": FULL_SIZES}[size]
    form = form_of(size, sizes, seeds)
    if seeds is not None:
        sizes = dataclasses.replace(sizes, leg_runs=seeds)
    if steady_walks is not None:
        sizes = dataclasses.replace(sizes, steady_walks=steady_walks / sizes.leg_runs)
    chosen = named(names or (), sizes)
    if everything:
        if chosen:
            raise ConfigurationError(
                f"'{chosen[0].name}' and --all: all are run anyway; give names or --all"
            )
        chosen = list(scenarios(sizes).values())
    if only_goals:
        form = f"goals-{form}"
        chosen = [dataclasses.replace(s, variants=GOALS_VARIANTS) for s in chosen]
    console = table_console(stderr=True)
    folders = Folders.of(out.resolve() if scheduler else out, form)
    try:
        # Said before the hours of work, not after.
        refuse_to_lose(folders.results, belongs(sizes, size), [s.name for s in chosen])
        with on_cluster(scheduler, out):
            problems = _work(jobs(chosen, folders), folders, processes, console)
        judgements = [judge_scenario(scenario, folders) for scenario in chosen]
        empty = [j.scenario.name for j in judgements if not j.leg_runs]
        if empty:
            why = problems[0] if problems else "run the same command again"
            raise ConfigurationError(f"no leg-run of {', '.join(empty)} came about: {why}")
        tree = results(judgements, sizes, size=size, problems=problems)
        whole = merge(tree, folders.results)
        write_results(whole, folders.results)
        if pages:
            _draw(judgements, whole, folders, console)
    except KeyboardInterrupt:
        console.print("interrupted; the same command goes on from here")
        raise typer.Exit(INTERRUPTED) from None
    for problem in problems:
        console.print(problem, style="yellow")
    if json:
        say_json(jsonlib.dumps(tree, indent=2))
    else:
        table_console(pipe_width=160, markup=True).print(results_table(tree))
    console.print(f"figures in {folders.results}, pages in {folders.pages}")


@app.command()
def report(
    out: OutOption = DEFAULT_OUT,
    docs: Annotated[Path, option("--docs", "Where adaptation.md goes.", "FOLDER")] = _DOCS,
    force: ForceOption = False,
) -> None:
    """Write docs/adaptation.md, with its pictures: of the full form, where there are figures of it.

    Forms are never mixed: each has figures and pictures of its own.  The page in docs is replaced;
    one in another folder only with --force.
    """
    refuse_to_replace([docs / "adaptation.md"], "--docs", force=force or docs == _DOCS)
    with needs_studies():
        from adaptive_contact_studies.scenarios.report import write_report
        from adaptive_contact_studies.scenarios.results import best_form, read_results
        from adaptive_contact_studies.scenarios.runner import FULL, Folders

    form = best_form(out)
    folders = Folders.of(out, form)
    if form != FULL:
        say(f"no figures of the full form in {out}; these are of '{form}'", err=True)
    say(str(write_report(read_results(folders.results), folders, docs)))


def _work(work: list[Job], folders: Folders, processes: int, console: Console) -> list[str]:
    from adaptive_contact_studies.scenarios.runner import run as run_jobs
    from adaptive_contact_studies.show.progress import progress

    if not work:
        return []
    simulated_s = 0.0
    with progress(console, "recording and replaying", sum(job.work for job in work)) as advance:

        def step(done: Done) -> None:
            nonlocal simulated_s
            simulated_s += done.job.recording.seconds
            advance(done.job.work, f"{simulated_s / 60:.0f} min simulated")

        return run_jobs(work, folders, processes=processes, progress=step)


def _draw(
    judgements: list[Judgement], tree: dict[str, Any], folders: Folders, console: Console
) -> None:
    """Draw the pages, or say why there are none."""
    from adaptive_contact_studies.scenarios.pages import draw_page, draw_summary
    from adaptive_contact_studies.scenarios.report import SUMMARY

    try:
        with console.status("drawing"):
            for judgement in judgements:
                draw_page(judgement, folders, folders.pages / f"{judgement.scenario.name}.png")
            draw_summary(tree, folders.pages / f"{SUMMARY}.png")
    except MissingExtraError as error:
        console.print(error, style="yellow")
