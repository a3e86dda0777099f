"""``adaptive-contact sim baseline``: learn a shipped baseline again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from adaptive_contact.cli._options import JsonOption, option
from adaptive_contact.cli._output import say
from adaptive_contact.cli._sim_options import SchedulerOption, needs_studies


def baseline(
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Where the baseline goes (JSON).")
    ] = Path("baseline.json"),
    robot: Annotated[
        str, option("--robot", "Which robot: hexapod, quadruped12, leg5. [hexapod]", "NAME")
    ] = "hexapod",
    processes: Annotated[
        int, option("--processes", "Runs simulated at a time.", min=1, max=64)
    ] = 2,
    scheduler: SchedulerOption = None,
    json: JsonOption = False,
) -> None:
    """Record a simulated robot and learn its baseline; the result depends on no clock."""
    from threadpoolctl import threadpool_limits

    from adaptive_contact.cli.fit import print_training
    from adaptive_contact.model import save_baseline

    with needs_studies():
        from adaptive_contact_sim import simulated_robot
        from adaptive_contact_studies.training import learn_shipped
        from adaptive_contact_studies.workers import on_cluster

    description = simulated_robot(robot).description
    with threadpool_limits(1), on_cluster(scheduler, None):
        training = learn_shipped(
            robot, processes=processes, progress=lambda line: say(line, err=True)
        )
    save_baseline(training.baseline, out)
    print_training(training, description, json=json)
    say(f"baseline written to {out}", err=True)
