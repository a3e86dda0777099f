"""Made once, resumed after an interruption, the same numbers either way."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from adaptive_contact.errors import ConfigurationError, SimulationDivergedError
from adaptive_contact_studies.scenarios import judge as figures_module
from adaptive_contact_studies.scenarios import runner
from adaptive_contact_studies.scenarios.judge import figures, judge_scenario
from adaptive_contact_studies.scenarios.recording import Recording, file_of
from adaptive_contact_studies.scenarios.registry import scenarios
from adaptive_contact_studies.scenarios.replay import load_replay, replay_file
from adaptive_contact_studies.scenarios.report import report_text, results_table
from adaptive_contact_studies.scenarios.results import (
    best_form,
    merge,
    read_results,
    results,
    write_results,
)
from adaptive_contact_studies.scenarios.runner import Done, Folders, jobs, run
from adaptive_contact_studies.scenarios.runs import QUICK_SIZES
from adaptive_contact_studies.scenarios.spec import RecordingSpec, Scenario, Variant

SIZES = replace(QUICK_SIZES, leg_runs=6, before_s=3.0, after_s=5.0, first_seed=9300)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    made = scenarios(SIZES)["step-mass50"]
    return replace(made, variants=(Variant.FROZEN, Variant.FULL))


@pytest.fixture(autouse=True)
def few_bootstraps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures_module, "_BOOTSTRAPS", 20)


def text_of(scenario: Scenario, folders: Folders) -> str:
    return json.dumps(figures(judge_scenario(scenario, folders)), allow_nan=False)


@pytest.fixture(scope="module")
def whole(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Folders:
    folders = Folders.of(tmp_path_factory.mktemp("whole"))
    assert run(jobs([scenario], folders), folders, processes=1) == []
    return folders


def test_what_was_made_is_not_made_again(scenario: Scenario, whole: Folders) -> None:
    assert jobs([scenario], whole) == []
    # Two runs and their two twins; one replay of each.
    assert len(list(whole.recordings.iterdir())) == 4
    assert len(list(whole.replays.iterdir())) == 4


def test_an_interrupted_run_goes_on_and_gives_the_same(
    scenario: Scenario, whole: Folders, tmp_path: Path
) -> None:
    folders = Folders.of(tmp_path)

    def interrupt(_: Done) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(jobs([scenario], folders), folders, processes=1, progress=interrupt)
    assert len(jobs([scenario], folders)) == 3
    # A file that was cut counts as missing.
    spec = next(s for s in scenario.replays if replay_file(s, folders.replays).exists())
    replay_file(spec, folders.replays).write_bytes(b"cut")
    assert load_replay(spec, replay_file(spec, folders.replays)) is None
    assert len(jobs([scenario], folders)) == 4
    run(jobs([scenario], folders), folders, processes=1)
    assert text_of(scenario, folders) == text_of(scenario, whole)


@pytest.mark.slow
def test_processes_do_not_change_the_numbers(
    scenario: Scenario, whole: Folders, tmp_path: Path
) -> None:
    folders = Folders.of(tmp_path)
    seen: list[Done] = []
    run(jobs([scenario], folders), folders, processes=2, progress=seen.append)
    assert len(seen) == 4
    assert text_of(scenario, folders) == text_of(scenario, whole)


def test_replays_outlive_recordings(scenario: Scenario, whole: Folders, tmp_path: Path) -> None:
    folders = Folders.of(tmp_path)
    run(jobs([scenario], folders), folders, processes=1)
    path = file_of(scenario.recordings[0], folders.recordings)
    before = path.read_bytes()
    path.unlink()
    assert len(jobs([scenario], folders)) == 1
    run(jobs([scenario], folders), folders, processes=1)
    assert path.read_bytes() == before


def test_results_are_merged_with_those_of_the_same_learner_only(
    scenario: Scenario, whole: Folders, tmp_path: Path
) -> None:
    judgement = judge_scenario(scenario, whole)
    tree = results([judgement], SIZES, size="quick")
    path = tmp_path / "results.json"
    assert merge(tree, path) is tree
    other = dict(tree) | {"scenarios": {"ramp-mud": tree["scenarios"]["step-mass50"]}}
    write_results(other, path)
    assert list(merge(tree, path)["scenarios"]) == ["step-mass50", "ramp-mud"]
    write_results(other | {"learner": "another", "simulator": "too"}, path)
    with pytest.raises(ConfigurationError, match="of another learner and simulator, and") as caught:
        merge(tree, path)
    assert "\n" not in str(caught.value)
    assert read_results(path)["learner"] == "another"
    # What is all made anew is replaced.
    write_results(tree | {"learner": "another"}, path)
    assert merge(tree, path) is tree
    assert results([judgement], replace(SIZES, after_s=6.0), size="quick")["sizes"] != tree["sizes"]


def test_the_form_to_publish_is_the_fullest(tmp_path: Path) -> None:
    assert best_form(tmp_path) == "full"
    found = []
    for form in ("mine", "quick", "quick-9", "brief-2", "brief-30", "brief", "full-8", "full-40"):
        (tmp_path / f"results-{form}.json").write_text("")
        found.append(best_form(tmp_path))
    assert found == [
        *("full", "quick", "quick", "brief-2", "brief-30", "brief", "full-8", "full-40"),
    ]
    (tmp_path / "results-full.json").write_text("")
    assert best_form(tmp_path) == "full"


def test_leg_runs_that_diverged_are_counted(
    scenario: Scenario, whole: Folders, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = Folders.of(tmp_path)
    real, bad = runner.made, scenario.recordings[1]

    def made(spec: RecordingSpec, folder: Path) -> Recording:
        if spec == bad:
            raise SimulationDivergedError("the simulation became unstable")
        return real(spec, folder)

    monkeypatch.setattr(runner, "made", made)
    problems = run(jobs([scenario], folders), folders, processes=1)
    assert problems == ["the run with seed 9301 has no recording: the simulation became unstable"]
    tree = results([judge_scenario(scenario, folders)], SIZES, size="full", problems=problems)
    own = tree["scenarios"]["step-mass50"]
    assert (own["leg_runs"], own["leg_runs_asked"]) == (3, 6)
    text = report_text(tree, set())
    assert "| [step-mass50](#step-mass50) | 3 of 6; 3 diverged |" in text
    assert "3 of 6 leg-runs (3 diverged)" in text
    assert problems[0] in text
    terminal = Console(width=200, file=io.StringIO())
    terminal.print(results_table(tree))
    assert "3 of 6; 3 diverged" in terminal.file.getvalue()  # type: ignore[attr-defined]


def test_the_steady_scenarios_are_told_together(
    scenario: Scenario, whole: Folders, tmp_path: Path
) -> None:
    """On the page and on the terminal, once the table has them all: also if they come by turns."""
    tree = results([judge_scenario(scenario, whole)], SIZES, size="full")
    own = tree["scenarios"]["step-mass50"] | {"goals": []}
    full = own["variants"]["full"]
    judged = full["judged"] | {"false_alarms": 40, "judged_ticks": 5 * 540_000}
    own |= {"variants": own["variants"] | {"full": full | {"judged": judged}}}
    path = tmp_path / "results-full.json"
    write_results(merge(tree | {"scenarios": {"steady-walk": own}}, path), path)
    assert read_results(path)["pooled"] == {}
    both = merge(tree | {"scenarios": {"steady-pose": own}}, path)
    text = report_text(both, set())
    names = "[steady-pose](#steady-pose) + [steady-walk](#steady-walk)"
    assert f"{names} together: 80 false alarms in 10.0 robot-hours, 8.0 (6." in text
    assert f"| {names} | false alarms per robot-hour, all that is steady | 5 | 8 |" in text
    assert "0 of 1 goals are met." in text
    terminal = Console(width=200, file=io.StringIO())
    terminal.print(results_table(both))
    told = terminal.file.getvalue()  # type: ignore[attr-defined]
    assert "steady-pose + steady-walk: 80 false alarms in 10.0 robot-hours, 8.0 per hour" in told
    assert "not met" in told


def test_no_results_are_told_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="run `adaptive-contact scenarios run --all`"):
        read_results(tmp_path / "results.json")
    (tmp_path / "results.json").write_text('{"v": 99}')
    with pytest.raises(ConfigurationError, match="not results of this version"):
        read_results(tmp_path / "results.json")


def test_the_report_says_what_the_whole_would_have_besides(
    scenario: Scenario, whole: Folders
) -> None:
    judged = [judge_scenario(scenario, whole)]
    part = report_text(results(judged, replace(SIZES, leg_runs=8), size="full"), set())
    assert "**A part of it**: 8 leg-runs of each scenario instead of 20; not run: " in part
    assert "step-friction4, " in part.split("not run: ")[1]
    assert "step-mass50" not in part.split("not run: ")[1].split("\n")[0]
