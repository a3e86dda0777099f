"""Learns the family of legs into a file, or tries it on legs of which nothing is known.

``python -m adaptive_contact_studies.family learn FILE [FOLDER]``;
``python -m adaptive_contact_studies.family try FOLDER``; what each run gave is kept in FOLDER.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact_studies.family.prior import learn_family, save_family
from adaptive_contact_studies.family.trials import table, trials
from adaptive_contact_studies.work import Work

app = typer.Typer()


@app.command()
def learn(file: Path, folder: Annotated[Path, typer.Argument()] = Path("out/prior")) -> None:
    """Learn the family into a file."""
    family = learn_family(Work(folder, 2, shown=True))
    save_family(family, file)
    print(f"{file}: {family.origin}")


@app.command("try")
def try_(folder: Path) -> None:
    """Try it on legs of which nothing is known."""
    print(table(trials(Work(folder, 2, shown=True))))


if __name__ == "__main__":
    app()
