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

from adaptive_contact.bridge.plan import PortPlan, plan_ports
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
    Horns,
    PassiveBackend,
    ProcessSource,
)
from adaptive_contact_sim.virtual.faults import FaultSpec


@dataclasses.dataclass(frozen=True)
class VirtualPlan:
    """What to run."""

    robot: Robot  # its description: ids, models, mounting of the servos
    directory: Path  # where the ports' links go
    ports: int | None  # how many, for a description without any; None for one
    faults: tuple[FaultSpec, ...] = ()  # what goes wrong, and when
    wire_time: bool = True  # let answers take as long as on a real wire
    # the robot moves by itself; None for one on a stand that the bus moves
    scenario: str | None = None
    height_m: float = 1.0  # of the stand
    # of reading noise and faults, and of the scenario; 0 for the scenario's own
    seed: int = 0
    seconds: float | None = None  # how long, None for until stopped
    record: Path | None = None  # MCAP file of a scenario's own samples and truth
    write_config: Path | None = None  # where to write the robot.toml of the bus

    def __post_init__(self) -> None:
        if self.record is not None and self.scenario is None:
            raise ConfigurationError(
                "--record needs --scenario: a robot on a stand has no samples of its own; record "
                "the bridge's with `adaptive-contact record`"
            )
        if not 0.05 <= self.height_m <= 10.0:
            raise ConfigurationError(f"a stand of {self.height_m} m; expected 0.05 to 10 m")


def run(
    plan: VirtualPlan,
    stop: threading.Event,
    *,
    on_start: Callable[[str], None] = lambda _: None,
) -> None:
    """Serve a virtual robot until the end.

    Args:
        plan: what.
        stop: ends the run when set.
        on_start: called with one line when the ports can be opened.

    Raises:
        AdaptiveContactError: in one line, what is wrong.
    """
    try:
        plan.directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{plan.directory}: cannot be made ({error.strerror}); give another --dir"
        ) from error
    with _alone(plan.directory):
        _serve(plan, stop, on_start)


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


def _serve(plan: VirtualPlan, stop: threading.Event, on_start: Callable[[str], None]) -> None:
    robot = with_ports(plan.robot, plan.directory.resolve(), plan.ports)
    for port in robot.ports.values():
        if holds_content(Path(port.device)):  # a link to a terminal holds none
            raise ConfigurationError(f"{port.device} exists already, as a file; give another --dir")
    plans = plan_ports(robot)
    check_faults(plans, plan.faults)
    if plan.write_config is not None:
        write_file(plan.write_config, write_robot(robot), advice="give another --write-config")
    with ExitStack() as stack:
        backend, pairs = _backend(plan, plans, stack)
        server = stack.enter_context(
            assemble(plans, backend, pairs, plan.faults, seed=plan.seed, wire_time=plan.wire_time)
        )
        servos = sum(len(p.joints) for p in plans)
        models = ", ".join(sorted({j.models[-1].name for p in plans for j in p.joints}))
        where = " ".join(str(port.path) for port in server.ports)
        on_start(f"{servos} {models} on {where}; stop with Ctrl-C")
        server.run(stop, math.inf if plan.seconds is None else plan.seconds)


def _backend(
    plan: VirtualPlan, plans: Sequence[PortPlan], stack: ExitStack
) -> tuple[Backend, list[tuple[str, str]]]:
    """The physics, and the order of its servos."""
    pairs = HEXAPOD.servos
    horns = Horns.of(plans, pairs)
    if plan.scenario is None:
        return PassiveBackend(horns, height_m=plan.height_m), pairs
    settings = load_scenario(plan.scenario).settings
    if plan.seed:
        settings = dataclasses.replace(settings, seed=plan.seed)
    settings = dataclasses.replace(settings, run=time.time_ns() // 1_000_000)
    source = stack.enter_context(ProcessSource(settings, plan.record))
    source.wait()
    return GaitedBackend(source, horns, period_s=settings.period_s), pairs
