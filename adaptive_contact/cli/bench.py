"""Defines ``adaptive-contact bench``: reproduces the headline figures and the speeds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from rich.table import Table

from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import (
    BaselineOption,
    ForceOption,
    JsonOption,
    ProcessesOption,
    option,
    refuse_to_replace,
)
from adaptive_contact.cli._output import print_json
from adaptive_contact.cli._sim_options import needs_studies
from adaptive_contact.files import write_file
from adaptive_contact.robot import shipped_robot

if TYPE_CHECKING:
    from adaptive_contact.score import Summary

_OUT: Final = Path("out/bench")


def bench(
    out: Annotated[Path, option("--out", "Where bench.json goes.", "FOLDER")] = _OUT,
    baseline: BaselineOption = None,
    speeds_only: Annotated[
        bool, option("--speeds", "Leave the headline runs out (minutes of work).")
    ] = False,
    quick: Annotated[
        bool, option("--quick", "A fiftieth of all work: does it all run?  No figures to keep.")
    ] = False,
    processes: ProcessesOption = 2,
    force: ForceOption = False,
    json: JsonOption = False,
) -> None:
    """Measure recall, latency and false alarms on unseen runs, and how fast everything is.

    The figures in out/bench are replaced; those in another folder only with --force.
    """
    refuse_to_replace([out / "bench.json"], "--out", force=force or out == _OUT)
    import msgspec

    from adaptive_contact.model.model_file import load_baseline, shipped_baseline
    from adaptive_contact.score.tables import summary_json, summary_table

    with needs_studies():
        from adaptive_contact_sim import SimulationSettings, TerrainSettings, WalkSettings
        from adaptive_contact_sim.arrays import record_arrays
        from adaptive_contact_studies.headline import HEADLINE_RUNS, run_headline
        from adaptive_contact_studies.speed import tick_speed
        from adaptive_contact_studies.work import Work

    robot = shipped_robot()
    known = shipped_baseline(robot.name) if baseline is None else load_baseline(baseline)
    assert known is not None  # the hexapod's ships
    console = table_console(stderr=True)
    part = 0.02 if quick else 1.0
    rows: dict[str, Summary] = {}
    work = Work(out, processes, shown=True)
    if not speeds_only:
        runs = [run._replace(seconds=part * run.seconds) for run in HEADLINE_RUNS]
        rows = run_headline(robot, known, work, runs)
    console.print("measuring speeds")
    # The walk of the speeds is no row of the table; any seed would do.
    settings = SimulationSettings(
        motion=WalkSettings(), terrain=TerrainSettings(kind="rough"), seed=2900
    )
    run = record_arrays(settings, max(120.0 * part, 10.0))
    tick = tick_speed(run, robot, known)
    result = {
        "rows": {name: summary_json(summary) for name, summary in rows.items()},
        "six_leg_tick": tick,
        "baseline": known.origin,
    }
    text = msgspec.json.format(msgspec.json.encode(result), indent=2)
    write_file(out / "bench.json", text + b"\n", advice="give another --out")
    if json:
        print_json(text.decode())
        return
    shown = table_console()
    for name, summary in rows.items():
        shown.print(f"\n{name}: the default detector, on runs it has not seen", style="bold")
        shown.print(summary_table(summary))
    speeds = Table(title="Speeds", show_header=False)
    speeds.add_row(
        "six-leg tick",
        f"median {tick.median_ms:.3f} ms, p99 {tick.p99_ms:.3f} ms, up to its last event "
        f"{tick.event_ms:.3f} ms",
    )
    speeds.add_row("learners", f"{tick.leg_ticks_per_s:.0f} leg-ticks per second of one core")
    shown.print(speeds)
    console.print(f"figures in {out / 'bench.json'}")
