"""``robot learn --live``: a baseline of legs on no bus, from what their source publishes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from adaptive_contact.bridge.training import free_swings
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError
from adaptive_contact.model.model_file import load_baseline
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ServoSample
from programs import tried

TOML = """
[robot]
name = "walker"
period_s = 0.02
quantum_rad = 0.00153
[[leg]]
id = "fl"
joints = ["haa", "hfe", "kfe"]
axes = ["roll", [0, 1, 0], [0, 1, 0]]
origins_m = [[0, 0.014, 0], [0, 0.037, -0.16], [0, 0.008, -0.16]]
mount = { xyz_m = [0.2, 0.05, 0] }
limits = { lower_rad = [-0.6, -0.5, -2.4], upper_rad = [0.6, 1.6, -0.5] }
"""
TICKS = 13_000


def swings(robot: Robot, ticks: int = TICKS) -> list[tuple[str, ServoSample]]:
    """A leg whose servos follow their commands as a saturating first-order law."""
    [leg], step = robot.legs, robot.quantum_rad
    rng = np.random.default_rng(8)
    home = np.array([0.0, 0.6, -1.2])
    goals = free_swings(leg, home, rng, amplitude_rad=0.5, max_step_rad=0.15)
    angle, out = home.copy(), []
    for k in range(ticks):
        goal = np.rint(np.array(next(goals)) / step) * step
        measured = np.rint((angle + rng.normal(0, 0.3 * step, 3)) / step) * step
        out.append(
            (
                leg.id,
                ServoSample(
                    t_ns=k * 20_000_000, seq=k, measured=measured.tolist(),
                    desired=goal.tolist(), run=3,
                ),
            )
        )  # fmt: skip
        angle = angle + 0.09 * np.clip((goal - angle) / 0.164, -1.0, 1.0)
    return out


@pytest.fixture
def learn_live(
    beside_a_source: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[..., Any]:
    """The command, beside a source of samples."""
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(TOML)
    words = ("robot", "learn", "--live", "--config", "robot.toml")

    def run(samples: list[tuple[str, ServoSample]], *more: str) -> Any:
        result = beside_a_source(samples, *words, *more)
        if isinstance(result.exception, AdaptiveContactError):
            result.exception.add_note(result.output)
            raise result.exception
        return result

    return run


def test_a_hip_that_rolls_is_learned_from_the_wire(learn_live: Callable[..., Any]) -> None:
    samples = swings(parse_robot(TOML, source="x"))
    result = learn_live(samples, "--seconds", "120", "--out", "b.json")
    assert result.exit_code == 0, result.output
    assert "leg fl: good" in result.output
    library = load_baseline(Path("b.json")).legs["fl"].model.library
    assert library.axes == ("roll", (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    assert "cos φ(haa-hfe-kfe)" in library.names
    assert sum(1 for _ in read_recording(Path("b.mcap"))) == TICKS


TICKS_SPOILT = 400


def test_what_cannot_be_learned_from_is_refused_in_one_line(learn_live: Callable[..., Any]) -> None:
    """Here by a joint that is frozen; ``tests/field/test_fit.py`` has the other mistakes."""
    made = [
        (leg, msgspec.structs.replace(one, measured=[one.measured[0], 0.6, one.measured[2]]))
        for leg, one in swings(parse_robot(TOML, source="x"), TICKS_SPOILT)
    ]
    with pytest.raises(ConfigurationError, match="nothing is learned from them: correct") as live:
        learn_live(made, "--seconds", "60", "--out", "b.json")
    # Together with a better recording it is refused as well, before anything is swung.
    with pytest.raises(ConfigurationError, match="nothing is learned from them: correct") as more:
        learn_live([], "--seconds", "60", "--out", "c.json", "--more", "b.mcap")
    for error in (live.value, more.value):
        [line] = [line for line in error.__notes__[0].splitlines() if "error: leg fl: " in line]
        assert "a reading never changes while its command moves" in line
        assert "check cable" in line
    assert list(Path().glob("*.json")) == []


def test_other_legs_are_named(learn_live: Callable[..., Any]) -> None:
    samples = [("fr", one) for _, one in swings(parse_robot(TOML, source="x"))[:5]]
    with pytest.raises(
        ConfigurationError, match=r"no samples of leg fl came in .* only of leg fr;"
    ):
        learn_live(samples, "--seconds", "60")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--live", "--drive"), "--live listens to the wire, --drive is the bridge's"),
        (("--live", "--device", "/dev/null"), "--device is the bridge's"),
        (("--connect", "tcp/127.0.0.1:1"), "--connect goes with --live"),
    ],
)
def test_options_of_the_other_source_are_refused(words: tuple[str, ...], says: str) -> None:
    error = tried("robot", "learn", *words).exception
    assert isinstance(error, ConfigurationError)
    assert says in str(error)
