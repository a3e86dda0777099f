"""The scenarios: permanent names, in the order of the table.

In some the leg changes: steps of every kind, ramps, a pulse, several at once.  In others it stays
as it is: contacts only, standing, trouble, starts, hours.  Two robots more, a quadruped that trots
and walks at 100 Hz and a leg of five joints on a stand, have both; each learner starts from the
baseline that ships for its robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.printable import did_you_mean
from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.gait import GAITS, GaitName
from adaptive_contact_sim.pose import PoseSettings
from adaptive_contact_sim.robots import simulated_robot
from adaptive_contact_sim.simulation import SimulationSettings
from adaptive_contact_sim.terrain import TerrainKind
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.scenarios.runs import (
    FULL_SIZES,
    POSE_SWING_S,
    WALK_SWING_S,
    Sizes,
    What,
    all_touch,
    around,
    drifting,
    lone_runs,
    minutes,
    pose_runs,
    turn_runs,
    walk_run,
    walk_runs,
    walks_without_change,
)
from adaptive_contact_studies.scenarios.spec import (
    ALL_VARIANTS,
    BaselineChoice,
    Mark,
    Phase,
    RecordingSpec,
    Scenario,
    Staging,
    Variant,
)

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


def _without_drift(spec: RecordingSpec) -> RecordingSpec:
    return spec.with_settings(drift=())


def steps(sizes: Sizes) -> list[Scenario]:
    """Every kind of step in pose, the four of the design while walking."""
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    walk_at_s, walk_end_s = sizes.walk_before_s, sizes.walk_before_s + sizes.walk_after_s
    poses, walks = pose_runs(sizes, end_s), walk_runs(sizes, walk_end_s)
    made = [
        _change(f"step-{name}", about, at_s, end_s, poses, what)
        for name, (about, what) in STEPS.items()
    ]
    for name in ("friction4", "supply94", "compliance2", "joint6"):  # Those that walk, too.
        about, what = f"walking, all legs: {STEPS[name][0]}", STEPS[name][1]
        made.append(
            _change(f"walk-{name}", about, walk_at_s, walk_end_s, walks, what, swing_s=WALK_SWING_S)
        )
    return made


def _change(
    name: str,
    about: str,
    at_s: float,
    end_s: float,
    runs: Iterable[RecordingSpec],
    *changes: What,
    swing_s: float = POSE_SWING_S,
) -> Scenario:
    """Changes at one moment, to recover from."""
    recordings = tuple(drifting(spec, run, at_s, *changes) for run, spec in enumerate(runs))
    return Scenario(
        name=name,
        about=about,
        expect="recover",
        recordings=recordings,
        phases=around(at_s, end_s, swing_s),
        judged=("after",),
        marks=(Mark("step", at_s),),
        twin=_without_drift,
        mixed=not recordings[0].walks,
    )


def _still(
    name: str,
    about: str,
    recordings: tuple[RecordingSpec, ...],
    seconds: float,
    variants: tuple[Variant, ...] = ALL_VARIANTS,
) -> Scenario:
    """Nothing changes."""
    return Scenario(
        name=name,
        about=about,
        expect="quiet",
        recordings=recordings,
        phases=(Phase("all", 0.0, seconds),),
        judged=("all",),
        variants=variants,
        mixed=not recordings[0].walks,
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
            expect="follow",
            recordings=tuple(
                drifting(spec, run, at_s, what, duration_s=sizes.slow_s)
                for run, spec in enumerate(pose_runs(sizes, end_s))
            ),
            phases=phases,
            judged=("changing", "after"),
            marks=(Mark("begin", at_s),),
            twin=_without_drift,
        )
        for name, (about, what) in entries.items()
    ]
    off_s = at_s + sizes.pulse_s
    washed_s = off_s + sizes.slow_after_s
    mud = What("mass", 0.1, shape="pulse")
    pulse = Scenario(
        name="pulse-mud",
        about=f"100 g of mud for {minutes(sizes.pulse_s)}, then it is washed off",
        expect="recover",
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
        twin=_without_drift,
    )
    return [*slow, pulse]


def compound(sizes: Sizes) -> list[Scenario]:
    """Two changes at once, and a change behind nothing but contacts."""
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    both = _change(
        "two-at-once",
        "100 g of mud and four times the friction at the same moment",
        at_s,
        end_s,
        pose_runs(sizes, end_s),
        What("friction", 4.0),
        What("mass", 0.1),
    )
    # All swings end in contact from a few before the step until most of the time after it.
    staging = Staging(contacts=((at_s - 10 * POSE_SWING_S, 1.0), (end_s - 30.0, 0.55)))
    in_contacts = _change(
        "step-in-contacts",
        "friction rises fourfold while every swing ends in contact",
        at_s,
        end_s,
        all_touch(sizes, end_s, staging),
        What("friction", 4.0),
    )
    return [both, replace(in_contacts, mixed=False, poisonous=True)]


def contacts(sizes: Sizes) -> list[Scenario]:
    """In pose: every swing of a long stretch ends in contact."""
    at_s, count = sizes.before_s, sizes.contact_swings
    until_s = at_s + sizes.contact_swings * POSE_SWING_S
    end_s = until_s + sizes.before_s
    schedule = ((at_s, 1.0), (until_s, 0.55))
    entries = {
        "contacts-hard": (f"{count} swings in a row end on hard obstacles", None, 0.0),
        "contacts-soft": (f"{count} swings in a row end on soft obstacles", None, 1.0),
        # The middle between the paper's subspaces, which every descent crosses.
        "contacts-level": (f"{count} swings in a row end at the same height", -0.045, 0.0),
    }
    return [
        Scenario(
            name=name,
            about=about,
            expect="unpoisoned",
            recordings=all_touch(sizes, end_s, Staging(schedule, level_m), soft),
            phases=(
                Phase("before", 0.0, at_s),
                Phase("contacts", at_s, until_s),
                Phase("after", until_s, end_s),
            ),
            judged=("contacts", "after"),
            marks=(Mark("contacts", at_s),),
            mixed=False,
            poisonous=True,
        )
        for name, (about, level_m, soft) in entries.items()
    ]


def walking_contacts(sizes: Sizes) -> list[Scenario]:
    """Walking, where every swing ends in contact anyway."""
    count = sizes.contact_swings
    seconds = 20.0 + count * WALK_SWING_S
    entries: dict[str, tuple[str, TerrainKind]] = {
        "walk-contacts-hard": (f"{count} steps of each leg over hard, rough ground", "rough"),
        "walk-contacts-soft": (f"{count} steps of each leg over soft ground", "soft"),
        "walk-contacts-level": (f"{count} steps of each leg over flat, hard ground", "flat"),
    }
    return [
        Scenario(
            name=name,
            about=about,
            expect="unpoisoned",
            recordings=walk_runs(sizes, seconds, ground),
            # No swing ends without a contact here: there is nothing before, only early and late.
            phases=(Phase("early", 0.0, seconds / 2), Phase("late", seconds / 2, seconds)),
            judged=("early", "late"),
            mixed=False,
            poisonous=True,
        )
        for name, (about, ground) in entries.items()
    ]


def trouble(sizes: Sizes) -> list[Scenario]:
    """A leg that stands, a foot that is caught, readings that fail."""
    turns, round_s = turn_runs(sizes)
    stand = Scenario(
        name="stand-10min",
        about=f"a leg swings, stands for {round_s * 5 / 6 / 60:.0f} min, and swings again",
        expect="unharmed",
        recordings=turns,
        phases=(Phase("before", 0.0, round_s), Phase("after", round_s, 2 * round_s)),
        judged=("after",),
        marks=(Mark("swings again", round_s),),
    )
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    free_s = at_s + sizes.caught_s
    after_it = around(free_s, end_s, POSE_SWING_S)[1:]
    caught = Scenario(
        name="caught-30s",
        about=f"a foot hangs in a root for {sizes.caught_s:g} s, through all its swings",
        expect="recover",
        recordings=lone_runs(sizes, end_s, Staging(caught_s=(at_s, free_s))),
        phases=(Phase("before", 0.0, at_s), Phase("caught", at_s, free_s), *after_it),
        judged=("after",),
        # It is caught when it next rests, so that it comes free up to a swing late.
        marks=(Mark("free again", free_s + POSE_SWING_S),),
        twin=lambda spec: replace(spec, staging=Staging()),
        poisonous=True,
    )
    trailing = replace(
        caught,
        name="trailing-2N",
        about=f"a foot trails a branch for {sizes.caught_s:g} s, 2 N against its motion",
        recordings=lone_runs(sizes, end_s, Staging(caught_s=(at_s, free_s), trails_n=2.0)),
        phases=(Phase("before", 0.0, at_s), Phase("trailing", at_s, free_s), *after_it),
        marks=(Mark("tangled", at_s), Mark("free again", free_s + POSE_SWING_S)),
        poisonous=False,
    )
    faults = EncoderSettings(dropped=0.03, repeated=0.03)
    readings = Scenario(
        name="readings-3pct",
        about="of every joint's readings 3 % do not come, and 3 % are old ones",
        expect="unharmed",
        recordings=tuple(spec.with_settings(encoder=faults) for spec in pose_runs(sizes, end_s)),
        phases=(Phase("all", 0.0, end_s),),
        judged=("all",),
        twin=lambda spec: spec.with_settings(encoder=EncoderSettings()),  # the noise is the same
    )
    return [stand, caught, trailing, readings]


def starts(sizes: Sizes) -> list[Scenario]:
    """With no baseline, and with wrong ones."""
    end_s = sizes.start_s
    settled = 60 * POSE_SWING_S  # the goal: valid after 60 swings
    phases = (Phase("start", 0.0, settled), Phase("after", settled, end_s))
    poses = pose_runs(sizes, end_s)
    others = tuple(spec.with_settings(robot_seed=1 + run) for run, spec in enumerate(poses))

    def start(
        name: str, about: str, choice: BaselineChoice, recordings: tuple[RecordingSpec, ...]
    ) -> Scenario:
        return Scenario(
            name=name,
            about=about,
            expect="start",
            recordings=recordings,
            phases=phases,
            judged=("after",),
            marks=(Mark("start", 0.0),),
            twin=lambda spec: spec.with_settings(robot_seed=0),  # the shipped baseline's
            baseline=choice,
        )

    return [
        start("start-cold", "no baseline at all", "none", poses),
        start("start-other-leg", "the baseline of the opposite leg", "other_leg", poses),
        start("start-other-robot", "a baseline, but of another robot", "shipped", others),
    ]


def steady(sizes: Sizes) -> list[Scenario]:
    """Nothing changes."""
    pose_s = sizes.before_s + sizes.slow_s + sizes.slow_after_s
    walk_s = 20.0 + sizes.contact_swings * WALK_SWING_S
    walks = tuple(walk_run(sizes, run, walk_s) for run in range(walks_without_change(sizes)))
    about = "nothing changes, hours over rough ground"
    return [
        _still("steady-pose", "nothing changes", pose_runs(sizes, pose_s), pose_s),
        # Hours of walking; the one in between has the contact runs.
        _still("steady-walk", about, walks, walk_s, ("frozen", "full")),
    ]


QUADRUPED: Final = "quadruped12"
LEG: Final = "leg5"
_RUBS: Final = What("friction", 4.0)


def other_robots(sizes: Sizes) -> list[Scenario]:
    """The rows of both robots."""
    at_s, end_s = sizes.walk_before_s, sizes.walk_before_s + sizes.walk_after_s
    trots, trot_s = _runs("trot", sizes, end_s)
    walks, _ = _runs("walk", sizes, end_s)
    poses, pose_s = _runs(None, sizes, end_s)
    still = "nothing changes: a quadruped {} over rough ground"
    trot = "a trotting quadruped: its joints rub 4 times as much"
    pose = "a leg of five joints: they rub 4 times as much"
    return [
        _still("quadruped12-trot", still.format("trots"), trots, end_s),
        _still("quadruped12-walk", still.format("walks"), walks, end_s),
        _change("quadruped12-friction4", trot, at_s, end_s, trots, _RUBS, swing_s=trot_s),
        _still("leg5-plates", "nothing changes: a leg of five joints meets plates", poses, end_s),
        _change("leg5-friction4", pose, at_s, end_s, poses, _RUBS, swing_s=pose_s),
    ]


def _runs(
    gait: GaitName | None, sizes: Sizes, seconds: float
) -> tuple[tuple[RecordingSpec, ...], float]:
    """As many runs as give the leg-runs, and how long a swing's cycle takes, s."""
    name = LEG if gait is None else QUADRUPED
    settings = SimulationSettings.from_robot(name, "pose" if gait is None else "walk", gait)
    motion = settings.motion
    if isinstance(motion, WalkSettings):
        cycle_s = motion.swing_s / GAITS[motion.gait].share
    else:
        assert isinstance(motion, PoseSettings)
        cycle_s = (2 * motion.segment_ticks + motion.hold_ticks) * settings.period_s
        plates = replace(motion.obstacles, probability=0.65)  # one comes under half of the descents
        settings = replace(settings, motion=replace(motion, obstacles=plates))
    legs = simulated_robot(name).layout.legs
    first = sizes.first_seed + {QUADRUPED: 600, LEG: 700}[name] + (50 if gait == "walk" else 0)
    count = math.ceil(sizes.leg_runs / len(legs))
    return tuple(
        RecordingSpec(replace(settings, seed=first + run), seconds, legs) for run in range(count)
    ), cycle_s


def scenarios(sizes: Sizes = FULL_SIZES) -> dict[str, Scenario]:
    """All scenarios, by name, in the order of the table."""
    made = [
        *steps(sizes),
        *slow_changes(sizes),
        *compound(sizes),
        *contacts(sizes),
        *walking_contacts(sizes),
        *trouble(sizes),
        *starts(sizes),
        *steady(sizes),
        *other_robots(sizes),
    ]
    return {scenario.name: scenario for scenario in made}


def named(names: Iterable[str], sizes: Sizes = FULL_SIZES) -> list[Scenario]:
    """Scenarios by their names, each once.

    Raises:
        ConfigurationError: there is no such scenario.
    """
    known = scenarios(sizes)
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known, "`scenarios list` shows them")
            raise ConfigurationError(f"no scenario '{name}'; {hint}")
    return [known[name] for name in dict.fromkeys(names)]
