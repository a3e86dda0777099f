"""The command line of the scenarios."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from adaptive_contact.cli.scenarios import app
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact_sim.trials import figures, runs
from adaptive_contact_sim.trials.registry import scenarios

RUN = CliRunner()


def fails(*arguments: str) -> str:
    result = RUN.invoke(app, arguments)
    assert isinstance(result.exception, AdaptiveContactError), result.output
    message = str(result.exception)
    assert "\n" not in message
    return message


def test_list_shows_every_scenario() -> None:
    rows = json.loads(RUN.invoke(app, ["list", "--json"]).output)
    assert [row["name"] for row in rows] == list(scenarios())
    assert all(row["leg_runs"] >= 20 for row in rows)
    table = RUN.invoke(app, ["list"])
    assert table.exit_code == 0
    assert "caught-30s" in table.output


def test_bad_names_and_none() -> None:
    assert "did you mean 'ramp-mud'?" in fails("run", "ramp-mut")
    assert "or give --all" in fails("run")


def test_a_report_needs_results(tmp_path: Path) -> None:
    assert "no results there" in fails("report", "--out", str(tmp_path))


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    message = fails("run", "step-mass50", "--quick", "--out", str(tmp_path / "file" / "below"))
    assert "give another folder with --out" in message


def test_a_quick_run_makes_figures_pages_and_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = replace(runs.QUICK_SIZES, before_s=3.0, after_s=6.0, first_seed=9400)
    monkeypatch.setattr(runs, "QUICK_SIZES", short)
    monkeypatch.setattr(figures, "_BOOTSTRAPS", 20)
    out, docs = tmp_path / "out", tmp_path / "docs"
    arguments = ["run", "step-friction4", "--quick", "--seeds", "1", "--processes", "1"]
    result = RUN.invoke(app, [*arguments, "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    tree = json.loads(result.stdout)
    assert tree["size"] == "quick"
    figures_of = tree["scenarios"]["step-friction4"]
    assert figures_of["leg_runs"] == 1
    assert set(figures_of["variants"]) == {"frozen", "ungated", "refit", "rls", "full"}
    for name in ("step-friction4", "summary"):
        assert (out / "pages" / f"{name}.png").stat().st_size > 5_000

    result = RUN.invoke(app, ["report", "--out", str(out), "--docs", str(docs)])
    assert result.exit_code == 0, result.output
    text = (docs / "adaptation.md").read_text(encoding="utf-8")
    assert "(pictures/adaptation-step-friction4.png)" in text
    assert "quick look" in text
    assert (docs / "pictures" / "adaptation-summary.png").is_file()
