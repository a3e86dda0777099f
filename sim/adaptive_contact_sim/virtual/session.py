"""One run of a virtual robot: its physics and its ports."""

from __future__ import annotations

import dataclasses
import fcntl
import math
import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import holds_content, write_file
from adaptive_contact.robot import Robot
from adaptive_contact.robot.write import write_robot
from adaptive_contact_sim.elements import HEXAPOD
from adaptive_contact_sim.scenario import load_scenario
from adaptive_contact_sim.virtual.assembly import assemble, check_faults, with_ports
from adaptive_contact_sim.virtual.backend import (
    Backend,
    GaitedBackend,
    PassiveBackend,
    ProcessSource,
    mounted,
)
from adaptive_contact_sim.virtual.faults import FaultSpec


def run(
    robot: Robot,
    directory: Path,
    stop: threading.Event,
    *,
    ports: int | None = None,
    faults: Sequence[FaultSpec] = (),
    wire_time: bool = True,
    scenario: str | None = None,
    height_m: float = 1.0,
    seed: int = 0,
    seconds: float = math.inf,
    record: Path | None = None,
    write_config: Path | None = None,
    on_start: Callable[[str], None] = lambda _: None,
) -> None:
    """Serve a virtual robot until the end.

    Args:
        robot: its description: ids, models, mounting of the servos.
        directory: where the ports' links go.
        stop: ends the run when set.
        ports: how many, for a description without any; None for one.
        faults: what goes wrong, and when.
        wire_time: let answers take as long as on a real wire.
        scenario: the robot moves by itself; None for one on a stand that the bus moves.
        height_m: of the stand.
        seed: of reading noise and faults, and of the scenario; 0 for the scenario's own.
        seconds: how long.
        record: MCAP file of a scenario's own samples and truth.
        write_config: where to write the robot.toml of the bus.
        on_start: called with one line when the ports can be opened.

    Raises:
        AdaptiveContactError: in one line, what is wrong.
    """
    if record is not None and scenario is None:
        raise ConfigurationError(
            "--record needs --scenario: a robot on a stand has no samples of its own; record "
            "the bridge's with `adaptive-contact record`"
        )
    if not 0.05 <= height_m <= 10.0:
        raise ConfigurationError(f"a stand of {height_m} m; expected 0.05 to 10 m")
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{directory}: cannot be made ({error.strerror}); give another --dir"
        ) from error
    with ExitStack() as stack:
        stack.enter_context(_alone(directory))
        robot = with_ports(robot, directory.resolve(), ports)
        for port in robot.ports.values():
            if holds_content(Path(port.device)):  # a link to a terminal holds none
                raise ConfigurationError(
                    f"{port.device} exists already, as a file; give another --dir"
                )
        plans = plan_ports(robot)
        check_faults(plans, faults)
        if write_config is not None:
            write_file(write_config, write_robot(robot), advice="give another --write-config")
        # The physics, and the order of its servos.
        pairs = HEXAPOD.servos
        joints = mounted(plans, pairs)
        backend: Backend
        if scenario is None:
            backend = PassiveBackend(joints, height_m=height_m)
        else:
            settings = load_scenario(scenario).settings
            settings = dataclasses.replace(
                settings, seed=seed or settings.seed, run=time.time_ns() // 1_000_000
            )
            source = stack.enter_context(ProcessSource(settings, record))
            source.wait()
            backend = GaitedBackend(source, joints, period_s=settings.period_s)
        server = stack.enter_context(
            assemble(plans, backend, pairs, faults, seed=seed, wire_time=wire_time)
        )
        servos = sum(len(p.joints) for p in plans)
        models = ", ".join(sorted({j.models[-1].name for p in plans for j in p.joints}))
        where = " ".join(str(port.path) for port in server.ports)
        on_start(f"{servos} {models} on {where}; stop with Ctrl-C")
        server.run(stop, seconds)


@contextmanager
def _alone(directory: Path) -> Iterator[None]:
    """Two buses would take each other's links away; the lock of one that was killed is gone."""
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
        lock = os.fdopen(os.open(directory / ".in-use", flags, 0o600), "r+")
    except OSError as error:
        raise ConfigurationError(
            f"{directory}: cannot be written ({error.strerror}); give another --dir"
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigurationError(
                f"{directory} is in use by another virtual bus; give another --dir"
            ) from error
        yield
