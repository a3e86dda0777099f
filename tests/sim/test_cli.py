"""docs/simulator.md says what the code does."""

from __future__ import annotations

import json
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from adaptive_contact.cli.sim import app
from adaptive_contact.errors import AdaptiveContactError, ConfigurationError, MissingExtraError
from adaptive_contact.service.recording import read_recording
from adaptive_contact_sim import KINDS, Simulation, load_scenario
from adaptive_contact_sim.scenario import parse_scenario

RUN = CliRunner()


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """Commands take signals over; give them back."""
    taken = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in taken}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def fails(*arguments: str) -> str:
    result = RUN.invoke(app, arguments)
    assert isinstance(result.exception, AdaptiveContactError), result.output
    return str(result.exception)


def test_list_shows_scenarios_and_kinds() -> None:
    result = RUN.invoke(app, ["list"])
    assert result.exit_code == 0
    for word in ("walk-rough", "pose-free", *KINDS):
        assert word in result.output
    table = json.loads(RUN.invoke(app, ["list", "--json"]).output)
    assert table["drift"]["supply"]["nominal"] == 12.0
    assert table["scenarios"]["walk-mud"]["seconds"] == 240.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--gait", "ripple", "--terrain", "steps", "--seed", "3", "--drift",
             "friction:leg=rf,value=4@1s"),
            "ripple walk on steps ground, stop on truth, seed 3, 1 drifts",
        ),
        (
            ("--scenario", "walk-mud", "--gait", "wave", "--drift", "friction:leg=rf,value=4@1s"),
            "wave walk on rough ground, stop on truth, seed 4, 3 drifts",
        ),
    ],
)  # fmt: skip
def test_an_offline_walk_is_recorded_and_options_change_a_scenario(
    tmp_path: Path, options: tuple[str, ...], said: str
) -> None:
    file = tmp_path / "walk.mcap"
    words = ["walk", "--offline", "--seconds", "2", *options, "--record", str(file)]
    result = RUN.invoke(app, words)
    assert result.exit_code == 0, result.output
    assert said in result.output
    assert "simulated 2.0 s" in result.output
    keys = {record.key for record in read_recording(file)}
    assert {"robot/leg/rf/servo", "robot/sim/drift"} <= keys


def test_a_walk_that_raises_legs_ends_with_how_often(tmp_path: Path) -> None:
    file = tmp_path / "high.toml"
    file.write_text(
        'about = ""\nmode = "walk"\nseed = 911\nseconds = 8\n[walk]\nraise_m = 0.04\n'
        '[terrain]\nkind = "steps"\nrelief_m = 0.07\n'
    )
    sim = Simulation(load_scenario(str(file)).settings)
    raises = sum(int(sim.motion.raised.sum()) for _ in sim.run(8.0))
    assert raises > 0
    words = ["walk", "--offline", "--scenario", str(file)]
    assert f"; raised swings: {raises}\n" in RUN.invoke(app, words).output
    assert "raised" not in RUN.invoke(app, [*words, "--raise-m", "0", "--seconds", "1"]).output


def test_an_offline_pose_is_pictured(tmp_path: Path) -> None:
    picture = tmp_path / "pose.png"
    result = RUN.invoke(
        app,
        ["pose", "--offline", "--seconds", "2", "--leg", "all", "--obstacles", "0.5", "--soft",
         "0.5", "--approach", "slow", "--workspace", "whole", "--path", "joint", "--render",
         str(picture)],
    )  # fmt: skip
    if isinstance(result.exception, ConfigurationError) and "libegl1" in str(result.exception):
        pytest.skip(f"no EGL on this machine: {result.exception}")
    assert result.exit_code == 0, result.output
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("walk", "--offline"), "give --seconds"),
        (("walk", "--offline", "--seconds", "0"), "expected above 0"),
        (("walk", "--gait", "gallop", "--offline"), "expected one of tripod"),
        (("walk", "--terrain", "sand", "--offline"), "expected one of"),
        (("walk", "--stop-on", "luck"), "truth, service, never"),
        (("walk", "--raise-m", "0.2", "--offline", "--seconds", "1"), "expected 0 to 0.05 m"),
        (("walk", "--speed", "fast"), "expected a factor above 0"),
        (("walk", "--speed", "nan"), "expected a factor above 0"),
        (("walk", "--drift", "fiction:value=3"), "did you mean 'friction'"),
        (("walk", "--scenario", "pose-free"), "use that command"),
        (("walk", "--scenario", "walk-rouhg"), "did you mean 'walk-rough'"),
        (("pose", "--leg", "rx", "--offline"), "expected some of lf"),
        (("pose", "--obstacles", "2", "--offline"), "expected 0 to 1"),
        (("inject", "friction"), "has no value"),
        (("inject", "friction", "--value", "99"), "expected 0.1 to 10"),
        (("inject", "friktion", "--value", "2"), "friktion"),
        (("inject", "friction", "--value", "2", "--connect", "tcp/127.0.0.1:1"), "unreachable"),
    ],
)
def test_a_bad_command_line_gets_one_line(arguments: tuple[str, ...], words: str) -> None:
    assert words in fails(*arguments)


def test_without_mujoco_it_says_which_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n.partition(".")[0] == "adaptive_contact_sim"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    result = RUN.invoke(app, ["list"])
    assert isinstance(result.exception, MissingExtraError)
    assert "[sim]'" in str(result.exception)


# -- docs/simulator.md says what the code does

TEXT = (Path(__file__).parents[2] / "docs/simulator.md").read_text(encoding="utf-8")


def test_the_scenario_in_it_can_be_run() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    assert len(blocks) == 1
    assert parse_scenario(blocks[0], name="doc").settings.drift[0].at_s == 60.0


def test_the_python_in_it_runs() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict[str, object] = {}
    exec(block.replace("seconds=300", "seconds=3"), names)
    assert names["leg"].measured.shape == (150, 3)  # type: ignore[attr-defined]
