"""The notebook in `examples/` runs from its first cell to its last, and is kept without output."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "recording_to_events.ipynb"


def test_the_repository_keeps_no_output() -> None:
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.filterwarnings("ignore")  # of Jupyter's own packages
def test_the_notebook_goes_from_a_recording_to_events(tmp_path: Path) -> None:
    import nbclient
    import nbformat

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    told = "".join(
        output.get("text", "")
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if output.output_type == "stream"
    )
    contacts = re.search(r"(\d+) contacts", told)
    assert int(contacts[1]) > 50
    assert "false alarms per robot-hour" in told
    assert "walk.html: " in told
