"""Streams that cannot be fitted: every stage of identification ends with a status, and is drawn."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact.fit import FitStatus
from adaptive_contact.model import Window, leg_library
from adaptive_contact.robot import Robot
from adaptive_contact_studies.cache import plain
from adaptive_contact_studies.paper import identification as study
from adaptive_contact_studies.paper.collisions import ten_collisions
from adaptive_contact_studies.paper.compression import compare
from adaptive_contact_studies.paper.data import Stream
from adaptive_contact_studies.paper.figures import draw_all
from adaptive_contact_studies.paper.identification import fitted, responses
from adaptive_contact_studies.paper.rows import free_rows, worst
from adaptive_contact_studies.paper.tables import sections
from adaptive_contact_studies.paper.verdicts import headline
from adaptive_contact_studies.paper.workspace import compare_regions, workspace


def altered(stream: Stream, **arrays: np.ndarray) -> Stream:
    return Stream(stream.piece, dataclasses.replace(stream.arrays, **arrays))


def short(stream: Stream, ticks: int) -> Stream:
    names = ("measured", "desired", "valid", "swing", "contact", "force_n", "angle")
    return altered(stream, **{name: getattr(stream.arrays, name)[:ticks] for name in names})


@pytest.fixture
def quick_study(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three λ in one convention, and small windows."""
    monkeypatch.setattr(study, "LAMBDAS", (0.01, 5.0, 1e9))
    monkeypatch.setattr(study, "OUR_LAMBDAS", (0.0, 0.3, 1e9))
    small = Window(past_measured=1, past_desired=1, preview=0)
    monkeypatch.setattr(study, "PAPER_WINDOW", small)
    monkeypatch.setattr(study, "CONVENTIONS", (("rad", True, small),))
    monkeypatch.setattr(study, "_WINDOWS", (("linear", (1, 1, 0)), ("servo", (3, 3, 0))))


def told(robot: Robot, train: Stream, test: Stream, folder: Path) -> dict[str, Any]:
    """The study's tree, after all that shows it was made of it."""
    steps: list[float] = []
    found = study.identification(robot, train, test, steps.append)
    assert sum(steps) == pytest.approx(1.0)
    tree: dict[str, Any] = {"identification": plain(found)}
    assert len(sections(tree)) == 2
    headline(tree)
    draw_all(tree, folder)
    found = tree["identification"]
    assert isinstance(found, dict)
    return found


@pytest.mark.usefixtures("quick_study")
def test_a_threshold_that_removes_everything_is_told_and_never_picked(
    robot: Robot, free_stream: Stream, tmp_path: Path
) -> None:
    found = told(robot, free_stream, free_stream, tmp_path)
    points = found["sweeps"][0]["points"]
    assert [p["status"] for p in points[:2]] == ["ok", "ok"]
    assert points[-1]["status"] == "emptied"
    assert found["sweeps"][0]["emptied_at"] == points[-1]["lambda"]
    assert found["sweeps"][0]["picked"] < found["sweeps"][0]["emptied_at"]
    for selection in found["selection"]:
        assert selection["points"][-1]["status"] == "emptied"
        assert selection["picked"] < 1e9


@pytest.mark.usefixtures("quick_study")
@pytest.mark.parametrize("ticks", [0, 40])
def test_too_few_rows_have_a_status_and_no_pick(
    robot: Robot, free_stream: Stream, tmp_path: Path, ticks: int
) -> None:
    found = told(robot, short(free_stream, ticks), free_stream, tmp_path)
    sweep = found["sweeps"][0]
    assert {p["status"] for p in sweep["points"]} == {"too_few_rows"}
    assert sweep["picked"] is None
    assert found["selection"][0]["picked"] is None
    assert {p["status"] for p in found["selection"][0]["points"]} == {"too_few_rows"}


