"""``adaptive-contact paper``: every experiment of the paper, and ours beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli._sim_options import needs_simulator
from adaptive_contact.errors import ConfigurationError

__all__ = ["paper"]


def paper(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where results go.")] = Path(
        "out/paper"
    ),
    quick: Annotated[
        bool, typer.Option("--quick", help="A few minutes: fewer legs, fewer hours.")
    ] = False,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Processes, 0 for one per core.")
    ] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, max=90, help="Of all streams.")] = 0,
    stage: Annotated[
        list[str] | None,
        typer.Option("--stage", metavar="NAME", help="Only this stage; repeatable."),
    ] = None,
    logs: Annotated[
        Path | None,
        typer.Option(
            "--logs", metavar="PATH", help="Recordings of real servos; skipped where absent."
        ),
    ] = Path("../shared/data"),
    docs: Annotated[
        Path | None,
        typer.Option("--docs", metavar="FILE.md", help="Write the results as a document, too."),
    ] = None,
) -> None:
    """Run the paper's experiments in the simulator: figures, results.json, report.html."""
    with needs_simulator():
        from adaptive_contact_sim.experiments.plan import FULL, QUICK
        from adaptive_contact_sim.experiments.run import STAGES, run_paper
    import dataclasses

    from rich.console import Console

    from adaptive_contact_sim.experiments.report import write_document

    unknown = [name for name in stage or () if name not in STAGES]
    if unknown:
        raise ConfigurationError(f"no stage '{unknown[0]}'; stages are {', '.join(STAGES)}")
    plan = dataclasses.replace(QUICK if quick else FULL, seed=seed)
    stages = [name for name in STAGES if not stage or name in stage]
    console = Console()
    try:
        results = run_paper(out, plan, workers=workers, stages=stages, logs=logs, console=console)
    except KeyboardInterrupt:
        console.print("\ninterrupted; the same command goes on from here")
        raise typer.Exit(130) from None
    if docs is not None:
        write_document(results, docs, docs.parent / "pictures")
        console.print(f"wrote {docs}")
    console.print(f"wrote {out / 'report.html'}, {out / 'results.json'}, {out / 'figures'}/")
