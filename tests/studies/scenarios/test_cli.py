"""The command line of the scenarios."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from adaptive_contact.cli.scenarios import app
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact_studies.scenarios import judge, runner, runs
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.results import (
    belongs,
    best_form,
    read_results,
    write_results,
)
from adaptive_contact_studies.scenarios.runner import Folders, Job

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
    assert "did you mean 'ramp-mud'?" in fails("run", "ramp-mut", "--all")


def test_forms_and_choices_that_contradict_each_other() -> None:
    assert "give one of them" in fails("run", "ramp-mud", "--quick", "--brief")
    assert "give names or --all" in fails("run", "ramp-mud", "--all")


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
    monkeypatch.setattr(judge, "_BOOTSTRAPS", 20)
    out, docs = tmp_path / "out", tmp_path / "docs"
    arguments = ["run", "step-friction4", "--quick", "--seeds", "1", "--processes", "1"]
    result = RUN.invoke(app, [*arguments, "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    tree = json.loads(result.stdout)
    assert tree["size"] == "quick"
    assert read_results(out / "results-quick-1.json")["scenarios"] == tree["scenarios"]
    figures_of = tree["scenarios"]["step-friction4"]
    assert figures_of["leg_runs"] == 3, "of one recording"
    assert set(figures_of["variants"]) == {"frozen", "ungated", "refit", "rls", "full"}
    for name in ("step-friction4", "summary"):
        assert (out / "pages-quick-1" / f"{name}.png").stat().st_size > 5_000

    result = RUN.invoke(app, ["report", "--out", str(out), "--docs", str(docs)])
    assert result.exit_code == 0, result.output
    assert "no figures of the full form" in result.stderr
    text = (docs / "adaptation.md").read_text(encoding="utf-8")
    assert "(pictures/adaptation-step-friction4.png)" in text
    assert "quick look" in text
    assert (docs / "pictures" / "adaptation-summary.png").is_file()

    # Goals do not depend on the learners in between, and are no table to publish.
    result = RUN.invoke(app, [*arguments, "--goals", "--no-pages", "--out", str(out), "--json"])
    assert result.exit_code == 0, result.output
    goals_of = json.loads(result.stdout)["scenarios"]["step-friction4"]
    assert set(goals_of["variants"]) == {"frozen", "full"}
    assert goals_of["goals"] == figures_of["goals"]
    assert goals_of["variants"]["full"] == figures_of["variants"]["full"]
    assert best_form(out) == "quick-1"

    # A form that stands above it takes its place on the page, pictures and all.
    shutil.copy(out / "results-quick-1.json", out / "results-brief.json")
    tree = json.loads((out / "results-brief.json").read_text(encoding="utf-8"))
    write_results(tree | {"size": "full", "leg_runs": 20}, out / "results-full.json")
    result = RUN.invoke(app, ["report", "--out", str(out), "--docs", str(tmp_path / "whole")])
    assert result.stderr == ""
    text = (tmp_path / "whole" / "adaptation.md").read_text(encoding="utf-8")
    assert "quick look" not in text
    assert "pictures/" not in text, "pictures of the quick look"


def test_another_form_leaves_the_full_figures_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Folders] = []

    def stop(_: object, folders: Folders) -> list[Job]:
        asked.append(folders)
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "jobs", stop)
    forms = {
        "full": (),
        "full-8": ("--seeds", "8"),
        "brief": ("--brief",),
        "brief-2": ("--brief", "--seeds", "2"),
        "quick": ("--quick", "--seeds", "2"),  # the usual number
        "goals-full": ("--goals",),
        "goals-brief-2": ("--goals", "--brief", "--seeds", "2"),
    }
    for extra in forms.values():
        result = RUN.invoke(app, ["run", "step-mass50", *extra, "--out", str(tmp_path)])
        assert result.exit_code == 130
    assert [f.results.name for f in asked] == [f"results-{form}.json" for form in forms]
    assert len({f.pages for f in asked}) == len(forms)
    assert {f.replays for f in asked} == {tmp_path / "replays"}


def test_a_few_scenarios_do_not_replace_the_table_of_another_learner(tmp_path: Path) -> None:
    """Said at once, before anything is simulated."""
    table = {name: {} for name in ("step-mass50", "ramp-mud")}
    made = belongs(runs.FULL_SIZES, "full")._asdict() | {"learner": "another"}
    path = tmp_path / "results-full.json"
    write_results({**made, "scenarios": table, "problems": [], "pooled": {}}, path)
    before = path.read_bytes()
    message = fails("run", "step-mass50", "--out", str(tmp_path))
    assert "holds 1 other scenarios ('ramp-mud' first) of another learner" in message
    assert path.read_bytes() == before
    assert not any((tmp_path / "recordings").iterdir())
