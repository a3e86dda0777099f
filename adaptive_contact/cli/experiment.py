"""``adaptive-contact experiment``: single experiments on data of one's own."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli._options import Commands, JsonOption
from adaptive_contact.cli._output import say_json
from adaptive_contact.cli._sim_options import needs_studies

app = Commands(help="Single experiments on data of one's own.", no_args_is_help=True)


@app.callback()
def _experiments() -> None:
    """Keep ``logs`` a command of its own while it is the only one."""


@app.command()
def logs(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="Recording (.npz or .json), or a folder of them.",
            show_default=False,
        ),
    ],
    json: JsonOption = False,
) -> None:
    """Fit and test the libraries on recordings of real servos."""
    with needs_studies():
        from adaptive_contact_studies.paper.logs import run_logs
    from adaptive_contact_studies.paper.report import markdown
    from adaptive_contact_studies.paper.run import plain

    tree = plain(run_logs(path))
    if json:
        say_json(jsonlib.dumps(tree, indent=2))
        return
    from adaptive_contact.cli._console import print_markdown

    print_markdown(markdown("logs.md", data=tree))
