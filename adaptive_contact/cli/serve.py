"""Defines ``adaptive-contact serve``: the service."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from adaptive_contact import __version__
from adaptive_contact.cli import _options as opt
from adaptive_contact.cli._compiling import compile_in_view, compile_tick, first_start
from adaptive_contact.cli._link import enable_realtime, open_link
from adaptive_contact.cli._options import option
from adaptive_contact.cli._output import make_stdout_optional, print_line
from adaptive_contact.core.learn.mode import WhenAmbiguous
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import Robot
from adaptive_contact.service.settings import DEFAULT_ENDPOINT, shown

if TYPE_CHECKING:
    from adaptive_contact.model import Baseline
    from adaptive_contact.service.link import Link
    from adaptive_contact.service.state.keeper import StateKeeper


@opt.flatten
def serve(
    *,
    config: opt.ConfigOption = None,
    baseline: opt.BaselineOption = None,
    state: opt.StateOption = None,
    no_state: Annotated[
        bool, option("--no-state", "Neither restore nor keep what is learned.")
    ] = False,
    listen: Annotated[
        list[str] | None,
        option(
            "--listen",
            f"Where the embedded router listens (default {DEFAULT_ENDPOINT}); port 0 takes a free "
            "one; repeatable.",
            "ENDPOINT",
            panel=opt.NETWORK,
        ),
    ] = None,
    network: opt.Network,
    insecure: Annotated[
        bool,
        option(
            "--insecure",
            "Listen beyond loopback without authentication of clients.",
            panel=opt.NETWORK,
        ),
    ] = False,
    max_sessions: Annotated[
        int | None,
        option(
            "--max-sessions",
            "Sessions that the embedded router takes at once (default 256, or what "
            "--zenoh-config says); others are refused.",
            "N",
            min=2,
            max=10_000,
            panel=opt.NETWORK,
        ),
    ] = None,
    described_only: Annotated[
        bool,
        option(
            "--described-only",
            "Take no samples of legs that the robot's description lacks; beyond loopback, always.",
            panel=opt.NETWORK,
        ),
    ] = False,
    realtime: opt.RealtimeOption = False,
    when_ambiguous: opt.AmbiguousOption = WhenAmbiguous.WITHHOLD,
    json: opt.JsonPayloadOption = False,
    log_json: Annotated[
        bool, option("--log-json", "Log one JSON object per line.", panel="Logging")
    ] = False,
    log_level: Annotated[
        Literal["debug", "info", "warning", "error"],
        option("--log-level", "Lowest level that is logged.", panel="Logging"),
    ] = "info",
) -> None:
    """Turn servo samples into contact events, over Zenoh.

    Embeds a router on loopback; with --connect alone it joins another one instead.
    """
    make_stdout_optional()
    # Before anything that takes time, so that a stop during the start is clean too.
    stop = opt.stoppable()

    if no_state and state is not None:
        raise ConfigurationError("--state and --no-state contradict each other; give one of them")
    from threadpoolctl import threadpool_limits

    from adaptive_contact.core.bank import LearnerBank
    from adaptive_contact.service.link import router_settings
    from adaptive_contact.service.logs import LogThrottle, configure_logs
    from adaptive_contact.service.refits import ProcessRefitter
    from adaptive_contact.service.server import Service, Sweeper
    from adaptive_contact.service.transport import configure

    configure_logs(log_level, json=log_json)
    settings = router_settings(
        listen or (),
        network.connect or (),
        namespace=network.namespace,
        json=json,
        zenoh_config=network.zenoh_config,
        insecure=insecure,
        max_sessions=max_sessions,
    )
    # Python hands its lock on every 5 ms while a thread computes; a callback or the outbox
    # would wait as long for the worker.  At half a millisecond the hand-over costs nothing that
    # can be measured.
    sys.setswitchinterval(0.0005)
    threadpool_limits(1)  # matrices this small only wait for each other in threads
    # Before Zenoh makes its threads: an event passes through them.
    # In real-time priority, behind a bridge on the same computer: a reading missed is lost.
    enable_realtime(realtime, below=5)
    robot = opt.described_robot(config)
    learned, origin = opt.learned_of(robot, config, baseline)
    configure(settings)  # what is wrong shows before a minute of compiling
    slow = first_start()
    if slow is None:
        compile_tick(stop)
    refitter = ProcessRefitter()
    bank = LearnerBank(
        robot,
        learned,
        refitter=refitter,
        on_fault=LogThrottle(60.0).fault,
        when_ambiguous=when_ambiguous,
    )
    link = open_link(settings, stop)
    try:
        if slow is not None:
            compile_in_view(slow, link, robot, origin, stop)
        if stop.is_set():
            return
        keeper = None if no_state else keeper_of(state, robot, learned, network.namespace)
        sweeper = Sweeper()
        service = Service(
            link,
            bank,
            robot,
            baseline=origin,
            now_ns=time.monotonic_ns(),
            keeper=keeper,
            sweeper=sweeper,
            described_only=described_only,
        )
        sweeper.start(time.monotonic_ns())
        print_line(_ready_line(link, robot, origin))
        refitter.start()
        service.run(stop)
    finally:
        refitter.close()
        link.close()


def keeper_of(
    folder: Path | None, robot: Robot, learned: Baseline | None, namespace: str | None
) -> StateKeeper:
    """Make the keeper of the learners' state: restored when they are made, saved as they go.

    Robots of one kind are distinguished by their namespaces.
    """
    from adaptive_contact.core.learn.state import FORMAT as SNAPSHOT_FORMAT
    from adaptive_contact.model.model_file import dump_baseline
    from adaptive_contact.service.state import FORMAT, StateStore, default_folder, settings_digest
    from adaptive_contact.service.state.keeper import StateKeeper

    text = "" if learned is None else dump_baseline(learned)
    name = robot.name if namespace is None else f"{namespace}/{robot.name}"
    store = StateStore.open(folder or default_folder(), name)
    formats = (FORMAT, SNAPSHOT_FORMAT)
    return StateKeeper(
        store,
        name,
        lambda leg: settings_digest(robot, leg, text, formats=formats),
        package=__version__,
    )


def _ready_line(link: Link, robot: Robot, origin: str | None) -> str:

    where = [f"listening on {', '.join(map(shown, link.endpoints))}"] if link.endpoints else []
    if link.settings.mode == "client":  # let in by one of them, or there would be no link
        where.append(f"connected to {' or '.join(map(shown, link.joins))}")
    elif link.joins:  # whether they are there is reported later
        where.append(f"joining {', '.join(map(shown, link.joins))}")
    return (
        f"adaptive-contact: {' and '.join(where)}; robot {robot.name}, "
        f"legs {' '.join(robot.leg_ids)}; "
        f"baseline {origin or 'none (`adaptive-contact fit` makes one)'}; stop with Ctrl-C"
    )
