"""What the page says of figures, and the run as a whole on as little as can be simulated."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import pytest

from adaptive_contact.model import tail
from adaptive_contact_studies.paper import identification
from adaptive_contact_studies.paper.plan import QUICK
from adaptive_contact_studies.paper.report import write_document, write_report
from adaptive_contact_studies.paper.run import run_paper
from adaptive_contact_studies.work import Work

TINY = dataclasses.replace(
    QUICK,
    train_segments=120,
    test_segments=60,
    train_s={"descent": 40.0},
    tune_s={"descent": 25.0},
    free_s={"descent": 18.0},
    touch_s={"hard": 20.0, "hard slow": 12.0},
    tune_touch_s={"hard": 10.0},
)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_whole_run_is_made_again_from_what_is_kept_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tail, "MIN_EXCEEDANCES", 5)  # no threshold to be trusted, but it is one
    monkeypatch.setattr(identification, "LAMBDAS", (0.01, 5.0))
    monkeypatch.setattr(identification, "PAPER_WINDOW", identification._SHORT)
    first, again = (run_paper(Work(tmp_path / "out"), TINY) for _ in range(2))
    assert first == again
    figures = first["detection"]["figures"]
    assert figures["default"]["rows"]["headline"]["touches"] > 5
    write_report(first, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == first
    document = tmp_path / "docs" / "paper.md"
    write_document(first, document)
    text = document.read_text()
    pictures = re.findall(r"\]\((pictures/.+?)\)", text)
    assert len(pictures) == 2
    assert all((document.parent / name).stat().st_size > 5_000 for name in pictures)
    assert "nan" not in text.lower().split()
