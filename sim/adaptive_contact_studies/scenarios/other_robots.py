"""Scenarios of robots other than the hexapod: nothing changes, and joints that rub.

A quadruped that trots and walks over rough ground at 100 Hz, and a leg of five joints on a stand
that meets plates.  Each learner starts from the baseline that ships for its robot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from adaptive_contact_sim.gait import GAITS, GaitName
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.scenarios.runs import Sizes, What, around, drifting, without_drift
from adaptive_contact_studies.scenarios.spec import Expect, Mark, Phase, RecordingSpec, Scenario

__all__ = ["other_robots"]

QUADRUPED: Final = "quadruped12"
LEG: Final = "leg5"
# Share of descents under which a plate is to come; it does under about half of them.
_PLATES: Final = 0.65
_OFFSETS: Final = {QUADRUPED: 600, LEG: 700}  # of seeds
_RUBS: Final = What("friction", 4.0)


def other_robots(sizes: Sizes) -> list[Scenario]:
    """The rows of both robots."""
    return [
        _still("quadruped12-trot", "a quadruped trots over rough ground", "trot", sizes),
        _still("quadruped12-walk", "a quadruped walks over rough ground", "walk", sizes),
        _step("quadruped12-friction4", "a trotting quadruped: its joints rub 4 times as much",
              "trot", sizes),
        _still("leg5-plates", "a leg of five joints meets plates", None, sizes),
        _step("leg5-friction4", "a leg of five joints: they rub 4 times as much", None, sizes),
    ]  # fmt: skip


def _runs(
    gait: GaitName | None, sizes: Sizes, seconds: float
) -> tuple[tuple[RecordingSpec, ...], float]:
    """As many runs as give the leg-runs, and how long a swing's cycle takes, s."""
    name = LEG if gait is None else QUADRUPED
    settings = SimulationSettings.of(name, "pose" if gait is None else "walk", gait)
    motion = settings.motion
    if isinstance(motion, WalkSettings):
        cycle_s = motion.swing_s / GAITS[motion.gait].share
    else:
        assert isinstance(motion, PoseSettings)
        cycle_s = (2 * motion.segment_ticks + motion.hold_ticks) * settings.period_s
        plates = replace(motion.obstacles, probability=_PLATES)
        settings = replace(settings, motion=replace(motion, obstacles=plates))
    legs = simulated_robot(name).layout.legs
    first = sizes.first_seed + _OFFSETS[name] + (50 if gait == "walk" else 0)
    count = math.ceil(sizes.leg_runs / len(legs))
    return tuple(
        RecordingSpec(replace(settings, seed=first + run), seconds, legs) for run in range(count)
    ), cycle_s


def _still(name: str, about: str, gait: GaitName | None, sizes: Sizes) -> Scenario:
    seconds = sizes.walk_before_s + sizes.walk_after_s
    recordings, _ = _runs(gait, sizes, seconds)
    return Scenario(
        name=name,
        about=f"nothing changes: {about}",
        motion="pose" if gait is None else "walk",
        expect=Expect.QUIET,
        recordings=recordings,
        phases=(Phase("all", 0.0, seconds),),
        judged=("all",),
        mixed=gait is None,
    )


def _step(name: str, about: str, gait: GaitName | None, sizes: Sizes) -> Scenario:
    at_s, end_s = sizes.walk_before_s, sizes.walk_before_s + sizes.walk_after_s
    recordings, cycle_s = _runs(gait, sizes, end_s)
    return Scenario(
        name=name,
        about=about,
        motion="pose" if gait is None else "walk",
        expect=Expect.RECOVER,
        recordings=tuple(drifting(spec, run, at_s, _RUBS) for run, spec in enumerate(recordings)),
        phases=around(at_s, end_s, cycle_s),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=without_drift,
        mixed=gait is None,
    )
