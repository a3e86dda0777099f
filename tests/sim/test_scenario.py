from __future__ import annotations

from pathlib import Path

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import Drift
from adaptive_contact_sim import PoseSettings, Simulation, WalkSettings
from adaptive_contact_sim.drift import Injection
from adaptive_contact_sim.scenario import load_scenario, parse_scenario, shipped_scenarios

# Names are permanent: add, never rename.
NAMES = {
    "pose-collisions": PoseSettings,
    "pose-free": PoseSettings,
    "pose-worn": PoseSettings,
    "walk-battery": WalkSettings,
    "walk-mud": WalkSettings,
    "walk-rough": WalkSettings,
    "walk-soft": WalkSettings,
    "walk-steps": WalkSettings,
}

FULL = """
about = "all of it"
mode = "walk"
seconds = 12.5
seed = 3
robot_seed = 4
[walk]
gait = "wave"
depth_m = [0.02, 0.03]
[terrain]
kind = "steps"
relief_m = 0.02
[encoder]
dropped = 0.01
[[drift]]
kind = "friction"
leg = "rf"
joint = "all"
value = 4
at_s = 10
[[drift]]
kind = "offset"
value = 0.01
shape = "pulse"
duration_s = 2
"""


def test_shipped_scenarios_keep_their_names_and_run() -> None:
    shipped = shipped_scenarios()
    assert set(NAMES) <= set(shipped)
    seeds = [s.settings.seed for s in shipped.values()]
    assert len(set(seeds)) == len(seeds)
    for name, scenario in shipped.items():
        assert scenario.about
        assert scenario.seconds
        if name in NAMES:
            assert isinstance(scenario.settings.motion, NAMES[name])
        Simulation(scenario.settings).advance()


def test_every_setting_can_be_said() -> None:
    scenario = parse_scenario(FULL, name="full")
    settings = scenario.settings
    assert (scenario.seconds, settings.seed, settings.robot_seed) == (12.5, 3, 4)
    assert (settings.motion.gait, settings.motion.depth_m) == ("wave", (0.02, 0.03))
    assert (settings.terrain.kind, settings.terrain.relief_m) == ("steps", 0.02)
    assert settings.encoder.dropped == 0.01
    assert settings.drift == (
        Injection(Drift(kind="friction", leg="rf", value=4.0), 10.0),
        Injection(Drift(kind="offset", value=0.01, shape="pulse", duration_s=2.0), 0.0),
    )


def test_obstacles_are_a_table_of_the_pose() -> None:
    text = 'mode = "pose"\n[pose]\nlegs = ["lf", "rr"]\n[pose.obstacles]\nprobability = 0.5\n'
    motion = parse_scenario(text, name="p").settings.motion
    assert motion.legs == ("lf", "rr")
    assert motion.obstacles.probability == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", 'expected "pose" or "walk"'),
        ('mode = "swim"', 'expected "pose" or "walk"'),
        ("mode = ", "not valid TOML"),
        ('mode = "walk"\nsecond = 3', "did you mean 'seconds'"),
        ('mode = "walk"\nseconds = -3', "Expected `float` > 0.0 - at `.*seconds`"),
        ('mode = "walk"\nseconds = true', "got `bool` - at `.*seconds`"),
        ('mode = "walk"\nseed = 1.5', "Expected `int`, got `float` - at `.*seed`"),
        ('mode = "walk"\n[pose]', r"has a table \[pose\]"),
        ('mode = "pose"\n[terrain]', r"has a table \[terrain\]"),
        ('mode = "walk"\n[walk]\ngiat = "wave"', "did you mean 'gait'"),
        ('mode = "walk"\n[walk]\ngait = 3', r"\[walk\]"),
        ('mode = "walk"\nwalk = 3', "Expected `object`, got `int` - at `.*walk`"),
        ('mode = "walk"\n[walk]\nstride_m = 3.0', "expected 0 to 0.09 m"),
        ('mode = "walk"\n[terrain]\nkind = "sand"', r"\[terrain\]"),
        ('mode = "walk"\n[drift]\nkind = "mass"', "Expected `array`, got `object` - at `.*drift`"),
        ('mode = "walk"\n[[drift]]\nkind = "mass"', "has no value"),
        ('mode = "walk"\n[[drift]]\nkind = "mass"\nvalue = 9.0', "expected 0 to 0.5 kg"),
        ('mode = "pose"\n[pose.obstacles]\nprobability = 2.0', "expected 0 to 1"),
    ],
)
def test_errors_are_one_line_that_names_the_file(text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words) as caught:
        parse_scenario(text, name="mine", source="mine.toml")
    assert str(caught.value).startswith("mine.toml: ")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("walk-mut", "did you mean 'walk-mud'"),
        ("none.toml", "cannot be read"),
        ("bad.toml", "UTF-8"),
    ],
)
def test_loading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, words: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(FULL, encoding="utf-8")
    Path("bad.toml").write_bytes(b"\xff\xfe\x00")
    assert load_scenario("mine.toml").name == "mine"
    assert load_scenario("walk-mud").settings.seed == 4
    with pytest.raises(ConfigurationError, match=words):
        load_scenario(name)
