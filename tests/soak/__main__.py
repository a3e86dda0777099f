"""``PYTHONPATH=tests python -m soak [--minutes M] [--out FOLDER] [--seed N]``."""

from __future__ import annotations

import shutil
import signal
import sys
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from adaptive_contact.files import write_file
from adaptive_contact.robot import shipped_robot

from .conduct import SoakPlan, conduct
from .verdict import judge


def soak(
    minutes: Annotated[
        float, typer.Option(min=1.0, max=24 * 60.0, help="Of walking, in real time.")
    ] = 30.0,
    out: Annotated[Path, typer.Option(metavar="FOLDER")] = Path("out/soak"),
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Walk for a long time, break everything once, and see that nothing was lost."""
    plan = SoakPlan(out, minutes, seed)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))
    shutil.rmtree(out / "state", ignore_errors=True)  # a soak begins with the shipped baseline
    out.mkdir(parents=True, exist_ok=True)
    take = conduct(plan)
    typer.echo(take.simulator)
    found, failures = judge(take, plan, shipped_robot())
    text = msgspec.json.format(msgspec.json.encode(found), indent=2)
    write_file(out / "soak.json", text + b"\n")
    del found["resident"]  # in the file alone: a row for every two seconds
    typer.echo(msgspec.json.format(msgspec.json.encode(found), indent=1))
    for line in failures:
        typer.echo(f"NOT WELL: {line}")
    if failures:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(soak)
