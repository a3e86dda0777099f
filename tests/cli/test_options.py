"""What every command's options have in common: durations, and brackets in the help."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.cli import _options as opt
from adaptive_contact.durations import seconds_of
from programs import commands, invoke


def test_square_brackets_of_a_help_are_shown(monkeypatch: Any) -> None:
    """A default stands in them, and what looks like markup would be swallowed."""
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")
    text = invoke("sim", "pose", "--help")
    assert "Which legs move. [hexapod rf, leg5 leg]" in text
    assert "[1, max with --offline]" in text


def test_every_option_in_seconds_is_a_duration() -> None:
    """Whoever adds one takes the same option; those in other units have these in their names."""
    found = {}
    for path, command in commands():
        for option in command.params:
            if option.name in ("seconds", "duration", "wait", "from_s", "to_s"):
                found[(*path, option.name)] = option.metavar
    assert len(found) >= 12
    assert set(found.values()) == {"DURATION"}


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("600", 600.0),
        ("2.5", 2.5),
        (".5s", 0.5),
        ("90s", 90.0),
        ("10m", 600.0),
        ("10 min", 600.0),
        ("1h", 3600.0),
        ("2d12h", 216000.0),
        ("1h30m", 5400.0),
        ("1 h 30 m 5 s", 5405.0),
        ("500ms", 0.5),
        ("1e3", 1000.0),
        ("2 Minutes", 120.0),
        ("-3s", -3.0),
        *(
            (text, None)
            for text in (
                *("", "m", "soon", "10x", "1:30", "30m1h", "1m1m", "10 20", "1h30", "nan", "inf"),
                *("1e999", "1m-3s"),
            )
        ),
    ],
)
def test_durations_that_people_write(text: str, seconds: float | None) -> None:
    assert seconds_of(text) == pytest.approx(seconds)


@given(st.text(max_size=20))
def test_any_text_is_a_duration_or_none(text: str) -> None:
    found = seconds_of(text)
    assert found is None or abs(found) < float("inf")


@pytest.mark.parametrize(
    "taken",
    [
        opt.described_robot,
        lambda config: opt.recorded_robot(config, []),
    ],
)
def test_a_robot_toml_of_the_folder_is_not_taken_and_that_is_said(
    taken: Any, tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    taken(None)
    assert "robot.toml" not in capsys.readouterr().err
    shipped = resources.files("adaptive_contact_models") / "quadruped12" / "robot.toml"
    Path("robot.toml").write_text(shipped.read_text().replace('"quadruped12"', '"mine"'))
    robot = taken(None)
    line = capsys.readouterr().err
    assert robot.name != "mine"
    assert robot.name in line
    assert "--config robot.toml takes it" in line
    assert taken(Path("robot.toml")).name == "mine"
    assert not capsys.readouterr().err
