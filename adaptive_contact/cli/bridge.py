"""Defines ``adaptive-contact bridge``: servos on Zenoh, real and virtual; ROS 2; Foxglove."""

from __future__ import annotations

import math
import multiprocessing
import threading
import time
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._bus import BaudOption, DeviceOption, described_in, plans_of, shake_hands
from adaptive_contact.cli._link import enable_realtime, open_link, unless_stopped
from adaptive_contact.cli._options import option, seconds_option
from adaptive_contact.cli._output import make_stdout_optional, print_line
from adaptive_contact.cli._sim_options import needs_simulator
from adaptive_contact.errors import needs

if TYPE_CHECKING:
    from adaptive_contact.service.link import LinkSettings


@opt.flatten
def ros2(
    *,
    config: opt.ConfigOption = None,
    ros_connect: Annotated[
        list[str] | None,
        option(
            "--ros-connect",
            "Router of ROS 2, rmw_zenohd (default tcp/127.0.0.1:7447); repeatable.",
            "ENDPOINT",
            panel="Network",
        ),
    ] = None,
    ros_zenoh_config: Annotated[
        Path | None,
        option(
            "--ros-zenoh-config",
            "Zenoh configuration file (JSON5) for that router.",
            "FILE",
            panel="Network",
        ),
    ] = None,
    realtime: opt.RealtimeOption = False,
    network: opt.Network,
    json: opt.JsonPayloadOption = False,
) -> None:
    """Relay joint states of ROS 2 (rmw_zenoh) to the service, and contacts back; no ROS needed."""
    make_stdout_optional()
    stop = opt.stoppable()
    from adaptive_contact.service.link import Link

    robot = opt.described_robot(config)
    with needs("ROS 2", "ros2", "rosbags", "numpy"):
        from adaptive_contact.ros2.intake import check_mapped
        from adaptive_contact.service.ros2 import Gateway, shown_of_ros
    check_mapped(robot, described_in(config))
    settings = network.client(json=json)
    ros_settings = opt.Network(ros_connect, None, ros_zenoh_config).client()

    enable_realtime(realtime)
    with (
        unless_stopped(stop),
        Link.open(
            ros_settings,
            on_wait=lambda finding: _print_ros_line(f"ROS 2: {shown_of_ros(finding)}; trying on"),
            stop=stop,
        ) as ros,
        Link.open(
            settings,
            on_wait=lambda finding: _print_ros_line(f"the service: {finding.line}; trying on"),
            stop=stop,
        ) as service,
    ):
        # Milliseconds since 1970: a later start has a larger run.
        gateway = Gateway(robot, service, ros, time.time_ns() // 1_000_000, _print_ros_line)
        reads, legs = "reading nothing (no [leg.ros2])", gateway.intake.legs
        if legs:
            reads = f"reading {', '.join(gateway.topics)} for legs {' '.join(legs)}"
        print_line(
            f"adaptive-contact bridge ros2: {reads}; publishing {gateway.publishes}; stop with "
            "Ctrl-C"
        )
        if legs and gateway.intake.unmapped:
            _print_ros_line(f"without [leg.ros2]: legs {' '.join(gateway.intake.unmapped)}")
        gateway.run(stop)


@opt.flatten
def foxglove(
    *,
    host: Annotated[str, option("--host", "Where Foxglove connects to.", "ADDRESS")] = "127.0.0.1",
    port: Annotated[int, option("--port", "0 takes a free one.", "N", min=0, max=65_535)] = 8765,
    network: opt.Network,
) -> None:
    """Show the running robot in Foxglove, over its websocket protocol."""
    make_stdout_optional()
    stop = opt.stoppable()
    from adaptive_contact.service.foxglove_live import FoxgloveServer

    settings = network.client()
    with (
        open_link(settings, stop) as link,
        FoxgloveServer(link, host, port) as server,
    ):
        print_line(
            f"adaptive-contact bridge foxglove: open ws://{host}:{server.port} in Foxglove "
            f"(Open connection), or {server.app_url}; stop with Ctrl-C"
        )
        if host not in ("127.0.0.1", "localhost", "::1"):
            print_line(
                "adaptive-contact bridge foxglove: everybody who can reach this address sees "
                "everything; where others listen, leave --host out and use ssh -L",
                err=True,
            )
        server.run(stop)
    for (key, why), count in server.left_out.most_common(8):
        print_line(
            f"adaptive-contact bridge foxglove: {count} messages on {key} not shown: {why}",
            err=True,
        )


def _print_ros_line(line: str) -> None:
    print_line(f"adaptive-contact bridge ros2: {line}", err=True)


app = typer.Typer(help="Servos on Zenoh, real and virtual; ROS 2; Foxglove.", no_args_is_help=True)


@app.command()
@opt.flatten
def dynamixel(
    *,
    config: opt.ConfigOption = None,
    drive: Annotated[
        bool,
        option(
            "--drive",
            "Write the goals that arrive on robot/leg/*/command.  Without it the bridge only "
            "reads, and another controller moves the robot.",
        ),
    ] = False,
    configure: Annotated[
        bool,
        option(
            "--configure",
            "Set return delays to 0, and let servos answer that answer pings only (status "
            "return level 2), in the servos' EEPROM.",
        ),
    ] = False,
    realtime: opt.RealtimeOption = False,
    device: DeviceOption = None,
    baud: BaudOption = None,
    network: opt.Network,
    json: opt.JsonPayloadOption = False,
) -> None:
    """Publish Dynamixel or Feetech servos' positions and goals, a process per port."""
    make_stdout_optional()
    stop = opt.stoppable()
    plans = plans_of(opt.described_robot(config), config, device, baud)
    settings = network.client(json=json)
    shake_hands(plans, "adaptive-contact bridge", configure=configure, drive=drive)
    _run_ports(plans, "drive" if drive else "observe", settings, stop, realtime=realtime)


def _run_ports(
    plans: tuple[PortPlan, ...],
    mode: Literal["observe", "drive"],
    settings: LinkSettings,
    stop: threading.Event,
    *,
    realtime: bool,
) -> None:
    """Run a process per port; one that dies is started again."""
    from adaptive_contact.cli._bridge_worker import run_port

    context = multiprocessing.get_context("spawn")

    def started(turn: int, plan: PortPlan) -> SpawnProcess:
        # A run of its own: ``seq`` begins at 0 again, and within a run that is a duplicate.
        run = time.time_ns() // 1_000_000
        given = (plan, mode, settings, run, realtime, turn / len(plans))  # ports take turns
        worker = context.Process(target=run_port, args=given, name=f"bridge-{plan.name}")
        worker.start()
        return worker

    workers = [started(turn, plan) for turn, plan in enumerate(plans)]
    servos = sum(len(plan.joints) for plan in plans)
    legs = " ".join(leg.id for plan in plans for leg in plan.legs)
    print_line(
        f"adaptive-contact bridge: {'driving' if mode == 'drive' else 'observing'} {servos} servos "
        f"on {len(plans)} ports, legs {legs}; publishing robot/leg/*/servo; stop with Ctrl-C"
    )
    try:
        while not stop.wait(0.2):
            for turn, plan in enumerate(plans):
                if workers[turn].is_alive():
                    continue
                print_line(
                    f"adaptive-contact bridge: port {plan.name}: its process ended "
                    f"({workers[turn].exitcode}); starting it again",
                    err=True,
                )
                if not stop.wait(1.0):
                    workers[turn] = started(turn, plan)
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join(3.0)
            worker.kill()
            worker.join()


@app.command()
def virtual(
    *,
    directory: Annotated[Path, option("--dir", "Where the ports appear, as links.", "DIR")] = Path(
        "bus"
    ),
    config: opt.ConfigOption = None,
    servos: Annotated[
        str | None, option("--servos", "All servos are of this model, such as STS3215.", "MODEL")
    ] = None,
    ports: Annotated[
        int | None,
        option("--ports", "Ports of a robot that has none described; 1 by default.", min=1),
    ] = None,
    write_config: Annotated[
        Path | None, option("--write-config", "Write the robot.toml of this bus.", "FILE")
    ] = None,
    scenario: Annotated[
        str | None,
        option(
            "--scenario",
            "The robot moves by itself, as in `sim`; without it, it hangs on a stand and "
            "does what the bus says.",
            "NAME",
        ),
    ] = None,
    height: Annotated[float, option("--height", "Height of the body over the floor, m.")] = 1.0,
    fault: Annotated[
        list[str] | None,
        option(
            "--fault",
            "What goes wrong: silent, late, flip, stale, error, hangup, such as "
            "silent:id=3@5+2 (servo 3, from 5 s, for 2 s); repeatable.",
            "SPEC",
        ),
    ] = None,
    wire_time: Annotated[
        bool, option("--wire-time/--no-wire-time", "Packets take time on the wire.")
    ] = True,
    realtime: opt.RealtimeOption = False,
    seed: opt.SeedOption = 0,
    seconds: Annotated[
        float | None, seconds_option("--seconds", "Stop after so long; otherwise at Ctrl-C.")
    ] = None,
    record: Annotated[
        Path | None,
        option("--record", "Record a scenario's own samples and truth.", "FILE.mcap"),
    ] = None,
    force: opt.ForceOption = False,
) -> None:
    """Serve a bus on pseudo-terminals whose servos are the simulated robot."""
    make_stdout_optional()
    stop = opt.stoppable()
    opt.check_output(write_config, "--write-config", [config], force=force)
    opt.check_output(record, "--record", [config, write_config], force=force)
    with needs_simulator():
        from adaptive_contact_sim.virtual import parse_fault
        from adaptive_contact_sim.virtual.assembly import with_servos
        from adaptive_contact_sim.virtual.session import run
    robot = opt.described_robot(config)
    enable_realtime(realtime)
    run(
        robot if servos is None else with_servos(robot, servos),
        directory,
        stop,
        ports=ports,
        faults=[parse_fault(text) for text in fault or ()],
        wire_time=wire_time,
        scenario=scenario,
        height_m=height,
        seed=seed,
        seconds=math.inf if seconds is None else seconds,
        record=record,
        write_config=write_config,
        on_start=lambda line: print_line(f"adaptive-contact bridge virtual: {line}"),
    )


app.command("feetech")(dynamixel)  # one bridge: the ports say whose servos theirs are
app.command()(ros2)
app.command()(foxglove)