@pytest.mark.usefixtures("quick_study")
def test_constant_columns_make_a_singular_library_with_finite_figures(
    robot: Robot, free_stream: Stream, tmp_path: Path
) -> None:
    """A coxa that is told to stand still: its terms repeat each other and the constant."""
    desired, measured = free_stream.desired.copy(), free_stream.measured.copy()
    desired[:, 0] = measured[:, 0] = 0.3
    still = altered(free_stream, desired=desired, measured=measured)
    found = told(robot, still, still, tmp_path)
    point = found["sweeps"][0]["points"][0]
    assert point["status"] in ("ok", "emptied")
    assert max(point["test"]["rms_deg"]) < 1.0
    assert point["test"]["rms_deg"][0] < 1e-6
    assert point["largest"] < 1e6


@pytest.mark.usefixtures("quick_study")
def test_rows_that_are_not_finite_are_left_out(
    robot: Robot, free_stream: Stream, tmp_path: Path
) -> None:
    measured = free_stream.measured.copy()
    measured[100:160, 1], measured[700, 0] = np.nan, np.inf
    broken = altered(free_stream, measured=measured)
    library = leg_library(robot, robot.leg("rf"))
    windows = free_rows(broken, library).windows
    assert np.isfinite(windows.increment).all()
    assert 0 < len(free_rows(free_stream, library).swing) - len(windows.tick) < 150
    found = told(robot, broken, broken, tmp_path)
    assert found["sweeps"][0]["points"][0]["status"] == "ok"
    assert found["sweeps"][0]["points"][0]["test"]["position"] > 0.99


def test_the_comparison_of_too_few_rows_says_so(robot: Robot, free_stream: Stream) -> None:
    result = compare(short(free_stream, 60), leg_library(robot, robot.leg("rf")), 0.1, repeats=1)
    assert result.kept == [0, 0, 0]
    assert not result.same_support


def test_the_worst_status_stands_for_several_fits() -> None:
    assert worst([]) is FitStatus.OK
    assert worst([FitStatus.OK, FitStatus.EMPTIED, FitStatus.OK]) is FitStatus.EMPTIED
    assert worst([FitStatus.TOO_FEW_ROWS, FitStatus.OK]) is FitStatus.TOO_FEW_ROWS


def test_too_few_rows_foretell_nothing(robot: Robot, free_stream: Stream, tmp_path: Path) -> None:
    few = short(free_stream, 200)
    model, status = fitted(robot, few, "paper", study.PAPER_WINDOW, 0.1)
    assert model is None
    assert status is FitStatus.TOO_FEW_ROWS
    shown = plain(responses(robot, few, free_stream, {"paper": 0.1, "servo": 0.1}))
    assert shown["status"] == {"paper": "too_few_rows", "servo": "ok"}
    assert set(shown["paper"]) == {None}
    assert None not in shown["servo"]
    assert draw_all({"responses": shown}, tmp_path)


def test_collisions_without_a_model_are_not_called_missed(
    robot: Robot, free_stream: Stream, tmp_path: Path
) -> None:
    few = short(free_stream, 200)
    steps: list[float] = []
    tree = plain(ten_collisions(robot, few, few, 2, steps.append))
    assert sum(steps) == pytest.approx(1.0)
    assert tree["status"]["paper"] == "too_few_rows"
    assert "free ticks" in tree["status"]["default"]
    section = sections({"collisions": tree})[0]
    assert [row[3:] for row in section.tables[0].rows] == [["no model"] * 2] * 2
    assert "too_few_rows" in section.text
    assert draw_all({"collisions": tree}, tmp_path)


def test_regions_with_too_few_rows_have_a_status_and_no_error(
    robot: Robot, free_stream: Stream, tmp_path: Path
) -> None:
    """295 terms in eight regions of a tenth of the rows: some region has no model of its own."""
    few = short(free_stream, 900)
    tree = plain(workspace({"0-rf": compare_regions(robot, [few], [free_stream], few)}))
    paper = tree["libraries"]["paper"]
    assert paper["status"]["one model"] == "ok"
    assert paper["status"]["one per region"] == "too_few_rows"
    assert paper["rms_deg"]["one per region"] is None
    assert paper["difference"]["all regions seen"]["mean"] is None
    rows = {tuple(r[:2]): r for r in sections({"workspace": tree})[0].tables[0].rows}
    assert rows["paper", "one per region"][3:] == ["too_few_rows", "-"]
    assert draw_all({"workspace": tree}, tmp_path)
