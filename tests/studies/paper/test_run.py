"""The run as a whole, on as little as can be simulated."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import Robot
from adaptive_contact.score import Events
from adaptive_contact_studies.evaluate import play
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.evaluation import play_streams
from adaptive_contact_studies.paper.plan import QUICK
from adaptive_contact_studies.paper.run import run_paper
from adaptive_contact_studies.paper.tables import write_document

TINY = dataclasses.replace(QUICK, train_segments=120, test_segments=40)


def quiet() -> Console:
    return Console(quiet=True)


def test_a_run_writes_its_results_and_says_what_it_left_out(tmp_path: Path) -> None:
    results = run_paper(
        tmp_path, TINY, workers=1, stages=("dataset", "logs"), logs=None, console=quiet()
    )
    assert results["dataset"]["touches"] == 0
    assert "no recordings" in results["logs"]["skipped_stage"]
    stored = json.loads((tmp_path / "results.json").read_text())
    assert stored == results
    page = (tmp_path / "report.html").read_text()
    assert "data:image/png;base64," in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "Skipped" in page
    document = tmp_path / "docs" / "paper.md"
    write_document(results, document, tmp_path / "docs" / "pictures")
    for name in re.findall(r"\]\((.+?)\)", document.read_text()):
        assert (document.parent / name).is_file()


def test_the_same_run_again_gives_the_same_numbers(tmp_path: Path) -> None:
    first, again = (
        run_paper(tmp_path / name, TINY, workers=1, stages=("dataset",), console=quiet())
        for name in ("one", "two")
    )
    assert first == again


def test_recordings_that_are_not_there_are_skipped_with_a_reason(tmp_path: Path) -> None:
    results = run_paper(
        tmp_path, TINY, workers=1, stages=("logs",), logs=tmp_path / "nowhere", console=quiet()
    )
    assert "no such file" in results["logs"]["skipped_stage"]


def test_an_unknown_stage_is_told(tmp_path: Path) -> None:
    import typer

    from adaptive_contact.cli.paper import paper

    app = typer.Typer()
    app.command()(paper)
    result = CliRunner().invoke(app, ["--out", str(tmp_path), "--stage", "nonsense"])
    assert isinstance(result.exception, ConfigurationError)
    assert "identification" in str(result.exception)


def test_the_report_tells_the_whole_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All options, and one BLAS thread while it runs."""
    import typer
    from threadpoolctl import threadpool_info, threadpool_limits

    from adaptive_contact.cli.paper import paper
    from adaptive_contact_studies.paper import run

    threads: list[int] = []

    def told(_: object) -> dict[str, str]:
        threads.extend(pool["num_threads"] for pool in threadpool_info())
        return {"skipped_stage": "for a test"}

    monkeypatch.setattr(run.Runner, "logs", told)
    app = typer.Typer()
    app.command()(paper)
    document = tmp_path / "a page.md"
    words = ["--quick", "--out", str(tmp_path / "out"), "--seed", "7", "--stage", "logs"]
    with threadpool_limits(2):
        result = CliRunner().invoke(app, [*words, "--docs", str(document)])
    assert result.exit_code == 0, result.output
    command = f"adaptive-contact paper {' '.join(words)} --docs '{document}'"
    # In the order of the options' own list.
    assert sorted(command.split()) == sorted(
        json.loads((tmp_path / "out" / "results.json").read_text())["command"].split()
    )
    assert f"--docs '{document}'" in document.read_text()
    assert set(threads) == {1}


def test_streams_side_by_side_decide_what_they_decide_alone(
    robot: Robot, touched_stream: Stream
) -> None:
    baseline = shipped_baseline(robot.name)
    if baseline is None:
        pytest.skip("no shipped baseline: run `make baseline`")
    short = dataclasses.replace(
        touched_stream,
        arrays=dataclasses.replace(
            touched_stream.arrays,
            measured=touched_stream.measured[:900],
            desired=touched_stream.desired[:900],
            valid=touched_stream.arrays.valid[:900],
            swing=touched_stream.swing[:900],
        ),
    )
    together = play_streams(robot, {0: baseline}, [touched_stream, short])
    for stream, events in zip((touched_stream, short), together, strict=True):
        alone = Events.of(play(stream.run, robot, baseline).events["rf"])
        assert len(alone.t_ns) > 3
        for a, b in zip(events, alone, strict=True):
            np.testing.assert_array_equal(a, b)
