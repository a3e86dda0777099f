"""What the detection study counts: the headline, false alarms, tails, limits, and who wins."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import numpy as np
import pytest

from adaptive_contact.learn.mode import LearnerMode
from adaptive_contact.leg_learner import ContactLearner
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events, LegStream, Row, TruthChanges, summarise
from adaptive_contact_studies.cache import plain
from adaptive_contact_studies.evaluate import samples_of
from adaptive_contact_studies.paper import detection as study
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.evaluation import (
    AIM,
    AIMS,
    FACTORS,
    at_other_aims,
    play_streams,
    tail_of,
)
from adaptive_contact_studies.paper.plan import FULL, LegRun, Piece
from adaptive_contact_studies.paper.tables import part
from adaptive_contact_studies.paper.touched import (
    BOTH,
    SLOW_FAST,
    Touched,
    binned,
    by_kind,
    headline_streams,
    late_events,
    misses,
    outcome_of,
    peaks,
    rows_of,
    slips,
    what_alarms_are,
)
from adaptive_contact_studies.paper.verdicts import losses
from adaptive_contact_studies.show.pages import read_sections

TICK_NS = 20_000_000
TRIAL, SWING, TOUCH = 40, 35, 20  # ticks: of a trial, of its swing, from its begin to a touch


def events(ticks: list[int]) -> Events:
    t_ns = np.array(ticks, dtype=np.int64) * TICK_NS
    return Events(t_ns, np.ones(len(ticks), dtype=bool), t_ns)


def touched(
    kind: str, speeds: list[float | None], told: list[list[int]], force_n: float = 5.0
) -> Touched:
    """A stream of swings with a touch of each speed (None: without), and events told.

    Events are ticks after the begin of their own swing.
    """
    n = TRIAL * len(speeds) + 5
    tick = np.arange(n)
    inside = (tick % TRIAL >= TRIAL - SWING) & (tick < TRIAL * len(speeds))
    begin = [TRIAL * i + TRIAL - SWING for i in range(len(speeds))]
    onsets = [b + TOUCH for b, s in zip(begin, speeds, strict=True) if s is not None]
    # Let go in the stance that follows.
    changes = sorted([(o, True) for o in onsets] + [(o - TOUCH + SWING + 2, False) for o in onsets])
    fast = iter([s for s in speeds if s is not None])
    truth = TruthChanges(
        t_ns=np.array([t * TICK_NS - 5_000_000 * c for t, c in changes], dtype=np.int64),
        contact=np.array([c for _, c in changes], dtype=bool),
        speed_m_s=np.array([next(fast) if c else np.nan for _, c in changes]),
        soft=np.zeros(len(changes), dtype=bool),
        grazing=np.zeros(len(changes), dtype=bool),
        force_n=np.full(len(changes), force_n),
    )
    when = [b + e for b, own in zip(begin, told, strict=True) for e in own]
    number = np.where(inside, tick // TRIAL, -1)
    piece = dataclasses.replace(
        FULL.pieces("touch")[0], leg_run=LegRun(0, "rf"), kind=kind, role="touch"
    )
    score = np.full(n, 0.1)
    score[when] = 3.0
    stream = LegStream("rf", tick * TICK_NS, inside, truth)
    return Touched(
        piece, stream, number, inside.copy(), {"servo ratio": score}, {"default": events(when)}
    )


@pytest.fixture
def streams() -> list[Touched]:
    """Three fast touches that are found; slowly approached, two fast ones missed, one found."""
    return [
        touched("hard", [0.5, 0.9, 0.3], [[TOUCH], [TOUCH + 1], [TOUCH]]),
        touched("hard slow", [0.4, 0.05, 0.6], [[], [TOUCH + 12], []]),
    ]


def test_fast_touches_in_slow_approaches_have_rows_of_their_own(streams: list[Touched]) -> None:
    outcomes = [outcome_of(t, "default") for t in streams]
    rows = rows_of(streams, outcomes)
    assert {name: (row["found"], row["touches"]) for name, row in rows.items()} == {
        "headline": (3, 3),
        SLOW_FAST: (0, 2),
        BOTH: (3, 5),
        "slow": (1, 1),
    }
    assert list(rows)[:3] == ["headline", SLOW_FAST, BOTH]
    # Nothing is hidden: all the score's own headline touches are in both.
    assert rows[BOTH]["touches"] == summarise(outcomes).rows[Row.HEADLINE].touches


def test_misses_kinds_and_limits_hold_to_the_same_headline(streams: list[Touched]) -> None:
    outcomes = {"default": [outcome_of(t, "default") for t in streams]}
    assert misses(streams, outcomes, slow=False) == []
    assert [m["speed_m_s"] for m in misses(streams, outcomes, slow=True)] == [0.4, 0.6]
    kinds = by_kind(streams, outcomes["default"])
    assert kinds["hard"]["headline"]["touches"] == 3
    assert kinds["hard slow"]["headline"] is None
    bins = binned(streams, outcomes["default"], "speed_m_s", (0.0, 0.1, 0.2, 2.5), ())
    assert [b["touches"] for b in bins] == [1, 0, 3]
    assert [b["found"] for b in bins] == [1, 0, 3]


def test_slips_are_fast_touches_soon_after_another_contact(streams: list[Touched]) -> None:
    """The second contact of a swing, 100 ms after the first has let go."""
    t = streams[1]
    first = t.truth.truth
    onset = int(first.t_ns[0])
    truth = TruthChanges(
        t_ns=onset + np.array([0, 60, 160, 400]) * 1_000_000,
        contact=np.array([True, False, True, False]),
        speed_m_s=np.array([0.05, np.nan, 0.6, np.nan]),
        soft=np.zeros(4, dtype=bool),
        grazing=np.zeros(4, dtype=bool),
        force_n=np.full(4, 5.0),
    )
    slipped = t._replace(truth=dataclasses.replace(t.truth, truth=truth))
    assert slips([slipped]) == {"touches": 1, "soon": 1}
    assert slips(streams) == {"touches": 2, "soon": 0}


def test_curves_are_of_the_headlines_touches(streams: list[Touched]) -> None:
    quiet = {
        "free": {
            "ticks": 540_000,
            "alarms": {
                "servo ratio": np.concatenate([np.full(5, -1), np.arange(len(FACTORS) - 5)[::-1]])
            },
            "online": dict.fromkeys((f"aim {a:g}" for a in AIMS), 2),
            "online_ticks": dict.fromkeys((f"aim {a:g}" for a in AIMS), 270_000),
        }
    }
    curve = study.curve_of("servo ratio", streams, quiet)
    assert len(curve) == len(FACTORS) - 5  # thresholds too low to be counted have no point
    assert {p["touches"] for p in curve} == {3}
    at_aim = next(p for p in curve if abs(p["factor"] - 1.0) < 1e-6)
    assert at_aim["recall"] == 1.0
    assert at_aim["per_hour"] == len(FACTORS) - 1 - AIM
    # Scores of 3 pass a threshold of 1, none of 10.
    assert curve[-1]["factor"] == pytest.approx(10.0)
    assert curve[-1]["recall"] == 0.0
    played = [t._replace(events={f"aim {a:g}": t.events["default"] for a in AIMS}) for t in streams]
    points = study.curve_of_aims(played, quiet)
    assert [p["aim"] for p in points] == list(AIMS)
    assert {(p["touches"], p["recall"], p["per_hour"]) for p in points} == {(3, 1.0, 4.0)}


def test_the_sweep_is_wide_and_holds_the_aim() -> None:
    assert FACTORS[AIM] == pytest.approx(1.0)
    assert FACTORS[0] == pytest.approx(1e-3)
    assert len(FACTORS) > 41


def test_false_alarms_among_contacts_are_told_apart() -> None:
    stream = touched(
        "hard",
        [0.5, 0.5, 0.5, None],
        [[TOUCH, TOUCH + 9], [SWING + 3], [3, TOUCH], [8, 20]],  # the second after its release
    )
    outcome = outcome_of(stream, "default")
    assert what_alarms_are([outcome]) == {"again": 1, "late": 1, "early": 1, "untouched": 2}


def test_touches_told_after_their_time_are_counted() -> None:
    """120 ms are allowed at 0.15 m/s: 5 ticks after is found, 10 late, 30 not at all."""
    stream = touched("hard", [0.15] * 4, [[TOUCH + 5], [TOUCH + 10], [], [TOUCH + 14]])
    assert late_events([outcome_of(stream, "default")], Row.MID) == {"missed": 3, "late": 2}


def test_the_hardest_touches_are_in_the_last_bin() -> None:
    strong = touched("hard", [0.5], [[TOUCH]], force_n=150.0)
    bins = binned([strong], [outcome_of(strong, "default")], "force_n", study.FORCE_EDGES_N, ())
    assert bins[-1]["touches"] == 1
    assert plain(bins[-1])["high"] is None


def test_peaks_are_the_highest_scores_after_a_headline_touch(streams: list[Touched]) -> None:
    found = peaks(streams, "servo ratio")
    assert found == pytest.approx([3.0, 3.0, 3.0])
    assert peaks(streams[1:], "servo ratio") is None  # slow approaches only
    assert len(headline_streams(streams)) == 1


def test_a_tail_counts_free_ticks_above_every_threshold() -> None:
    rng = np.random.default_rng(5)
    n = 4000
    score = 10.0 ** rng.uniform(-4.0, 1.5, n)
    free = rng.random(n) < 0.7
    score[~free] = 50.0  # never counted
    descending = np.arange(n) % 40 >= 25

    class Own:
        pass

    own: Any = Own()
    own.free, own.descending = free, descending
    told = tail_of(own, score)
    assert int(told["known"]) == free.sum()
    expected = [(score[free] > factor).sum() for factor in FACTORS]
    np.testing.assert_array_equal(told["above"], expected)
    after = np.isin(np.arange(n) % 40, range(25, 30))
    top = free & (score > 0.1)
    assert told["top"].tolist() == [top.sum(), (top & after).sum()]
    assert int(told["near"]) == (free & after).sum()


def test_a_step_at_the_foot_is_read_off_the_robots_description(robot: Robot) -> None:
    """52, 66 and 138 mm, 0.29° a step: from each joint to a stretched leg's foot."""
    limits = study.limits_of(robot)
    step = np.radians(300.0 / 1023.0)
    assert limits["step_m"]["tibia"] == pytest.approx(0.138 * step, rel=2e-3)
    assert limits["step_m"]["femur"] == pytest.approx(0.204 * step, rel=2e-3)
    assert limits["step_m"]["coxa"] == pytest.approx(0.256 * step, rel=2e-3)
    assert limits["step_n"]["femur"] == pytest.approx(1.5 / 32 / 0.204)


