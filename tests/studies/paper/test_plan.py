"""Streams of the paper's plan: seeds, parts that join, robots hung up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from adaptive_contact.model import leg_library
from adaptive_contact.robot import Robot
from adaptive_contact_studies.paper import data
from adaptive_contact_studies.paper.evaluation import jobs_of
from adaptive_contact_studies.paper.plan import FULL, QUICK, Plan
from adaptive_contact_studies.paper.rows import free_rows
from adaptive_contact_studies.work import Work

ROLES = ("train", "tune", "free", "stand", "touch")


@pytest.mark.parametrize("plan", [FULL, QUICK], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [0, 7])
def test_no_two_roles_share_a_seed(plan: Plan, seed: int) -> None:
    plan = dataclasses.replace(plan, seed=seed)
    by_role = [{p.settings.seed for p in plan.pieces(role)} for role in ROLES]
    assert sum(map(len, by_role)) == len(set().union(*by_role))
    other = dataclasses.replace(plan, seed=seed + 1)
    assert not set().union(*by_role) & {p.settings.seed for r in ROLES for p in other.pieces(r)}


def test_the_full_plan_holds_what_was_asked_for() -> None:
    swing_ticks = sum(p.seconds for p in FULL.pieces("free")) / 0.02 * 20 / 23
    assert swing_ticks >= 10 * 540_000
    assert len(FULL.leg_runs) >= 20
    assert (FULL.train_segments, FULL.test_segments) == (5000, 1000)


@pytest.mark.parametrize("plan", [FULL, QUICK], ids=lambda p: p.name)
@pytest.mark.parametrize("role", ["free", "stand", "touch"])
def test_every_piece_is_evaluated_once(plan: Plan, role: str) -> None:
    pieces = plan.pieces(role)
    jobs = jobs_of(plan, pieces)
    assert sorted(repr(p) for job in jobs for p in job.pieces) == sorted(map(repr, pieces))
    for job in jobs:
        assert len({p.leg_run.robot_seed for p in job.pieces}) == 1
        # No more samples at once than two processes can hold.
        assert sum(p.seconds for p in job.pieces) < 6000.0


def test_legs_of_a_hung_up_robot_come_from_one_simulation() -> None:
    plan = dataclasses.replace(QUICK, free_s={"descent": 4.0})
    pieces = plan.pieces("free")
    assert len({repr(piece.shot) for piece in pieces}) == 1
    legs = data.recorded(Work(None), pieces[0].shot)
    own = [legs[piece.leg_run.leg] for piece in pieces]
    assert all(leg.swing.any() and not leg.onsets for leg in own)
    assert np.abs(own[0].desired - own[1].desired).max() > 0.1  # each moves on its own


def test_the_papers_segments_come_in_parts_that_join(robot: Robot) -> None:
    plan = dataclasses.replace(QUICK, train_segments=2000, test_segments=40)
    pieces = plan.paper_pieces("train")
    assert len(pieces) == 4
    assert sum(p.seconds for p in pieces) == pytest.approx(1000 * 23 * 0.02 + 4 * 1.0)
    seeds = [p.settings.seed for role in ("train", "tune") for p in plan.paper_pieces(role)]
    assert len(set(seeds)) == 5
    work = Work(None)
    streams = [data.load(work, dataclasses.replace(p, seconds=8.0)) for p in pieces[:3]]
    joined = data.join(streams)
    assert len(joined.swing) == 3 * 400
    # Windows of the whole are those of the parts: none reaches over a seam.
    for name in ("servo", "paper"):
        library = leg_library(robot, robot.leg("rf"), name)
        whole, parts = free_rows(joined, library), [free_rows(s, library) for s in streams]
        assert len(whole.swing) > 500
        # All but the last of a part that was cut within a swing: the next part begins in touch.
        tick = np.concatenate([p.windows.tick + 400 * i for i, p in enumerate(parts)])
        assert len(tick) - len(whole.swing) <= 2
        kept = np.isin(tick, whole.windows.tick)
        for mine, theirs in zip(
            whole.windows[:4], zip(*(p.windows[:4] for p in parts), strict=True), strict=True
        ):
            np.testing.assert_array_equal(mine, np.concatenate(theirs)[kept])
    last = streams[2].arrays
    assert [o.t_ns for o in joined.arrays.onsets[-len(last.onsets) :]] == [
        o.t_ns + 800 * data.TICK_NS for o in last.onsets
    ]
