"""Scenarios in which the leg stays as it is: contacts only, standing, trouble, starts, hours."""

from __future__ import annotations

from dataclasses import replace

from adaptive_contact_sim.encoder import EncoderSettings
from adaptive_contact_sim.terrain import TerrainKind
from adaptive_contact_sim.walk import WalkSettings
from adaptive_contact_studies.scenarios.runs import (
    POSE_SWING_S,
    WALK_SWING_S,
    Sizes,
    all_touch,
    around,
    lone_runs,
    of_robot_0,
    pose_runs,
    turn_runs,
    walk_run,
    walk_runs,
    walks_without_change,
    without_faults,
    without_staging,
)
from adaptive_contact_studies.scenarios.spec import (
    GOALS_VARIANTS,
    BaselineChoice,
    Expect,
    Mark,
    Phase,
    RecordingSpec,
    Scenario,
    Staging,
    Variant,
)

__all__ = ["contacts", "starts", "steady", "trouble", "walking_contacts"]


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
            motion="pose",
            expect=Expect.UNPOISONED,
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
            motion="walk",
            expect=Expect.UNPOISONED,
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
        motion="pose",
        expect=Expect.UNHARMED,
        recordings=turns,
        phases=(Phase("before", 0.0, round_s), Phase("after", round_s, 2 * round_s)),
        judged=("after",),
        marks=(Mark("swings again", round_s),),
    )
    at_s, end_s = sizes.before_s, sizes.before_s + sizes.after_s
    free_s = at_s + sizes.caught_s
    caught = Scenario(
        name="caught-30s",
        about=f"a foot hangs in a root for {sizes.caught_s:g} s, through all its swings",
        motion="pose",
        expect=Expect.RECOVER,
        recordings=lone_runs(sizes, end_s, Staging(caught_s=(at_s, free_s))),
        phases=(
            Phase("before", 0.0, at_s),
            Phase("caught", at_s, free_s),
            *around(free_s, end_s, POSE_SWING_S)[1:],
        ),
        judged=("after",),
        # It is caught when it next rests, so that it comes free up to a swing late.
        marks=(Mark("free again", free_s + POSE_SWING_S),),
        twin=without_staging,
        poisonous=True,
    )
    trailing = Scenario(
        name="trailing-2N",
        about=f"a foot trails a branch for {sizes.caught_s:g} s, 2 N against its motion",
        motion="pose",
        expect=Expect.RECOVER,
        recordings=lone_runs(sizes, end_s, Staging(caught_s=(at_s, free_s), trails_n=2.0)),
        phases=(
            Phase("before", 0.0, at_s),
            Phase("trailing", at_s, free_s),
            *around(free_s, end_s, POSE_SWING_S)[1:],
        ),
        judged=("after",),
        marks=(Mark("tangled", at_s), Mark("free again", free_s + POSE_SWING_S)),
        twin=without_staging,
    )
    faults = EncoderSettings(dropped=0.03, repeated=0.03)
    readings = Scenario(
        name="readings-3pct",
        about="of every joint's readings 3 % do not come, and 3 % are old ones",
        motion="pose",
        expect=Expect.UNHARMED,
        recordings=tuple(
            replace(spec, settings=replace(spec.settings, encoder=faults))
            for spec in pose_runs(sizes, end_s)
        ),
        phases=(Phase("all", 0.0, end_s),),
        judged=("all",),
        twin=without_faults,
    )
    return [stand, caught, trailing, readings]


def starts(sizes: Sizes) -> list[Scenario]:
    """With no baseline, and with wrong ones."""
    end_s = sizes.start_s
    settled = 60 * POSE_SWING_S  # the goal: valid after 60 swings
    phases = (Phase("start", 0.0, settled), Phase("after", settled, end_s))
    poses = pose_runs(sizes, end_s)
    others = tuple(
        replace(spec, settings=replace(spec.settings, robot_seed=1 + run))
        for run, spec in enumerate(poses)
    )

    def start(
        name: str, about: str, choice: BaselineChoice, recordings: tuple[RecordingSpec, ...]
    ) -> Scenario:
        return Scenario(
            name=name,
            about=about,
            motion="pose",
            expect=Expect.START,
            recordings=recordings,
            phases=phases,
            judged=("after",),
            marks=(Mark("start", 0.0),),
            twin=of_robot_0,
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
    walks = walks_without_change(sizes)

    def still(
        name: str, about: str, recordings: tuple[RecordingSpec, ...], seconds: float
    ) -> Scenario:
        walking = isinstance(recordings[0].settings.motion, WalkSettings)
        return Scenario(
            name=name,
            about=about,
            motion="walk" if walking else "pose",
            expect=Expect.QUIET,
            recordings=recordings,
            phases=(Phase("all", 0.0, seconds),),
            judged=("all",),
            # Hours of walking; the variants in between have the contact runs.
            variants=GOALS_VARIANTS if walking else tuple(Variant),
            mixed=not walking,
        )

    return [
        still("steady-pose", "nothing changes", pose_runs(sizes, pose_s), pose_s),
        still(
            "steady-walk",
            "nothing changes, hours over rough ground",
            tuple(walk_run(sizes, run, walk_s) for run in range(walks)),
            walk_s,
        ),
    ]