def figures(**changed: Any) -> dict[str, Any]:
    """One detector's tree, as plain numbers."""

    def share(value: float) -> dict[str, Any]:
        return {"recall": value, "interval": [value - 0.01, value + 0.01], "touches": 100}

    tree = {
        "summary": {
            "rows": {
                "headline": share(0.99) | {"median_ms": 18.0, "p95_ms": 30.0, "p99_ms": 60.0},
                "mid": share(0.5),
            },
            "precision": 0.95,
            "precision_interval": [0.94, 0.96],
        },
        "kinds": {"hard": share(0.99), "graze": share(0.9)},
        "false_alarms": {"all": {"per_hour": 1.0, "interval": [0.5, 2.0]}},
        "by_speed": [{"low": 0.1, "high": 0.2, **share(0.5)}],
        "by_force": [{"low": 13.0, "high": None, **share(0.97)}],
        "mid": {"missed": 3, "late": 2},
    }
    tree.update(copy.deepcopy(changed))
    return tree


def test_every_figure_that_another_does_better_is_said() -> None:
    default, other, silent = figures(), figures(), figures()
    other["summary"]["rows"]["mid"] = {"recall": 0.9, "interval": [0.8, 0.95]}
    other["summary"]["rows"]["headline"]["p99_ms"] = 29.0
    other["kinds"]["graze"] = {"recall": 0.905, "interval": [0.89, 0.92]}
    other["by_force"][0]["recall"] = 0.98
    silent["summary"]["rows"]["headline"] |= {"recall": 0.02, "median_ms": 2.0, "p95_ms": 2.0}
    silent["summary"]["precision"], silent["false_alarms"]["all"]["per_hour"] = 1.0, 0.0
    data = {
        "figures": {"default": default, "other": other, "silent": silent},
        "detectors": {"default": "D", "other": "the other", "silent": "S"},
    }
    found = losses(data)
    assert [(loss.what, loss.best, loss.apart) for loss in found] == [
        ("p99 latency", "other", None),
        ("recall, row `mid`", "other", True),
        ("recall, streams `graze`", "other", False),
        ("recall, 13 and more N", "other", False),
    ]
    text = part("losses", data)
    assert "| recall, row `mid` | 50.0 % | 90.0 % | the other | 99.0 % | 1.00 | yes |" in text
    _, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == len(found)


