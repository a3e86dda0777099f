"""Defines ``adaptive-contact paper``: every experiment of the paper, and ours beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from adaptive_contact.cli._options import ForceOption, option, refuse_to_replace
from adaptive_contact.cli._output import print_line
from adaptive_contact.cli._sim_options import needs_studies


def paper(
    out: Annotated[Path, option("--out", "Where results go.", "DIR")] = Path("out/paper"),
    quick: Annotated[bool, option("--quick", "A few minutes: fewer legs, fewer hours.")] = False,
    workers: Annotated[int, option("--workers", "Processes, 0 for one per core.", min=0)] = 0,
    seed: Annotated[int, option("--seed", "Seed of all streams.", min=0, max=90)] = 0,
    docs: Annotated[
        Path | None, option("--docs", "Write the page and its pictures here, too.", "FILE.md")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Run the paper's experiments in the simulator: results.json, paper.md and its pictures.

    The same command goes on in its folder, and makes the page there, and docs/paper.md, again.
    """
    refuse_to_replace(
        [docs] if docs else [], "--docs", force=force or docs == Path("docs/paper.md")
    )
    with needs_studies():
        from adaptive_contact_studies.paper.plan import FULL, QUICK
        from adaptive_contact_studies.paper.report import write_document, write_report
        from adaptive_contact_studies.paper.run import run_paper
        from adaptive_contact_studies.work import Work
    import dataclasses
    import os

    plan = dataclasses.replace(QUICK if quick else FULL, seed=seed)
    results = run_paper(Work(out, workers or os.cpu_count() or 1, shown=True), plan)
    write_report(results, out)
    if docs is not None:
        write_document(results, docs)
    print_line(f"wrote {docs or out / 'paper.md'} and {out / 'results.json'}")
