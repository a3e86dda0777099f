"""``robot learn --live``: a baseline of legs on no bus, from what their source publishes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from adaptive_contact.bridge.freeswing import free_swings
from adaptive_contact.cli import _robot_learning as command
from adaptive_contact.cli import main as cli
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError
from adaptive_contact.model.model_file import load_baseline
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.service.link import Link
from adaptive_contact.service.recording import read_recording
from adaptive_contact.wire import ServoSample, servo_key

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


def swings(robot: Robot) -> list[tuple[str, ServoSample]]:
    """A leg whose servos follow their commands as a saturating first-order law."""
    [leg], step = robot.legs, robot.quantum_rad
    rng = np.random.default_rng(8)
    home = np.array([0.0, 0.6, -1.2])
    goals = free_swings(leg, home, rng, amplitude_rad=0.5, max_step_rad=0.15)
    angle, out = home.copy(), []
    for k in range(TICKS):
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
    monkeypatch: pytest.MonkeyPatch, router: Link, tmp_path: Path
) -> Iterator[Callable[..., Any]]:
    """The command, beside a source that publishes all samples; ends when they are taken in."""
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(TOML)
    if not cli.app.registered_groups:
        cli._register()
    threads: list[threading.Thread] = []

    def run(samples: list[tuple[str, ServoSample]], *words: str) -> Any:
        stop, left, subscribe = threading.Event(), [len(samples)], Link.subscribe

        def counting(self: Link, key: str, sink: Callable[..., None]) -> Any:
            def counted(one: Any) -> None:
                sink(one)
                left[0] -= 1
                if left[0] == 0:
                    stop.set()

            return subscribe(self, key, counted)

        monkeypatch.setattr(Link, "subscribe", counting)
        monkeypatch.setattr(command, "stoppable", lambda: stop)
        publishers = {leg: router.publisher(servo_key(leg), reliable=True) for leg in dict(samples)}

        def publish() -> None:
            while not all(each.matched for each in publishers.values()) and not stop.wait(0.01):
                pass
            for leg, one in samples:
                publishers[leg].put(one)

        threads.append(threading.Thread(target=publish))
        threads[-1].start()
        where = ("--connect", router.endpoints[0], "--config", "robot.toml", *words)
        result = CliRunner().invoke(cli.app, ["robot", "learn", "--live", *where])
        stop.set()
        if isinstance(result.exception, AdaptiveContactError):
            raise result.exception
        return result

    yield run
    for thread in threads:
        thread.join(10)


def test_a_hip_that_rolls_is_learned_from_the_wire(learn_live: Callable[..., Any]) -> None:
    samples = swings(parse_robot(TOML, source="x"))
    result = learn_live(samples, "--seconds", "120", "--out", "b.json")
    assert result.exit_code == 0, result.output
    assert "leg fl: good" in result.output
    library = load_baseline(Path("b.json")).legs["fl"].model.library
    assert library.axes == ("roll", (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    assert "cos φ(haa-hfe-kfe)" in library.names
    assert sum(1 for _ in read_recording(Path("b.mcap"))) == TICKS


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
    if not cli.app.registered_groups:
        cli._register()
    result = CliRunner().invoke(cli.app, ["robot", "learn", *words])
    assert isinstance(result.exception, ConfigurationError)
    assert says in str(result.exception)