def test_the_limits_say_how_late_the_missed_ones_come(robot: Robot) -> None:
    names = ("default", "servo ratio", "paper rule", "analytical ratio", "tracking")
    data: dict[str, Any] = {
        "figures": {name: figures() for name in names},
        "detectors": {name: name for name in names},
        "limits": plain(study.limits_of(robot)),
    }
    (section,) = read_sections(part("limits", data))
    assert "1.31 mm of the coxa, 1.04 mm of the femur, 0.71 mm of the tibia" in section.text
    assert "Of the 3 the default missed there, 2 are reported after all" in section.text
    assert section.tables[1].rows[0][0] == "13 and more"
    assert "best in all bins of speed and force" in section.text
    other = data["figures"]["tracking"]
    other["by_force"][0] |= {"recall": 0.98, "interval": [0.97, 0.99]}
    text = part("limits", data)
    assert "not the best in bins of speed and force: 13 and more N** (table below; nowhere" in text
    other["by_speed"][0] |= {"recall": 0.9, "interval": [0.8, 0.95]}
    text = part("limits", data)
    assert "0.1 to 0.2 m/s; 13 and more N**" in text
    assert "intervals are apart in 0.1 to 0.2 m/s)" in text


def test_the_ungated_learner_is_the_products_own(robot: Robot, touched_stream: Stream) -> None:
    baseline = shipped_baseline(robot.name)
    if baseline is None:
        pytest.skip("no shipped baseline: run `make baseline`")
    (told,) = play_streams(robot, {0: baseline}, [touched_stream], mode=LearnerMode.UNGATED)
    learner = ContactLearner(robot, "rf", baseline, mode=LearnerMode.UNGATED)
    expected = Events.of(
        [
            event
            for sample in samples_of(touched_stream.run, "rf")
            if (event := learner.update(sample)) is not None
        ]
    )
    for a, b in zip(told, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    (default,) = play_streams(robot, {0: baseline}, [touched_stream])
    assert len(told.t_ns) != len(default.t_ns) or (told.t_ns != default.t_ns).any()


def test_an_aim_of_many_alarms_tells_more(robot: Robot, touched_stream: Stream) -> None:
    baseline = shipped_baseline(robot.name)
    if baseline is None:
        pytest.skip("no shipped baseline: run `make baseline`")
    known = {0: baseline}
    (own,) = play_streams(robot, known, [touched_stream])
    aim = robot.detector.false_alarms_per_hour
    (same,) = play_streams(robot, known, [touched_stream], per_hour=aim)
    (many,) = play_streams(robot, known, [touched_stream], per_hour=1e4)
    np.testing.assert_array_equal(own.t_ns, same.t_ns)
    assert np.count_nonzero(many.contact) > np.count_nonzero(own.contact)


def test_other_aims_are_played_on_every_collision_and_the_first_robots_free_motion() -> None:
    def played(piece: Piece) -> bool:
        return at_other_aims(FULL, piece)

    assert all(map(played, FULL.pieces("touch")))
    free = FULL.pieces("free")
    assert {p.leg_run.robot_seed for p in free if played(p)} == {0}
    assert {p.leg_run.leg for p in free if played(p)} == set(FULL.legs)
