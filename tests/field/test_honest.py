"""A small share of the hundreds of hours (`make honest`), and that it goes on where it was."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from . import honest


def test_honest_legs_are_not_doubted_and_a_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(honest, "TURNS", (honest.TURNS[4], honest.TURNS[1], honest.TURNS[3]))
    few = ["--seconds", "12"]
    assert honest.main([str(tmp_path), "--hours", "0.003", *few]) == 0
    path = tmp_path / "legs.jsonl"
    begun = path.read_text()
    assert honest.main([str(tmp_path), "--hours", "0.085", *few]) == 0
    assert path.read_text().startswith(begun)
    runs = [json.loads(line) for line in path.read_text().splitlines()]
    assert [of["run"] for of in runs] == list(range(len(runs)))
    assert sum(sum(of["hours"].values()) for of in runs) >= 0.085
    assert "| all |" in capsys.readouterr().out


def test_doubted_legs_fail_the_run(tmp_path: Path) -> None:
    doubted = {"run": 0, "hours": {"leg5": 1.0}, "doubted": ["leg5, seed 1: x"] * 2, "noted": []}
    (tmp_path / "legs.jsonl").write_text(json.dumps(doubted) + "\n")
    assert honest.main([str(tmp_path), "--hours", "0.5"]) == 1
