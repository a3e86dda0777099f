"""Recordings, pictures and films."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError, MissingExtraError, RecordingError
from adaptive_contact.wire import (
    SIM_BODY,
    SIM_DRIFT,
    BodyPose,
    ContactTruth,
    Drift,
    Message,
    ServoSample,
    decode,
    servo_key,
    truth_key,
)
from adaptive_contact_sim import (
    Injection,
    ObstacleSettings,
    PoseSettings,
    Simulation,
    SimulationSettings,
    TerrainSettings,
    WalkSettings,
)
from adaptive_contact_sim.picture import Film, Moment, Painter
from tests.sim.touches import recorded

WALK = SimulationSettings(
    motion=WalkSettings(),
    terrain=TerrainSettings(kind="rough"),
    seed=2,
    drift=(Injection(Drift(kind="friction", value=3.0, leg="rf"), 1.0),),
)
TYPES = {"servo": ServoSample, "truth": ContactTruth, "drift": Drift, "body": BodyPose}
HITS = SimulationSettings(
    motion=PoseSettings(obstacles=ObstacleSettings(1.0, shapes=("plate",))), seed=3
)


def test_a_recording_is_the_run(tmp_path: Path) -> None:
    by_key = recorded(WALK, 3.0, tmp_path / "walk.mcap")
    told = {
        key: [decode(r.payload, TYPES[key.rsplit("/", 1)[-1]], r.encoding) for r in records]
        for key, records in by_key.items()
    }
    expected: dict[str, list[Message]] = {}
    sim = Simulation(WALK)
    for tick, pose in zip(sim.run(3.0), told[SIM_BODY], strict=True):
        for leg, sample in tick.samples.items():
            expected.setdefault(servo_key(leg), []).append(sample)
        for truth in tick.truth:
            expected.setdefault(truth_key(truth.leg), []).append(truth.message)
        place, rotation = sim.plant.body_pose()
        assert (pose.t_ns, pose.position_m) == (sim.t_ns, tuple(place))
        w, x, y, z = pose.quaternion_wxyz
        # The body's axis up, in the world.
        up = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        assert up == pytest.approx(rotation[:, 2], abs=1e-12)
    expected |= {SIM_BODY: told[SIM_BODY], SIM_DRIFT: [WALK.drift[0].drift]}
    assert told == expected
    assert by_key[SIM_DRIFT][0].log_time_ns == 1_000_000_000


def test_a_recording_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be written"):
        recorded(WALK, 1.0, tmp_path / "none" / "walk.mcap")


def engine_or_skip(sim: Simulation) -> Painter:
    try:
        return Painter(sim, 320, 240)
    except ConfigurationError as error:
        pytest.skip(f"no EGL on this machine: {error}")


def seen(image: np.ndarray, colour: tuple[int, int, int], tolerance: int = 60) -> int:
    return int((np.abs(image.astype(int) - colour).max(axis=2) < tolerance).sum())


def test_pictures_show_which_feet_touch() -> None:
    sim = Simulation(HITS, looks=True)
    for _ in range(63):  # rf is in the air, high up
        sim.advance()
    painter = engine_or_skip(sim)
    image = painter.paint(Moment.from_simulation(sim))
    painter.close()
    assert image.shape == (240, 320, 3)
    assert image.dtype == np.uint8
    assert seen(image, (237, 41, 36)) > 15
    assert seen(image, (41, 140, 224)) > 10
    # Robot, ground and sky: not one flat colour.
    assert image.reshape(-1, 3).std(axis=0).min() > 15


def test_what_cannot_be_rendered_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sim = Simulation(HITS)
    with pytest.raises(ConfigurationError, match=r"ending in \.png, \.gif"):
        Film(tmp_path / "film.avi", sim)
    with pytest.raises(ConfigurationError, match="folder does not exist"):
        Film(tmp_path / "none" / "film.gif", sim)
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match=r"\[plot\]"):
        Film(tmp_path / "film.gif", sim)
