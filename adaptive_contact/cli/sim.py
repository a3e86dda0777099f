"""Defines ``adaptive-contact sim``: the simulated robot, and its baseline learned again."""

from __future__ import annotations

import dataclasses
import json as jsonlib
import time
from pathlib import Path
from typing import Annotated

import typer
from msgspec import to_builtins
from rich import box
from rich.table import Table

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._console import table_console
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import make_stdout_optional, print_json, print_line, print_waiting
from adaptive_contact.cli._sim_options import (
    ReactOption,
    RunOptions,
    given,
    needs_simulator,
    needs_studies,
)
from adaptive_contact.errors import ConfigurationError, LinkError
from adaptive_contact.files import write_file
from adaptive_contact.wire import SIM_DRIFT, Drift, DriftReply, Rejected, decode, encode


def baseline(
    out: opt.BaselineOutOption = Path("baseline.json"),
    robot: Annotated[
        str, option("--robot", "Which robot: hexapod, quadruped12, leg5.", "NAME")
    ] = "hexapod",
    processes: opt.ProcessesOption = 2,
    equations: opt.EquationsOption = False,
    force: opt.ForceOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Record a simulated robot and learn its baseline; the result depends on no clock."""
    opt.check_output(out, "--out", force=force)
    from threadpoolctl import threadpool_limits

    from adaptive_contact.cli.fit import print_training
    from adaptive_contact.model import save_baseline

    with needs_studies():
        from adaptive_contact_sim import simulated_robot
        from adaptive_contact_studies.training import learn_shipped
        from adaptive_contact_studies.work import Work

    description = simulated_robot(robot).description
    with threadpool_limits(1):
        work = Work(None, processes, shown=True)
        training = learn_shipped(robot, work, progress=lambda line: print_line(line, err=True))
    save_baseline(training.baseline, out)
    print_training(training, description, json=json, equations=equations)
    print_line(f"baseline written to {out}", err=True)


app = typer.Typer(help="The simulated robot: in pose, walking, drifting.", no_args_is_help=True)


@app.command()
@opt.flatten
def pose(
    *,
    leg: Annotated[
        str | None, option("--leg", "Which legs move. [hexapod rf, leg5 leg]", "LEG,...|all")
    ] = None,
    obstacles: Annotated[
        float | None, option("--obstacles", "Share of descents onto an obstacle. [0]")
    ] = None,
    soft: Annotated[float | None, option("--soft", "Share of obstacles that yield. [0]")] = None,
    approach: Annotated[
        str | None,
        option("--approach", "How legs approach obstacles.", "descent|slow|forward|graze"),
    ] = None,
    workspace: Annotated[
        str | None, option("--workspace", "Where legs move.", "paper|whole")
    ] = None,
    path: Annotated[
        str | None, option("--path", "In which coordinates paths are straight.", "cartesian|joint")
    ] = None,
    run: RunOptions,
    network: opt.Network,
    json: opt.JsonPayloadOption = False,
) -> None:
    """Stand and move one leg or several, in free air or onto obstacles (the paper's set-up)."""
    make_stdout_optional()
    stop = opt.stoppable()
    with needs_simulator():
        from adaptive_contact_sim import PoseSettings, simulated_robot

    changes = given(approach=approach, workspace=workspace, path=path)
    base, motion = run.base(PoseSettings)
    if leg is not None:
        layout = simulated_robot(base.settings.robot).layout
        changes["legs"] = layout.legs if leg == "all" else tuple(leg.split(","))
    changes["obstacles"] = dataclasses.replace(
        motion.obstacles, **given(probability=obstacles, soft=soft)
    )
    settings = dataclasses.replace(base.settings, motion=dataclasses.replace(motion, **changes))
    run.execute(base, settings, network, stop, json=json)


@app.command()
@opt.flatten
def walk(
    *,
    gait: Annotated[
        str | None, option("--gait", "tripod, ripple, wave; trot, walk of a quadruped.", "GAIT")
    ] = None,
    terrain: Annotated[
        str | None, option("--terrain", "The ground. [rough]", "flat|steps|rough|soft|holes")
    ] = None,
    stop_on: Annotated[
        str | None, option("--stop-on", "Who stops a descent. [truth]", "truth|service|never")
    ] = None,
    react_ms: ReactOption = None,
    raise_m: Annotated[
        float | None,
        option(
            "--raise-m",
            "Lift a leg that is reported to strike something by so much more, m; up to 0.05. [0]",
        ),
    ] = None,
    phase: Annotated[
        str | None,
        option(
            "--phase",
            "When `phase` turns to stance: at a touch, or as planned. [touch]",
            "touch|planned",
        ),
    ] = None,
    run: RunOptions,
    network: opt.Network,
    json: opt.JsonPayloadOption = False,
) -> None:
    """Walk over flat, stepped, rough or soft ground, or one with holes."""
    make_stdout_optional()
    stop = opt.stoppable()
    with needs_simulator():
        from adaptive_contact_sim import WalkSettings

    base, motion = run.base(WalkSettings, gait)
    changes = given(gait=gait, stop_on=stop_on, react_ms=react_ms, raise_m=raise_m, phase=phase)
    settings = dataclasses.replace(
        base.settings,
        motion=dataclasses.replace(motion, **changes),
        terrain=dataclasses.replace(base.settings.terrain, **given(kind=terrain)),
    )
    run.execute(base, settings, network, stop, json=json)


@app.command()
def compare(
    scenario: Annotated[
        str | None,
        option("--scenario", "Start from a shipped scenario or a file.", "NAME|FILE.toml"),
    ] = None,
    robot: Annotated[str | None, option("--robot", "hexapod, quadruped12. [hexapod]")] = None,
    gait: Annotated[str | None, option("--gait", "As of `sim walk`.", "GAIT")] = None,
    terrain: Annotated[
        str | None, option("--terrain", "The ground. [rough]", "flat|steps|rough|soft|holes")
    ] = None,
    seconds: Annotated[
        float, seconds_option("--seconds", "Of each walk", least=10.0, most=3600.0)
    ] = 120.0,
    drift: Annotated[
        list[str] | None,
        option(
            "--drift",
            "As of `sim walk`, without @TIME at half time; repeatable. [friction:value=4]",
            "SPEC",
        ),
    ] = None,
    seed: Annotated[int, option("--seed", "The first seed.", min=0)] = 1,
    seeds: Annotated[int, option("--seeds", "How many.", "N", min=1, max=100)] = 1,
    react_ms: ReactOption = None,
    picture: Annotated[Path | None, option("--picture", "Draw them.", "FILE.png")] = None,
    processes: opt.ProcessesOption = 2,
    out: Annotated[Path, option("--out", "Where walks are kept.", "FOLDER")] = Path("out/compare"),
    force: opt.ForceOption = False,
    json: opt.JsonOption = False,
) -> None:
    """Walk the same ground with and without contacts, before and after a drift.

    Five ways to end a swing: a trajectory planned to the expected ground; a gait that reaches below
    it and is never stopped; that gait, stopped by the service's events, by those of a model that
    never learns, and by a perfect sensor.  After Ctrl-C, the same command goes on.
    """
    opt.check_output(picture, "--picture", force=force)
    if picture is not None and picture.suffix.lower() != ".png":
        raise ConfigurationError(f"--picture {picture}: expected a name that ends with .png")
    with needs_studies():
        from adaptive_contact.cli import _sim_compare as shown
        from adaptive_contact_sim import WalkSettings, parse_drift, simulated_robot
        from adaptive_contact_studies import blind
        from adaptive_contact_studies.work import Work

    base, motion = RunOptions(scenario=scenario, robot=robot).base(WalkSettings, gait)
    settings = base.settings
    layout = simulated_robot(settings.robot).layout
    given_drift = drift or ([] if settings.drift else ["friction:value=4"])
    drifts = [
        parse_drift(text if "@" in text else f"{text}@{seconds / 2:g}s", layout)
        for text in given_drift
    ]
    walks = dataclasses.replace(motion, **given(gait=gait, react_ms=react_ms))
    settings = dataclasses.replace(
        settings,
        motion=walks,
        terrain=dataclasses.replace(settings.terrain, **given(kind=terrain)),
        drift=settings.drift + tuple(drifts),
    )
    begins_s = min(injection.at_s for injection in settings.drift)
    if not 2.0 <= begins_s <= seconds - 2.0:
        raise ConfigurationError(
            f"a drift begins at {begins_s:g} s of walks of {seconds:g} s; expected 2 s and more on "
            "either side of it"
        )
    work = Work(out, processes, shown=True)
    found = blind.compare(work, settings, seconds, range(seed, seed + seeds))
    if picture is not None:
        write_file(picture, shown.picture(found), advice="give another --picture")
    if json:
        walked = {
            "robot": settings.robot,
            "gait": walks.gait,
            "terrain": settings.terrain.kind,
            "seeds": [*range(seed, seed + seeds)],
            "drift": [{**to_builtins(one.drift), "at_s": one.at_s} for one in settings.drift],
        }
        print_json(jsonlib.dumps(walked | shown.tree(found), indent=2))
    else:
        table_console().print(shown.table(found))


@app.command()
@opt.flatten
def inject(
    kind: Annotated[
        str | None,
        typer.Argument(
            metavar="KIND", help="Kind of drift (`sim list`); without it, print what is in force."
        ),
    ] = None,
    value: Annotated[float | None, option("--value", "Absolute, in the kind's unit.")] = None,
    *,
    leg: Annotated[str, option("--leg", metavar="LEG|all")] = "all",
    joint: Annotated[str, option("--joint", metavar="JOINT|all")] = "all",
    shape: Annotated[str, option("--shape", metavar="step|ramp|pulse|walk")] = "step",
    duration: Annotated[float, seconds_option("--duration", "Of a shape.")] = 0.0,
    seed: Annotated[int, option("--seed", "Seed of a random walk.", min=0)] = 0,
    network: opt.Network,
    json: opt.JsonOption = False,
) -> None:
    """Let something drift in a running simulator, and print what now holds."""
    from adaptive_contact.service.link import Link

    drift: Drift | None = None
    if kind is not None:
        if shape != "step" and duration == 0.0:
            raise ConfigurationError(f"a {shape} needs a duration above 0 s; give --duration S")
        with needs_simulator():
            from adaptive_contact_sim import drift_from
        fields = given(kind=kind, value=value, leg=leg, joint=joint, shape=shape)
        fields |= {"duration_s": duration, "seed": seed}
        drift = drift_from(fields, where=f"drift '{kind}'", layout=None).drift
    with Link.open(network.client(wait=False), on_wait=print_waiting) as link:
        replies = link.query(SIM_DRIFT, drift)
    if not replies:
        raise LinkError(
            f"no simulator answers on {SIM_DRIFT}; start `adaptive-contact sim walk`, or check "
            "--connect and --namespace"
        )
    answer = decode(replies[0].payload, DriftReply, replies[0].encoding)
    if isinstance(answer, Rejected):
        raise LinkError(f"the simulator's answer cannot be read: {answer.detail}")
    if not answer.ok:
        raise ConfigurationError(f"the simulator refused: {answer.error}")
    if json:
        print_json(encode(answer, "application/json").decode())
        return
    clock = time.strftime("%H:%M:%S", time.localtime(answer.t_ns / 1e9))
    print_line(f"in force at {clock}:" + ("" if answer.holds else " nothing drifts"))
    for name, legs in answer.holds.items():
        for one, joints in legs.items():
            values = "  ".join(f"{j} {v:g}" for j, v in joints.items())
            print_line(f"  {name:11} {one}  {values}")


@app.command("list")
def list_(json: opt.JsonOption = False) -> None:
    """Show the shipped scenarios, and the kinds of drift with their ranges."""
    with needs_simulator():
        from adaptive_contact_sim import KINDS, describe, shipped_scenarios

    scenarios = shipped_scenarios()
    if json:
        table = {
            "scenarios": {
                s.name: {"about": s.about, "seconds": s.seconds, "run": describe(s.settings)}
                for s in scenarios.values()
            },
            "drift": {name: kind._asdict() for name, kind in KINDS.items()},
        }
        print_json(jsonlib.dumps(table, indent=2))
        return

    console = table_console()
    shown = Table("scenario", "about", "seconds", box=box.SIMPLE_HEAD, pad_edge=False)
    for scenario in scenarios.values():
        seconds = "" if scenario.seconds is None else f"{scenario.seconds:g}"
        shown.add_row(scenario.name, scenario.about, seconds)
    console.print(shown)
    kinds = Table(
        *("drift", "unit", "nominal", "accepted", "usual", "meaning"),
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for name, kind in KINDS.items():
        accepted = f"{kind.low:g} to {kind.high:g}"
        kinds.add_row(name, kind.unit, f"{kind.nominal:g}", accepted, kind.usual, kind.meaning)
    console.print(kinds)
    console.print("Values are absolute against nominal.")
    console.print("Shapes: step, ramp, pulse, walk; all but a step take a --duration.")


app.command("baseline")(baseline)
