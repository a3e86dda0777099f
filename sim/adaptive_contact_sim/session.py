"""One run from beginning to end: simulation, link, recording and film together."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import ContactEvent
from adaptive_contact_sim.live import Pace, run_live
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.pose_group import PoseGroupSettings
from adaptive_contact_sim.simulation import Simulation, SimulationSettings, Tick

if TYPE_CHECKING:
    from adaptive_contact.service.link import LinkSettings
    from adaptive_contact.service.settings import Finding

Look = Callable[[Tick], None]


@dataclass(frozen=True)
class Report:
    """How a run went."""

    simulated_s: float
    elapsed_s: float  # of the wall clock
    ticks: int
    late: int  # ticks that came late
    touches: dict[str, int]  # contacts begun per leg, standing at the start left out
    raises: int | None = None  # swings raised on a strike, None where none was to be


def run(
    settings: SimulationSettings,
    stop: Event,
    *,
    seconds: float | None = None,
    speed: float | None = None,
    link: LinkSettings | None = None,
    record: Path | None = None,
    render: Path | None = None,
    on_wait: Callable[[Finding], None] | None = None,
    on_start: Callable[[str], None] = lambda _: None,
) -> Report:
    """Run a simulation to its end.

    Args:
        settings: what to simulate.
        stop: ends the run when set.
        seconds: of simulated time, None for until stopped.
        speed: times real time, None for as fast as possible.
        link: how to join the network, None for a run without one.
        record: MCAP file to write.
        render: picture or film to make.
        on_wait: called with what stands in the way of the network.
        on_start: called with one line when it begins.

    Raises:
        AdaptiveContactError: in one line, what is wrong.
    """
    if link is None and seconds is None:
        raise ConfigurationError(
            "a run without a network would never end; give --seconds, or a scenario that has them"
        )
    if seconds is not None and not 0.0 < seconds <= 1e6:
        raise ConfigurationError(f"a run of {seconds} s; expected above 0, to 1000000 s")
    if link is not None:
        # Live samples carry wall clock times, and a run number that grows from start to start.
        now_ns = time.time_ns()
        settings = replace(settings, epoch_ns=now_ns, run=now_ns // 1_000_000)
    sim = Simulation(settings, looks=render is not None)
    touches: Counter[str] = Counter()
    with ExitStack() as stack:
        looks: list[Look] = []
        recorder = None
        if record is not None:
            from adaptive_contact_sim.recorder import TickRecorder

            recorder = stack.enter_context(TickRecorder(record, sim))
            looks.append(recorder.write)
        if render is not None:
            from adaptive_contact_sim.picture import Film

            film = stack.enter_context(closing(Film(render, sim)))
            looks.append(lambda _: film.capture())

        def on_tick(tick: Tick) -> None:
            for change in tick.truth:
                if change.message.contact and sim.ticks > 1:
                    touches[change.leg] += 1
            for look in looks:
                look(tick)

        def on_event(event: ContactEvent) -> None:
            if recorder is not None:
                recorder.write_event(event)

        joined = None
        does = "no network"
        if link is not None:
            from adaptive_contact.service.link import Link

            joined = stack.enter_context(Link.open(link, on_wait=on_wait, stop=stop))
            does = "publishing robot/leg/*/servo and truth"
        on_start(f"{describe(settings)}; {does}")
        pace = Pace(0.0 if speed is None else settings.period_s / speed)
        run_live(
            sim,
            joined,
            seconds=seconds,
            pace=pace,
            stop=stop,
            on_tick=on_tick,
            on_event=on_event,
        )
        elapsed_s = pace.elapsed_s
    wanted = getattr(settings.motion, "raise_m", 0.0)
    raises = getattr(sim.motion, "raises", None) if wanted else None
    counts = {leg: touches[leg] for leg in sim.layout.legs}
    return Report(sim.time_s, elapsed_s, sim.ticks, pace.late, counts, raises)


def describe(settings: SimulationSettings) -> str:
    """What a run is, in a few words."""
    motion = settings.motion
    if isinstance(motion, PoseSettings):
        what = f"{' '.join(motion.legs)} in pose, {motion.workspace} workspace"
        if motion.obstacles.probability:
            what += f", {motion.obstacles.probability:.0%} obstacles"
    elif isinstance(motion, PoseGroupSettings):
        what = f"{' '.join(motion.legs)} in pose together"
    else:
        turn = "as planned" if motion.phase == "planned" else f"stop on {motion.stop_on}"
        gait = "walk" if motion.gait == "walk" else f"{motion.gait} walk"
        what = f"{gait} on {settings.terrain.kind} ground, {turn}"
    drifts = f", {len(settings.drift)} drifts" if settings.drift else ""
    return f"{what}, seed {settings.seed}{drifts}"
