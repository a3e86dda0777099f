"""What happens when, in a soak of any length."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, NamedTuple

__all__ = ["Drifting", "Fault", "FaultKind", "SoakPlan"]

FaultKind = Literal["router", "service"]

# Events must be right again so long after the end of a cause.
RECOVERY_S: Final = 2.0
# Memory is judged after so long: buffers fill, and the first refits load their libraries.
WARM_UP_S: Final = 180.0
_WARM_UP_SHARE: Final = 0.15
_RAMP_SHARE: Final = 0.05


class Fault(NamedTuple):
    """Something that is killed and started again, s after the walk began."""

    kind: FaultKind
    at_s: float


class Drifting(NamedTuple):
    """A change of a leg, as the simulator's ``--drift`` takes it, s of simulated time."""

    spec: str
    at_s: float
    duration_s: float

    @property
    def option(self) -> str:
        """For the command line."""
        return f"{self.spec}@{self.at_s:g}s"


@dataclass(frozen=True)
class SoakPlan:
    """A soak.

    Attributes:
        out: folder of what it writes.
        minutes: of walking, in real time.
        seed: of the walk.
    """

    out: Path = Path("out/soak")
    minutes: float = 30.0
    seed: int = 0

    @property
    def seconds(self) -> float:
        """Of walking."""
        return 60.0 * self.minutes

    @property
    def warm_up_s(self) -> float:
        """Of each life of the service."""
        return min(WARM_UP_S, _WARM_UP_SHARE * self.seconds)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Two routers and one service, well apart."""
        shares: tuple[tuple[FaultKind, float], ...] = (
            ("router", 0.3),
            ("service", 0.55),
            ("router", 0.8),
        )
        return tuple(Fault(kind, share * self.seconds) for kind, share in shares)

    @property
    def drifts(self) -> tuple[Drifting, ...]:
        """Steps and ramps of one leg after the other, and of all of them."""
        ramp_s = round(_RAMP_SHARE * self.seconds, 1)
        ramp = f"shape=ramp,duration={ramp_s:g}"
        changes: tuple[tuple[str, float, float], ...] = (
            ("mass:leg=rf,joint=all,value=0.03", 0.12, 0.0),
            (f"friction:leg=lm,joint=all,value=2,{ramp}", 0.2, ramp_s),
            ("friction:leg=rr,joint=femur,value=3", 0.4, 0.0),
            (f"supply:leg=all,joint=all,value=10.5,{ramp}", 0.47, ramp_s),
            ("mass:leg=rf,joint=all,value=0", 0.65, 0.0),
            ("friction:leg=rr,joint=femur,value=1", 0.72, 0.0),
            (f"supply:leg=all,joint=all,value=12,{ramp}", 0.88, ramp_s),
        )
        return tuple(
            Drifting(spec, round(share * self.seconds, 1), duration)
            for spec, share, duration in changes
        )
