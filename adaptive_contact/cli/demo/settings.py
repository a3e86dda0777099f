"""What the demo shows: how long, which walk, and what happens to which leg."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift
from adaptive_contact_sim.robots import ROBOTS, SimulatedRobot, simulated_robot

# Swings take 1.3 s a leg: fewer seconds leave too few of them on either side of the drift.
SHORTEST_S: Final = 8.0
LONGEST_S: Final = 3600.0
# A little before half time: what comes after the drift is what the demo is about.
DRIFT_SHARE: Final = 0.42


@dataclass(frozen=True)
class DemoSettings:
    """A run of the demo.

    Raises:
        ConfigurationError: a value is out of range.
    """

    out: Path = Path("out/demo")  # folder of what it writes; made where it is not there
    seconds: float = 60.0  # of walking, in real time
    seed: int = 0  # of the walk
    robot: str = "hexapod"  # which walks, of `ROBOTS`
    leg: str = ""  # which one drifts; the right front one where left out
    friction: float = 4.0  # factor of its joints' friction from the drift on
    mud_kg: float = 0.06  # at its foot from then on

    def __post_init__(self) -> None:
        if not SHORTEST_S <= self.seconds <= LONGEST_S:
            raise ConfigurationError(
                f"a demo of {self.seconds:g} s; expected {SHORTEST_S:g} to {LONGEST_S:g} s"
            )
        if self.seed < 0:
            raise ConfigurationError(f"demo seed is {self.seed}; expected 0 or more")
        robot = self.simulated
        if robot.walk is None:
            walkers = [name for name, one in ROBOTS.items() if one.walk is not None]
            raise ConfigurationError(
                f"robot '{self.robot}' ({robot.about}) does not walk; expected "
                f"{' or '.join(walkers)}"
            )
        legs = robot.layout.legs
        if not self.leg:
            object.__setattr__(self, "leg", "rf" if "rf" in legs else "fr")
        if self.leg not in legs:
            raise ConfigurationError(f"no leg '{self.leg}'; legs are {' '.join(legs)}")

    @property
    def simulated(self) -> SimulatedRobot:
        """The robot that walks."""
        return simulated_robot(self.robot)

    @property
    def drift_at_s(self) -> float:
        """When the drift is injected, s of simulated time."""
        return DRIFT_SHARE * self.seconds

    @property
    def drifts(self) -> tuple[Drift, ...]:
        """What is injected then, one after the other."""
        return (
            Drift(kind="friction", value=self.friction, leg=self.leg),
            Drift(kind="mass", value=self.mud_kg, leg=self.leg),
        )

    @property
    def recording(self) -> Path:
        """Everything that went over the wire."""
        return self.out / "demo.mcap"

    @property
    def summary(self) -> Path:
        """The figures."""
        return self.out / "summary.json"

    @property
    def report(self) -> Path:
        """The picture."""
        return self.out / "report.png"


def drift_words(settings: DemoSettings) -> str:
    """What happens to the leg, for a person."""
    return f"friction × {settings.friction:g} and {settings.mud_kg * 1000:g} g of mud"
