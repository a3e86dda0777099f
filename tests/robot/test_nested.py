"""Files nested more deeply than any is: one line, whatever the depth."""

from __future__ import annotations

from pathlib import Path

import pytest

from adaptive_contact.errors import BaselineError, ConfigurationError
from adaptive_contact.model import load_baseline
from adaptive_contact.robot import load_robot

DEPTHS = (100, 1_000, 20_000)
HEAD = '[robot]\nname = "x"\nperiod_s = 0.02\nquantum_rad = 0.005\n'


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize(
    "text",
    [
        HEAD + "leg = {open}{close}\n",
        "x = {open}{close}\n",
        '[[leg]]\nid = "rf"\njoints = {open}{close}\n',
        "{tables}",
        "x = {inline}1{end}\n",
    ],
    ids=["legs", "unknown", "joints", "tables", "inline tables"],
)
def test_a_robot_nested_deeply_is_one_line(text: str, depth: int, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    parts = {
        "{open}": "[" * depth,
        "{close}": "]" * depth,
        "{tables}": f"[{'.'.join(['a'] * depth)}]\nx = 1\n",
        "{inline}": "{a=" * depth,
        "{end}": "}" * depth,
    }
    for name, part in parts.items():
        text = text.replace(name, part)
    path.write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        load_robot(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize(
    "text",
    [
        "[" * 9 + "{open}{close}" + "]" * 9,
        '{"format": {open}{close}}',
        '{"format": 4, "legs": {open}{close}}',
        '{"format": 4, "legs": {"rf": {objects}1{ends}}}',
        "{objects}",
    ],
    ids=["lists", "format", "legs", "objects", "cut"],
)
def test_a_baseline_nested_deeply_is_one_line(text: str, depth: int, tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    parts = {
        "{open}": "[" * depth,
        "{close}": "]" * depth,
        "{objects}": '{"a":' * depth,
        "{ends}": "}" * depth,
    }
    for name, part in parts.items():
        text = text.replace(name, part)
    path.write_text(text)
    with pytest.raises(BaselineError) as caught:
        load_baseline(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500
