"""``adaptive-contact paper``: every experiment of the paper, and ours beside them."""

from __future__ import annotations

import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Final

import typer

from adaptive_contact.cli._options import ForceOption, option, refuse_to_replace
from adaptive_contact.cli._sim_options import SchedulerOption, needs_studies
from adaptive_contact.errors import ConfigurationError, MissingExtraError

_OUT: Final = Path("out/paper")
_DOCS: Final = Path("docs/paper.md")
_LOGS: Final = Path("../shared/data")


def paper(
    out: Annotated[Path, option("--out", "Where results go.", "DIR")] = _OUT,
    quick: Annotated[bool, option("--quick", "A few minutes: fewer legs, fewer hours.")] = False,
    workers: Annotated[int, option("--workers", "Processes, 0 for one per core.", min=0)] = 0,
    scheduler: SchedulerOption = None,
    seed: Annotated[int, option("--seed", "Of all streams.", min=0, max=90)] = 0,
    stage: Annotated[
        list[str] | None, option("--stage", "Only this stage; repeatable.", "NAME")
    ] = None,
    logs: Annotated[
        Path | None, option("--logs", "Recordings of real servos; skipped where absent.", "PATH")
    ] = _LOGS,
    docs: Annotated[
        Path | None, option("--docs", "Write the results as a document, too.", "FILE.md")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Run the paper's experiments in the simulator: figures, results.json, report.html.

    The same command goes on in its folder, and makes the pages there, and docs/paper.md, again.
    """
    refuse_to_replace([docs] if docs else [], "--docs", force=force or docs == _DOCS)
    with needs_studies():
        from adaptive_contact_studies.paper.plan import FULL, QUICK
        from adaptive_contact_studies.paper.run import STAGES, run_paper
        from adaptive_contact_studies.workers import on_cluster

        for needed in ("matplotlib", "jinja2"):  # said before hours of work, not after
            if find_spec(needed) is None:
                raise MissingExtraError("the report", "studies")
    import dataclasses

    from threadpoolctl import threadpool_limits

    from adaptive_contact.cli._console import table_console
    from adaptive_contact_studies.paper.tables import write_document

    unknown = [name for name in stage or () if name not in STAGES]
    if unknown:
        raise ConfigurationError(f"no stage '{unknown[0]}'; stages are {', '.join(STAGES)}")
    plan = dataclasses.replace(QUICK if quick else FULL, seed=seed)
    stages = [name for name in STAGES if not stage or name in stage]
    console = table_console()
    options: dict[str, list[object]] = {
        "--out": [out] if out != _OUT else [],
        "--seed": [seed] if seed else [],
        "--workers": [workers] if workers else [],
        "--scheduler": [scheduler] if scheduler else [],
        "--stage": [*(stage or ())],
        "--logs": [logs] if logs is not None and logs != _LOGS else [],
        "--docs": [docs] if docs is not None else [],
    }
    try:
        # Matrices this small only wait for each other in threads.
        with threadpool_limits(1), on_cluster(scheduler, out):
            results = run_paper(
                out.resolve() if scheduler else out,
                plan,
                workers=workers,
                stages=stages,
                logs=logs,
                console=console,
                command=_command(quick, options),
            )
    except KeyboardInterrupt:
        console.print("\ninterrupted; the same command goes on from here")
        raise typer.Exit(130) from None
    if docs is not None:
        write_document(results, docs, docs.parent / "pictures")
        console.print(f"wrote {docs}")
    console.print(f"wrote {out / 'report.html'}, {out / 'results.json'}, {out / 'figures'}/")


def _command(quick: bool, options: dict[str, list[object]]) -> str:
    """What was typed, as it can be typed again: all options that are not left as they are."""
    words = ["adaptive-contact", "paper", *(["--quick"] if quick else [])]
    for name, values in options.items():
        for value in values:
            words += [name, str(value)]
    return shlex.join(words)
