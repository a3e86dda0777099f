"""Results on disk: resumed is the same as uninterrupted, damaged is made anew."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import leg_library
from adaptive_contact.robot import shipped_robot
from adaptive_contact_studies.cache import Store, plain
from adaptive_contact_studies.paper import data
from adaptive_contact_studies.paper.evaluation import jobs_of
from adaptive_contact_studies.paper.plan import FULL, QUICK, Plan
from adaptive_contact_studies.paper.rows import free_rows

SMALL = dataclasses.replace(
    QUICK,
    legs=("rf", "lm"),
    train_s={"descent": 3.0},
    tune_s={"descent": 3.0},
    train_hung_s={"descent": 3.0},
    tune_hung_s={},
    free_s={"descent": 4.0},
    stand_s={"descent": 2.0},
    touch_s={"hard": 4.0},
    tune_touch_s={"hard": 2.0},
)
ROLES = ("train", "tune", "free", "stand", "touch")


@pytest.mark.parametrize("plan", [FULL, QUICK, SMALL], ids=lambda p: p.name)
@pytest.mark.parametrize("seed", [0, 1, 7])
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


def test_streams_come_back_as_they_were_simulated(tmp_path: Path) -> None:
    store = Store(tmp_path)
    piece = SMALL.pieces("touch")[0]
    data.record_all(store, [piece], 1, lambda _: None)
    read = data.load(store, piece)
    from adaptive_contact_studies.paper.recording import record_leg

    made = record_leg(piece.settings, piece.leg_run.leg, piece.seconds)
    np.testing.assert_array_equal(read.measured, made.measured)
    np.testing.assert_array_equal(read.desired, made.desired)
    np.testing.assert_array_equal(read.swing, made.swing)
    assert read.arrays.releases_ns == made.releases_ns
    assert [o.t_ns for o in read.arrays.onsets] == [o.t_ns for o in made.onsets]
    assert any(o.speed_m_s for o in read.arrays.onsets)


def test_an_interrupted_run_goes_on_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pieces = [p for role in ("free", "stand", "touch") for p in SMALL.pieces(role)]
    whole, broken = Store(tmp_path / "whole"), Store(tmp_path / "broken")
    data.record_all(whole, pieces, 1, lambda _: None)
    calls, record = [], data.record_piece

    def interrupted(job: object) -> float:
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(job)
        return record(job)

    monkeypatch.setattr(data, "record_piece", interrupted)
    with pytest.raises(KeyboardInterrupt):
        data.record_all(broken, pieces, 1, lambda _: None)
    monkeypatch.setattr(data, "record_piece", record)
    done = [p for p in pieces if data.piece_path(broken, p).exists()]
    assert 0 < len(done) < len(pieces)
    told: list[float] = []
    data.record_all(broken, pieces, 1, told.append)
    assert sum(told) == pytest.approx(sum(p.seconds for p in pieces))
    for piece in pieces:
        a, b = data.load(whole, piece), data.load(broken, piece)
        np.testing.assert_array_equal(a.measured, b.measured)
        np.testing.assert_array_equal(a.desired, b.desired)


def test_processes_give_the_same_as_one(tmp_path: Path) -> None:
    pieces = SMALL.pieces("stand")
    one, two = Store(tmp_path / "one"), Store(tmp_path / "two")
    data.record_all(one, pieces, 1, lambda _: None)
    data.record_all(two, pieces, 2, lambda _: None)
    for piece in pieces:
        np.testing.assert_array_equal(
            data.load(one, piece).measured, data.load(two, piece).measured
        )


def test_legs_of_a_hung_up_robot_come_from_one_simulation(tmp_path: Path) -> None:
    store = Store(tmp_path)
    pieces = SMALL.pieces("free")
    data.record_all(store, pieces, 1, lambda _: None)
    streams = [data.load(store, p) for p in pieces]
    assert {s.leg for s in streams} == {"rf", "lm"}
    for stream in streams:
        assert not stream.arrays.onsets
        assert stream.swing.mean() > 0.5
        # The leg follows its command, as it does standing.
        lagged = stream.measured[60:] - stream.desired[57:-3]
        assert np.degrees(np.abs(lagged)).mean() < 15.0
        assert np.degrees(np.abs(np.diff(stream.measured, axis=0))).max() > 4.0


def test_damaged_results_are_made_anew(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.arrays("a", [1], lambda: {"x": np.arange(3)})["x"].tolist() == [0, 1, 2]
    assert store.tree("t", [1], lambda: {"x": (1, 2.5, float("nan"))}) == {"x": [1, 2.5, None]}
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:10])
    made = []
    store.arrays("a", [1], lambda: made.append(1) or {"x": np.arange(3)})
    store.tree("t", [1], lambda: made.append(2) or {})
    assert made == [1, 2]
    store.tree("t", [1], lambda: made.append(3) or {})
    assert made == [1, 2]
    assert store.path("t", [1], ".json") != store.path("t", [2], ".json")


def test_source_that_changes_meanwhile_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from adaptive_contact_studies.paper import recording as store

    store.source_fingerprint()
    store.require_unchanged_source()
    monkeypatch.setattr(store, "source_now", lambda: "other")
    with pytest.raises(ConfigurationError, match="start the same command again"):
        data.record_all(Store(tmp_path), SMALL.pieces("stand"), 2, lambda _: None)


def test_the_papers_segments_come_in_parts_that_join(tmp_path: Path) -> None:
    plan = dataclasses.replace(QUICK, train_segments=2000, test_segments=40)
    pieces = plan.paper_pieces("train")
    assert len(pieces) == 4
    trial = 23 * 0.02
    assert sum(p.seconds for p in pieces) == pytest.approx(1000 * trial + 4 * 1.0)
    seeds = [p.settings.seed for role in ("train", "tune") for p in plan.paper_pieces(role)]
    assert len(set(seeds)) == 5
    short = [dataclasses.replace(p, seconds=8.0) for p in pieces[:3]]
    store = Store(tmp_path)
    streams = [data.load(store, p) for p in short]
    joined = data.join(streams)
    assert len(joined.swing) == 3 * 400
    assert joined.piece.seconds == 24.0
    # Windows of the whole are those of the parts: none reaches over a seam.
    robot = shipped_robot()
    for name in ("servo", "paper"):
        library = leg_library(robot, robot.leg("rf"), name)
        whole = free_rows(joined, library)
        parts = [free_rows(s, library) for s in streams]
        assert len(whole.swing) > 500
        # All but the last of a part that was cut within a swing: the next part begins in touch.
        tick = np.concatenate([p.windows.tick + 400 * i for i, p in enumerate(parts)])
        assert len(tick) - len(whole.swing) <= 2
        kept = np.isin(tick, whole.windows.tick)
        for mine, theirs in zip(
            whole.windows[:4], zip(*(p.windows[:4] for p in parts), strict=True), strict=True
        ):
            np.testing.assert_array_equal(mine, np.concatenate(theirs)[kept])
        assert len(np.unique(whole.swing)) == sum(len(np.unique(p.swing)) for p in parts)
    last = streams[2].arrays
    assert [o.t_ns for o in joined.arrays.onsets[-len(last.onsets) :]] == [
        o.t_ns + 800 * data.TICK_NS for o in last.onsets
    ]


@pytest.mark.parametrize("plan", [FULL, QUICK], ids=lambda p: p.name)
@pytest.mark.parametrize("role", ["free", "stand", "touch"])
def test_every_piece_is_evaluated_once(plan: Plan, role: str, tmp_path: Path) -> None:
    pieces = plan.pieces(role)
    jobs = jobs_of(tmp_path, plan, pieces)
    assert sorted(repr(p) for job in jobs for p in job.pieces) == sorted(map(repr, pieces))
    for job in jobs:
        assert len({p.leg_run.robot_seed for p in job.pieces}) == 1
        # No more samples at once than two processes can hold.
        assert sum(p.seconds for p in job.pieces) < 6000.0


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigurationError, match="--out"):
        Store(tmp_path / "file" / "below")


def test_plain_trees_hold_no_not_a_number() -> None:
    tree = {"a": np.array([1.0, np.inf]), "b": (np.int64(3), np.bool_(True)), "c": {2, 1}}
    assert plain(tree) == {"a": [1.0, None], "b": [3, True], "c": [1, 2]}
