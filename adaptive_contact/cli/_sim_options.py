"""Defines options of ``sim``, and what its commands share."""

from __future__ import annotations

import dataclasses
import threading
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeVar

from adaptive_contact.cli._link import unless_stopped
from adaptive_contact.cli._options import (
    ForceOption,
    Network,
    check_output,
    option,
    seconds_option,
    speed_of,
)
from adaptive_contact.cli._output import print_line, print_waiting
from adaptive_contact.errors import ConfigurationError, needs

if TYPE_CHECKING:
    from adaptive_contact_sim import (
        PoseSettings,
        Scenario,
        SimulationSettings,
        WalkSettings,
    )

M = TypeVar("M", "PoseSettings", "WalkSettings")

_RUN: Final = "Run"
_OUT: Final = "Output"
_ROBOT: Final = "Robot"

ReactOption = Annotated[
    float | None,
    option("--react-ms", "From a touch to the leg's stop. [60]", panel=_ROBOT),
]


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Holds the options that `sim pose` and `sim walk` share; None where one is not given."""

    scenario: Annotated[
        str | None,
        option(
            "--scenario",
            "Start from a shipped scenario (`sim list`) or a file; options change it.",
            "NAME|FILE.toml",
            panel=_RUN,
        ),
    ] = None
    seconds: Annotated[
        float | None,
        seconds_option("--seconds", "Simulated time; otherwise until Ctrl-C.", panel=_RUN),
    ] = None
    speed: Annotated[
        str | None,
        option(
            "--speed",
            "Times real time, or as fast as possible. [1, max with --offline]",
            "X|max",
            panel=_RUN,
        ),
    ] = None
    seed: Annotated[int | None, option("--seed", "Seed of the run. [0]", min=0, panel=_RUN)] = None
    robot: Annotated[
        str | None,
        option(
            "--robot", "Which robot: hexapod, quadruped12, leg5. [hexapod]", "NAME", panel=_ROBOT
        ),
    ] = None
    robot_seed: Annotated[
        int | None, option("--robot-seed", "Which robot of its kind. [0]", min=0, panel=_ROBOT)
    ] = None
    drift: Annotated[
        list[str] | None,
        option(
            "--drift",
            "Such as friction:leg=rf,joint=femur,value=4,shape=ramp,duration=60@20s; repeatable.",
            "SPEC",
            panel=_ROBOT,
        ),
    ] = None
    offline: Annotated[bool, option("--offline", "No network.", panel=_OUT)] = False
    record: Annotated[
        Path | None, option("--record", "Write a recording.", "FILE.mcap", panel=_OUT)
    ] = None
    render: Annotated[
        Path | None,
        option(
            "--render",
            "Write a film (.gif) or the last picture (.png); needs no display.",
            "FILE",
            panel=_OUT,
        ),
    ] = None
    force: ForceOption = False

    def __post_init__(self) -> None:
        check_output(self.record, "--record", force=self.force)
        check_output(self.render, "--render", [self.record], force=self.force)

    def base(self, kind: type[M], gait: str | None = None) -> tuple[Scenario, M]:
        """The scenario to start from, and its motion; without one, the defaults of that motion.

        Args:
            kind: of motion.
            gait: of a walk without a scenario: a robot's gaits may have defaults of their own.

        Raises:
            ConfigurationError: the scenario cannot be used, or is of another motion.
        """
        from adaptive_contact_sim import PoseSettings, Scenario, SimulationSettings, load_scenario
        from adaptive_contact_sim.gait import GAITS

        mode: Literal["pose", "walk"] = "pose" if kind is PoseSettings else "walk"
        if self.scenario is None:
            known = next((name for name in GAITS if name == gait), None)
            start = SimulationSettings.from_robot(self.robot or "hexapod", mode, known)
            scenario = Scenario("default", "", None, start)
        else:
            scenario = load_scenario(self.scenario)
            if self.robot not in (None, scenario.settings.robot):
                raise ConfigurationError(
                    f"scenario '{scenario.name}' is of robot '{scenario.settings.robot}', not "
                    f"'{self.robot}'; leave out --robot"
                )
        motion = scenario.settings.motion
        if not isinstance(motion, kind):
            found = "pose" if isinstance(motion, PoseSettings) else "walk"
            raise ConfigurationError(
                f"scenario '{scenario.name}' is for `sim {found}`, not `sim {mode}`; use that "
                "command"
            )
        return scenario, motion

    def execute(
        self,
        base: Scenario,
        settings: SimulationSettings,
        network: Network,
        stop: threading.Event,
        *,
        json: bool,
    ) -> None:
        """Run a simulation, and say how it went.

        Raises:
            AdaptiveContactError: an option is out of range, a drift cannot be read, or the run
                failed.
        """
        from adaptive_contact_sim import parse_drift, run, simulated_robot

        layout = simulated_robot(settings.robot).layout
        settings = dataclasses.replace(
            settings,
            drift=settings.drift + tuple(parse_drift(text, layout) for text in self.drift or ()),
            **given(seed=self.seed, robot_seed=self.robot_seed),
        )
        speed = None if self.offline and self.speed is None else speed_of(self.speed)
        with unless_stopped(stop):
            report = run(
                settings,
                stop,
                seconds=base.seconds if self.seconds is None else self.seconds,
                speed=speed,
                link=None if self.offline else network.client(json=json),
                record=self.record,
                render=self.render,
                on_wait=print_waiting,
                on_start=lambda line: print_line(f"adaptive-contact sim: {line}; stop with Ctrl-C"),
            )
            factor = report.simulated_s / max(report.elapsed_s, 1e-9)
            touches = "  ".join(f"{leg} {count}" for leg, count in report.touches.items())
            raises = "" if report.raises is None else f"; raised swings: {report.raises}"
            late = f", {report.late} late" if speed is not None else ""
            print_line(
                f"simulated {report.simulated_s:.1f} s in {report.elapsed_s:.1f} s "
                f"({factor:.1f} x real time), {report.ticks} ticks{late}; "
                f"touches: {touches}{raises}"
            )
            for path in filter(None, (self.record, self.render)):
                print_line(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB)")


def needs_simulator() -> AbstractContextManager[None]:
    """Wrap imports of the simulator: a missing mujoco is reported in one line."""
    return needs("the simulator", "sim", "mujoco")


def needs_studies() -> AbstractContextManager[None]:
    """Wrap imports of the studies, likewise: said before hours of work, not after."""
    return needs("a study", "studies", "mujoco", "joblib", "matplotlib", "jinja2")


def given(**options: Any) -> dict[str, Any]:
    """Return the options that were given."""
    return {name: value for name, value in options.items() if value is not None}
