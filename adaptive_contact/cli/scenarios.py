"""Defines ``adaptive-contact scenarios``: how the learner follows a leg that changes."""

from __future__ import annotations

import dataclasses
import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.table import Table

from adaptive_contact.cli._console import print_markdown, table_console
from adaptive_contact.cli._options import (
    ForceOption,
    JsonOption,
    ProcessesOption,
    option,
    refuse_to_replace,
)
from adaptive_contact.cli._output import print_json, print_line
from adaptive_contact.cli._sim_options import needs_studies
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import write_file

app = typer.Typer(
    help="Drifts, contacts and faults, replayed through the learner and simpler ones.",
    no_args_is_help=True,
)

OutOption = Annotated[Path, option("--out", "What is kept, and results.json.", "FOLDER")]
DEFAULT_OUT = Path("out/scenarios")
_DOCS = Path("docs")
RESULTS = "results.json"


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
                "expect": s.expect,
                "leg_runs": s.leg_runs,
                "simulated_s": s.seconds,
                "variants": list(s.variants),
            }
            for s in known
        ]
        print_json(jsonlib.dumps(rows, indent=2))
        return

    console = table_console()
    table = Table(
        *("scenario", "what happens", "motion", "leg-runs", "minutes"),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for s in known:
        minutes = f"{s.seconds / 60:.0f}"
        table.add_row(s.name, s.about, s.motion, str(s.leg_runs), minutes)
    console.print(table)
    console.print(
        "`scenarios run NAME…` measures some, `scenarios run --all` all of them (two hours on two "
        "fast cores), `--quick` looks whether everything runs.",
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
    quick: Annotated[
        bool, option("--quick", "Short recordings, two leg-runs: does it all run?")
    ] = False,
    processes: ProcessesOption = 2,
    out: OutOption = DEFAULT_OUT,
    json: JsonOption = False,
) -> None:
    """Record what is missing, replay it through every learner, and judge.

    What was made is kept and never made again: after Ctrl-C, the same command goes on where it
    stopped, and ends with the same numbers.
    """
    with needs_studies():
        from adaptive_contact_studies.scenarios.registry import named, scenarios
        from adaptive_contact_studies.scenarios.report import table
        from adaptive_contact_studies.scenarios.results import measure
        from adaptive_contact_studies.scenarios.runs import FULL_SIZES, QUICK_SIZES
        from adaptive_contact_studies.work import Work

    if not names and not everything:
        raise ConfigurationError(
            "no scenario given; name some (`adaptive-contact scenarios list`), or give --all"
        )
    if names and everything:
        raise ConfigurationError(f"'{names[0]}' and --all: all are run anyway; give names or --all")
    sizes = QUICK_SIZES if quick else FULL_SIZES
    sizes = dataclasses.replace(sizes, leg_runs=seeds or sizes.leg_runs)
    chosen = named(names or scenarios(), sizes)
    tree = measure(Work(out, processes, shown=True), chosen, sizes)
    text = jsonlib.dumps(tree, indent=1, allow_nan=False) + "\n"
    write_file(out / RESULTS, text, advice="give another folder with --out")
    if json:
        print_json(jsonlib.dumps(tree, indent=2))
    else:
        print_markdown(table(tree))
    print_line(f"figures in {out / RESULTS}", err=True)


@app.command()
def report(
    out: OutOption = DEFAULT_OUT,
    docs: Annotated[Path, option("--docs", "Where adaptation.md goes.", "FOLDER")] = _DOCS,
    force: ForceOption = False,
) -> None:
    """Write docs/adaptation.md, of what `scenarios run` measured last.

    The page in docs is replaced; one in another folder only with --force.
    """
    refuse_to_replace([docs / "adaptation.md"], "--docs", force=force or docs == _DOCS)
    with needs_studies():
        from adaptive_contact_studies.scenarios.report import write_report
        from adaptive_contact_studies.scenarios.results import read_results

    print_line(str(write_report(read_results(out / RESULTS), docs)))
