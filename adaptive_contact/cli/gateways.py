"""``adaptive-contact bridge ros2`` and ``bridge foxglove``: the robot in other programs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._bus import described_in, robot_of
from adaptive_contact.cli._options import option
from adaptive_contact.cli._output import make_stdout_optional, say, say_waiting
from adaptive_contact.errors import LinkError

if TYPE_CHECKING:
    from adaptive_contact.service.settings import Finding


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
    from adaptive_contact.priority import take_priority
    from adaptive_contact.ros2 import needs_rosbags
    from adaptive_contact.service.link import Link

    robot = robot_of(config)
    with needs_rosbags():
        from adaptive_contact.ros2.intake import check_mapped
        from adaptive_contact.service.ros2 import Gateway, shown_of_ros
    check_mapped(robot, described_in(config))
    settings = network.client(json=json)
    ros_settings = opt.Network(ros_connect, None, ros_zenoh_config).client()

    def waits_for_ros(finding: Finding) -> None:
        _say_ros(f"ROS 2: {shown_of_ros(finding)}; trying on")

    def waits(finding: Finding) -> None:
        _say_ros(f"the service: {finding.line}; trying on")

    refused = take_priority() if realtime else None
    if refused is not None:
        _say_ros(refused)
    try:
        with (
            Link.open(ros_settings, on_wait=waits_for_ros, stop=stop) as ros,
            Link.open(settings, on_wait=waits, stop=stop) as service,
        ):
            # Milliseconds since 1970: a later start has a larger run.
            gateway = Gateway(robot, service, ros, time.time_ns() // 1_000_000, _say_ros)
            reads = "reading nothing (no [leg.ros2])"
            if gateway.legs:
                reads = f"reading {', '.join(gateway.topics)} for legs {' '.join(gateway.legs)}"
            say(
                f"adaptive-contact bridge ros2: {reads}; publishing {gateway.publishes}; stop with "
                "Ctrl-C"
            )
            if gateway.legs and gateway.intake.unmapped:
                _say_ros(f"without [leg.ros2]: legs {' '.join(gateway.intake.unmapped)}")
            gateway.run(stop)
    except LinkError:
        if not stop.is_set():
            raise


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
    from adaptive_contact.service.foxglove_live import FoxgloveServer, check_installed
    from adaptive_contact.service.link import Link

    check_installed()
    settings = network.client()
    try:
        with (
            Link.open(settings, on_wait=say_waiting, stop=stop) as link,
            FoxgloveServer(link, host, port) as server,
        ):
            say(
                f"adaptive-contact bridge foxglove: open ws://{host}:{server.port} in Foxglove "
                f"(Open connection), or {server.app_url}; stop with Ctrl-C"
            )
            if host not in ("127.0.0.1", "localhost", "::1"):
                say(
                    "adaptive-contact bridge foxglove: everybody who can reach this address sees "
                    "everything; where others listen, leave --host out and use ssh -L",
                    err=True,
                )
            server.run(stop)
    except LinkError:
        if not stop.is_set():
            raise
        return
    for (key, why), count in server.left_out.most_common(8):
        say(
            f"adaptive-contact bridge foxglove: {count} messages on {key} not shown: {why}",
            err=True,
        )


def _say_ros(line: str) -> None:
    say(f"adaptive-contact bridge ros2: {line}", err=True)
