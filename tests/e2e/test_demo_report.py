"""What the demo says about a recording: in words and in figures, for services good and bad."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.robot import Robot, shipped_robot
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.wire import (
    ContactEvent,
    ContactTruth,
    ServoSample,
    contact_key,
    decode,
    leg_of_key,
)

pytest.importorskip("mujoco", reason="the extra 'sim' is not installed")
pytest.importorskip("matplotlib", reason="the extra 'plot' is not installed")

from matplotlib.backends.backend_agg import FigureCanvasAgg

from adaptive_contact.cli.demo.report import draw, drawn
from adaptive_contact.cli.demo.settings import DemoSettings
from adaptive_contact.cli.demo.summary import outcome_words, percent, touches_words
from adaptive_contact.cli.demo.verdict import Verdict, judge
from adaptive_contact_sim import (
    SimulationSettings,
    TerrainSettings,
    WalkSettings,
    parse_drift,
    record_file,
)

SECONDS = 30.0
DRIFT_S = 12.0
SETTINGS = DemoSettings(seconds=SECONDS)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return shipped_robot()


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk in which leg rf gets stiff and muddy, without events."""
    path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    specs = (f"friction:leg=rf,value=4@{DRIFT_S}s", f"mass:leg=rf,value=0.06@{DRIFT_S}s")
    settings = SimulationSettings(
        motion=WalkSettings(),
        terrain=TerrainSettings(kind="rough"),
        seed=6,
        drift=tuple(parse_drift(spec) for spec in specs),
    )
    record_file(settings, SECONDS, path)
    return path


def ideal(walk: Path) -> Iterator[ContactEvent]:
    """What a service without fault would say: each touch at the first sample after it."""
    samples: dict[str, list[int]] = {}
    touches = []
    for record in read_recording(walk):
        leg = leg_of_key(record.key)
        if record.key.endswith("/servo"):
            sample = decode(record.payload, ServoSample, record.encoding)
            assert leg is not None
            assert isinstance(sample, ServoSample)
            samples.setdefault(leg, []).append(sample.t_ns)
        elif record.key.endswith("/truth"):
            truth = decode(record.payload, ContactTruth, record.encoding)
            assert isinstance(truth, ContactTruth)
            touches.append((leg, truth))
    for leg, truth in touches:
        assert leg is not None
        later = int(np.searchsorted(samples[leg], truth.t_ns, side="right"))
        if later < len(samples[leg]):
            yield ContactEvent(
                leg=leg,
                t_ns=samples[leg][later],
                seq=later,
                onset_ns=truth.t_ns,
                contact=truth.contact,
                status="valid",
                score=2.0,
                residual=[0.0, 0.0, 0.0],
                model_version=1,
            )


def told(walk: Path, path: Path, robot: Robot, *, until_s: float = SECONDS) -> Verdict:
    """The walk judged, with ideal events; of leg rf up to some time only."""
    with RecordingWriter(path) as writer:
        for record in read_recording(walk):
            writer.write(record.key, record.payload, record.encoding, record.log_time_ns)
        for event in ideal(walk):
            if event.leg != "rf" or event.t_ns < until_s * 1e9:
                writer.write_message(contact_key(event.leg), event, event.t_ns)
    return judge(path, robot, round(DRIFT_S * 1e9), "rf")


def test_a_service_without_fault(walk: Path, tmp_path: Path, robot: Robot) -> None:
    verdict = told(walk, tmp_path / "told.mcap", robot)
    service, frozen = verdict.service, verdict.frozen
    assert service.whole.total.counted.recall == 1.0
    assert service.whole.total.false_alarms == 0
    assert service.recovery == 0
    assert frozen.recovery is None
    for judged in (service, frozen):
        whole, parts = judged.whole.total, (judged.before.total, judged.after.total)
        assert sum(part.counted.touches for part in parts) == whole.counted.touches
        assert sum(part.false_alarms for part in parts) == whole.false_alarms
    # Judged on the samples alone: the old model foretells the drifted leg badly, others well.
    for leg, level in frozen.level.items():
        late = level.over_floor[level.t_ns > DRIFT_S * 1e9]
        assert np.median(late) > 2.0 if leg == "rf" else np.median(late) < 1.5, leg

    first, (second, third) = touches_words(verdict), outcome_words(SETTINGS, verdict)
    assert "no false alarm" in first
    assert "a frozen model finds" in second
    assert third.startswith("The service follows the leg at once: ")
    picture = tmp_path / "report.png"
    draw(picture, SETTINGS, verdict)
    assert 50_000 < picture.stat().st_size < 400_000


def test_a_service_that_never_comes_back(walk: Path, tmp_path: Path, robot: Robot) -> None:
    verdict = told(walk, tmp_path / "told.mcap", robot, until_s=DRIFT_S)
    assert verdict.service.recovery is None
    assert outcome_words(SETTINGS, verdict)[1].startswith(
        "The service has not caught up by the end"
    )
    draw(tmp_path / "report.png", SETTINGS, verdict)


def test_a_demo_with_few_swings_left_is_not_called_a_failure(
    walk: Path, tmp_path: Path, robot: Robot
) -> None:
    path = tmp_path / "told.mcap"
    late_ns = round((SECONDS - 8.0) * 1e9)
    told(walk, path, robot)
    verdict = judge(path, robot, late_ns, "rf")
    assert 0 < verdict.service.swings_after < 10
    lines = outcome_words(SETTINGS, verdict)
    swings = verdict.service.swings_after
    assert lines[1].startswith(f"The service, with only {swings} swings left to judge it by: ")
    # Of a leg that no model has lost there is nothing to catch up with.
    assert "no harm done" in outcome_words(SETTINGS, judge(path, robot, late_ns, "lm"))[0]


def test_no_words_lie_on_others_wherever_the_drift_is(
    walk: Path, tmp_path: Path, robot: Robot
) -> None:
    verdict = told(walk, tmp_path / "told.mcap", robot)
    for share in (0.25, 0.42, 0.55, 0.7, 0.99):
        drift_ns = round(share * SECONDS * 1e9)
        figure = drawn(SETTINGS, dataclasses.replace(verdict, drift_ns=drift_ns))
        FigureCanvasAgg(figure).draw()
        axes = figure.axes[0]
        legend = axes.get_legend()
        assert legend is not None
        shown = [*figure.texts, *axes.texts, axes.xaxis.label, *legend.get_texts()]
        boxes = {words.get_text(): words.get_window_extent() for words in shown}
        assert {"touch missed", "time, s"} < set(boxes)
        assert any(words.endswith("60 g of mud") for words in boxes)
        for one, other in itertools.combinations(boxes, 2):
            assert not boxes[one].overlaps(boxes[other]), (share, one, other)
        for words, box in boxes.items():
            assert 0 <= box.x0 < box.x1 <= figure.bbox.width, (share, words)


def test_it_takes_no_more_than_the_readme_installs() -> None:
    """The extras ``sim`` and ``plot``; pages and tables of the studies want more."""
    code = """
import sys
for name in ("jinja2", "distributed", "pyarrow", "rosbags", "foxglove", "dynamixel_sdk"):
    sys.modules[name] = None
import adaptive_contact.cli.demo.report, adaptive_contact.cli.demo.run
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_only_all_is_a_hundred_percent() -> None:
    shares = (None, 0.0, 0.034, 0.9999, 1.0)
    assert [percent(share) for share in shares] == ["-", "0 %", "3 %", "99 %", "100 %"]
