"""`replay --plot`: what a picture says of touches is what truth, events and ratios are."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.cli._replay_plot import write_plot
from adaptive_contact.core.bank import LearnerBank
from adaptive_contact.model.model_file import shipped_baseline
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.recording import Record
from adaptive_contact.service.replay import (
    Counts,
    LegTrace,
    Touch,
    TraceBank,
    replay_events,
)
from adaptive_contact.service.replay import why_missed as why_missed
from adaptive_contact.wire import (
    MSGPACK,
    ContactEvent,
    ContactTruth,
    ServoSample,
    decode,
    encode,
)
from stepping import step

MS = 1_000_000
TICK = 20 * MS


def trace(leg: str = "lf", ticks: int = 100, *touches: Touch) -> LegTrace:
    ratio = np.full(ticks, 0.25)
    ratio[ticks // 2] = 7.5
    ratio[0] = np.nan
    return LegTrace(
        leg=leg,
        t_s=np.arange(ticks) * 0.02,
        ratio=ratio,
        p=np.where(np.arange(ticks) < ticks // 2, np.nan, 0.75),
        stance=[(0.0, 0.5)],
        contact=[(0.1, 0.4)],
        truth=[(0.1, 0.45)],
        touches=touches,
        joints=["coxa", "femur", "tibia"],
        angles=np.zeros((ticks, 3, 3)),
    )


def data_of(page: str) -> dict[str, object]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(found[1])


@pytest.mark.parametrize(
    ("ratios", "says"),
    [
        ([0.2, 0.62, 0.3], "at most 0.62 times the threshold, 38% below it"),
        ([0.2, np.nan, np.nan], "at most 0.20"),
        ([np.nan] * 3, "no tick could be judged"),
        ([0.2, 1.4, 0.3], "reached 1.40 times the threshold"),
    ],
)
def test_a_miss_says_how_far_below_the_threshold(ratios: list[float], says: str) -> None:
    t_ns = np.array([0, 1, 2, 3, 4], dtype=np.int64) * TICK
    # Ticks at the onset and after the end say nothing of the touch.
    whole = np.array([9.0, *ratios, 9.0])
    assert says in why_missed(t_ns, whole, 0, 3 * TICK, [])
    assert "withheld" in why_missed(t_ns, whole, 0, 3 * TICK, [2 * TICK])
    assert "no sample" in why_missed(t_ns, whole, 10 * TICK, 11 * TICK, [])


def standing_records(swings: int) -> list[Record]:
    """A leg that follows its commands, and a truth that has a touch in the middle of a swing."""
    records = []
    for k in range(40 * swings):
        phase = k % 40
        angles, word = step(k)
        sample = ServoSample(t_ns=k * TICK, seq=k, measured=angles, desired=angles, phase=word)
        records.append(Record("robot/leg/rf/servo", encode(sample), MSGPACK, k * TICK, k * TICK))
        if phase in (0, 22):
            change = ContactTruth(t_ns=k * TICK + MS, contact=phase == 22, force=2.0, speed_m_s=0.2)
            records.append(
                Record("robot/leg/rf/truth", encode(change), MSGPACK, k * TICK, k * TICK)
            )
    return records


@pytest.fixture(scope="module")
def replayed() -> tuple[list[ContactEvent], LegTrace]:
    """Events of a replay, and what it traces: that changes no event."""
    robot = shipped_robot()
    baseline = shipped_baseline(robot.name)
    plain = list(replay_events(standing_records(4), LearnerBank(robot, baseline), Counts()))
    bank = TraceBank(LearnerBank(robot, baseline))
    records = bank.gather(standing_records(4))
    assert list(replay_events(records, bank, Counts())) == plain
    (found,) = bank.traces()
    return plain, found


def test_ratios_are_those_of_the_events(replayed: tuple[list[ContactEvent], LegTrace]) -> None:
    plain, found = replayed
    assert found.leg == "rf"
    assert len(found.t_s) == len(found.ratio) == 160
    assert np.isfinite(found.ratio).sum() > 40
    for event in plain:
        if event.contact:
            # An event's score may be lowered where the model extrapolates, never raised.
            tick = np.flatnonzero(np.isclose(found.t_s, event.t_ns / 1e9))[0]
            assert found.ratio[tick] >= event.score * (1 - 1e-9)
    # The first change says "no contact": the leg was loaded until then.
    begins = [round(begin, 3) for begin, _ in found.truth]
    assert begins == [0.0, 0.441, 1.241, 2.041, 2.841]
    assert len(found.touches) >= 4


def test_the_page_needs_nothing_from_elsewhere_and_shows_text_as_text(tmp_path: Path) -> None:
    out = tmp_path / "plot.html"
    evil = "</script><script>alert(1)</script>"
    write_plot(out, [trace("lf", 100, Touch(0.5, "miss", evil))], evil)
    page = out.read_text()
    assert not re.findall(r"https?:|src=|@import|url\(", page)
    assert "default-src 'none'" in page
    assert page.count("</script>") == 2
    held = data_of(page)
    assert held["title"] == evil
    assert held["touches"] == [{"leg": 0, "at": 0.5, "kind": "miss", "why": evil}]


def test_a_long_recording_is_drawn_in_bounded_size_without_losing_a_peak(tmp_path: Path) -> None:
    out = tmp_path / "plot.html"
    ticks = 1_000_000
    hits = [Touch(i / 50, "hit", "found") for i in range(30_000)]
    write_plot(out, [trace("lf", ticks, *hits, Touch(700.0, "miss", "why"))], "long")
    assert out.stat().st_size < 8_000_000
    held = data_of(out.read_text())
    (leg,) = held["legs"]  # type: ignore[misc]
    assert max(leg["ratio"]) == 750
    assert leg["p"] == sorted(leg["p"])  # unknown, then 75 %
    assert set(leg["p"]) == {-1, 75}
    assert leg["merged"] == 3
    assert held["left_out"] == 10_001
    assert any(touch["kind"] == "miss" for touch in held["touches"])  # type: ignore[attr-defined]


def test_curves_are_the_samples(
    tmp_path: Path, replayed: tuple[list[ContactEvent], LegTrace]
) -> None:
    _, found = replayed
    angles = found.angles
    assert angles.shape == (160, 3, 3)
    samples = [decode(record.payload, ServoSample) for record in standing_records(4)]
    measured = [sample.measured for sample in samples if isinstance(sample, ServoSample)]
    assert angles[:, 0] == pytest.approx(np.array(measured)[: len(angles)], abs=1e-6)
    judged = np.isfinite(angles[:, 2, 0])
    assert judged.sum() > 40
    assert np.abs(angles[judged, 2] - angles[judged, 0]).max() < 0.2
    out = tmp_path / "plot.html"
    write_plot(out, [found], "walk")
    (leg,) = data_of(out.read_text())["legs"]  # type: ignore[misc]
    assert [joint["name"] for joint in leg["joints"]] == ["coxa", "femur", "tibia"]
    assert leg["curve_ms"] == [20 * k for k in range(160)]
    assert leg["joints"][1]["measured"][7] == round(angles[7, 0, 1] * 1e4)
    assert [value is not None for value in leg["joints"][1]["predicted"]] == judged.tolist()
