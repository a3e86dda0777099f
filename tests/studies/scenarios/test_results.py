"""The command line of the scenarios, from recordings to the page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from adaptive_contact.cli.scenarios import app
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact_studies.scenarios import runs
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.report import table, write_report
from adaptive_contact_studies.scenarios.results import pooled, read_results

RUN = CliRunner()
SHORT = replace(runs.QUICK_SIZES, before_s=3.0, after_s=6.0, first_seed=9400, leg_runs=6)


def fails(*arguments: str) -> str:
    result = RUN.invoke(app, arguments)
    assert isinstance(result.exception, AdaptiveContactError), result.output
    message = str(result.exception)
    assert "\n" not in message
    return message


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "QUICK_SIZES", SHORT)


def test_list_shows_every_scenario() -> None:
    rows = json.loads(RUN.invoke(app, ["list", "--json"]).output)
    assert [row["name"] for row in rows] == list(scenarios())
    assert all(row["leg_runs"] >= 20 for row in rows)
    shown = RUN.invoke(app, ["list"])
    assert shown.exit_code == 0
    assert "caught-30s" in shown.output


def test_what_cannot_be_run_is_one_line(tmp_path: Path) -> None:
    assert "did you mean 'ramp-mud'?" in fails("run", "ramp-mut")
    assert "or give --all" in fails("run")
    assert "give names or --all" in fails("run", "ramp-mud", "--all")
    assert "no results there" in fails("report", "--out", str(tmp_path))
    (tmp_path / "results.json").write_text('{"v": 99}')
    assert "no results there (another version)" in fails("report", "--out", str(tmp_path))


@pytest.mark.usefixtures("short")
def test_a_run_is_measured_and_shown(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["run", "step-mass50", "--quick", "--processes", "1", "--out", str(out), "--json"]
    result = RUN.invoke(app, [*arguments, "--seeds", "3"])
    assert result.exit_code == 0, result.output
    tree = json.loads(result.stdout)
    own = tree["scenarios"]["step-mass50"]
    assert own["leg_runs"] == 3
    assert set(own["variants"]) == {"frozen", "rls", "full"}
    assert read_results(out / "results.json") == tree

    result = RUN.invoke(app, ["report", "--out", str(out), "--docs", str(tmp_path / "docs")])
    assert result.exit_code == 0, result.output
    text = (tmp_path / "docs" / "adaptation.md").read_text(encoding="utf-8")
    assert "| [step-mass50](#step-mass50) | 3 |" in text
    part = next(line for line in text.splitlines() if line.startswith("**A part of it**"))
    assert "leg_runs 3 instead of 20" in part
    assert "step-friction4, " in part
    assert "step-mass50" not in part


def test_the_steady_scenarios_are_pooled_once_the_table_has_both(tmp_path: Path) -> None:
    judged = {
        "recall": 1.0, "recall_interval": [0.9, 1.0], "false_alarms": 40,
        "judged_ticks": 5 * 540_000, "per_robot_hour": 8.0, "per_robot_hour_interval": [6.0, 10.0],
    }  # fmt: skip
    own = {
        "before": judged, "judged": judged, "recovery": {}, "longest_lock_out": 0,
        "touching_share": 0.0, "recall_lost_points": None, "touching_ticks_confirmed": 0,
        "caught_swings": 0,
    }  # fmt: skip
    tree = {
        "about": "nothing", "leg_runs": 3, "recordings": 1, "simulated_s": 9.0,
        "counts_as_one_to_recover_from": None, "variants": {"full": own}, "goals": [],
    }  # fmt: skip
    whole = {
        "sizes": vars(runs.FULL_SIZES), "learner": "a", "simulator": "b",
    }  # fmt: skip
    assert pooled({"steady-walk": tree}) == {}
    steady = {"steady-walk": tree, "steady-pose": tree}
    both = whole | {"scenarios": steady, "pooled": pooled(steady)}
    names = "[steady-pose](#steady-pose) + [steady-walk](#steady-walk)"
    assert f"{names} together: 80 false alarms in 10.0 robot-hours, 8.0 (6." in table(both)
    text = write_report(both, tmp_path).read_text(encoding="utf-8")
    assert f"| {names} | false alarms per robot-hour, all that is steady | 5 | 8 |" in text
    assert "0 of 1 goals are met." in text
