"""Scenarios in which the leg changes: steps of every kind, ramps, a pulse, several at once."""

from __future__ import annotations

import math
from typing import Final

from adaptive_contact_studies.scenarios.runs import (
    POSE_SWING_S,
    WALK_SWING_S,
    Sizes,
    What,
    all_touch,
    around,
    drifting,
    minutes,
    pose_runs,
    walk_runs,
    without_drift,
)
from adaptive_contact_studies.scenarios.spec import Expect, Mark, Phase, Scenario, Staging

__all__ = ["compound", "slow_changes", "steps"]

# Steps of every kind that the simulator knows.  The first four walk, too;
# values are at the far end of what is seen in the field, docs/simulator.md.
STEPS: Final = {
    "friction4": ("all joints rub four times as much", What("friction", 4.0)),
    "supply94": ("the battery falls from 12 V to 9.4 V", What("supply", 9.4)),
    "compliance2": ("the servos' slope doubles: half as stiff", What("compliance", 2.0)),
    "joint6": ("one joint rubs six times as much", What("friction", 6.0, turning=True)),
    "mass50": ("50 g of mud at the foot", What("mass", 0.05)),
    "mass100": ("100 g of mud at the foot", What("mass", 0.1)),
    "viscous4": ("four times the viscous friction", What("viscous", 4.0)),
    "winding16": ("motors 40 K warmer: 16 % more resistance", What("winding", 1.16)),
    "backlash1": ("one degree of backlash in every gear", What("backlash", math.radians(1.0))),
    "offset3": ("a horn slips by three steps", What("offset", 0.0153, turning=True)),
    "dropout3": ("3 % of readings stop coming", What("dropout", 0.03)),
}
# Those that walk, too.
WALKING_STEPS: Final = ("friction4", "supply94", "compliance2", "joint6")


def steps(sizes: Sizes) -> list[Scenario]:
    """Every kind of step in pose, the four of the design while walking."""
    return [
        *(_pose_step(f"step-{name}", *entry, sizes) for name, entry in STEPS.items()),
        *(_walk_step(f"walk-{name}", *STEPS[name], sizes) for name in WALKING_STEPS),
    ]


def _pose_step(name: str, about: str, what: What, sizes: Sizes) -> Scenario:
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    return Scenario(
        name=name,
        about=about,
        motion="pose",
        expect=Expect.RECOVER,
        recordings=tuple(
            drifting(spec, run, at_s, what) for run, spec in enumerate(pose_runs(sizes, end_s))
        ),
        phases=around(at_s, end_s, POSE_SWING_S),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=without_drift,
    )


def _walk_step(name: str, about: str, what: What, sizes: Sizes) -> Scenario:
    at_s, end_s = sizes.walk_before_s, sizes.walk_before_s + sizes.walk_after_s
    return Scenario(
        name=name,
        about=f"walking, all legs: {about}",
        motion="walk",
        expect=Expect.RECOVER,
        recordings=tuple(
            drifting(spec, run, at_s, what) for run, spec in enumerate(walk_runs(sizes, end_s))
        ),
        phases=around(at_s, end_s, WALK_SWING_S),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=without_drift,
        mixed=False,
    )


def slow_changes(sizes: Sizes) -> list[Scenario]:
    """Ramps, a random walk, and a pulse."""
    at_s = sizes.before_s
    until_s = at_s + sizes.slow_s
    end_s = until_s + sizes.slow_after_s
    phases = (
        Phase("before", 0.0, at_s),
        Phase("changing", at_s, until_s),
        Phase("after", until_s, end_s),
    )
    took = minutes(sizes.slow_s)
    entries = {
        "ramp-mud": (f"100 g of mud gather in {took}", What("mass", 0.1, shape="ramp")),
        "ramp-battery": (
            f"the battery sags from 12 V to 9.4 V in {took}",
            What("supply", 9.4, shape="ramp"),
        ),
        "walk-of-friction": (
            f"friction wanders between nominal and four times that for {took}",
            What("friction", 4.0, shape="walk"),
        ),
    }
    slow = [
        Scenario(
            name=name,
            about=about,
            motion="pose",
            expect=Expect.FOLLOW,
            recordings=tuple(
                drifting(spec, run, at_s, what, duration_s=sizes.slow_s)
                for run, spec in enumerate(pose_runs(sizes, end_s))
            ),
            phases=phases,
            judged=("changing", "after"),
            marks=(Mark("begin", at_s),),
            twin=without_drift,
        )
        for name, (about, what) in entries.items()
    ]
    off_s = at_s + sizes.pulse_s
    washed_s = off_s + sizes.slow_after_s
    mud = What("mass", 0.1, shape="pulse")
    pulse = Scenario(
        name="pulse-mud",
        about=f"100 g of mud for {minutes(sizes.pulse_s)}, then it is washed off",
        motion="pose",
        expect=Expect.RECOVER,
        recordings=tuple(
            drifting(spec, run, at_s, mud, duration_s=sizes.pulse_s)
            for run, spec in enumerate(pose_runs(sizes, washed_s))
        ),
        phases=(
            Phase("before", 0.0, at_s - POSE_SWING_S),
            Phase("muddy", at_s, off_s - POSE_SWING_S),
            Phase("washed", off_s, washed_s),
        ),
        judged=("muddy", "washed"),
        marks=(Mark("mud", at_s), Mark("washed", off_s)),
        twin=without_drift,
    )
    return [*slow, pulse]


def compound(sizes: Sizes) -> list[Scenario]:
    """Two changes at once, and a change behind nothing but contacts."""
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    stiff_mud = (What("friction", 4.0), What("mass", 0.1))
    both = Scenario(
        name="two-at-once",
        about="100 g of mud and four times the friction at the same moment",
        motion="pose",
        expect=Expect.RECOVER,
        recordings=tuple(
            drifting(spec, run, at_s, *stiff_mud)
            for run, spec in enumerate(pose_runs(sizes, end_s))
        ),
        phases=around(at_s, end_s, POSE_SWING_S),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=without_drift,
    )
    # All swings end in contact from a few before the step until most of the time after it.
    staging = Staging(contacts=((at_s - 10 * POSE_SWING_S, 1.0), (end_s - 30.0, 0.55)))
    in_contacts = Scenario(
        name="step-in-contacts",
        about="friction rises fourfold while every swing ends in contact",
        motion="pose",
        expect=Expect.RECOVER,
        recordings=tuple(
            drifting(spec, run, at_s, What("friction", 4.0))
            for run, spec in enumerate(all_touch(sizes, end_s, staging))
        ),
        phases=around(at_s, end_s, POSE_SWING_S),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=without_drift,
        mixed=False,
        poisonous=True,
    )
    return [both, in_contacts]
