"""docs/simulator.md says what the code does."""

from __future__ import annotations

import re
from pathlib import Path

from adaptive_contact_sim.scenario import parse_scenario

TEXT = (Path(__file__).parents[2] / "docs/simulator.md").read_text(encoding="utf-8")


def row(start: str) -> list[str]:
    (line,) = (line for line in TEXT.splitlines() if line.startswith(f"| {start}"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_scenario_in_it_can_be_run() -> None:
    blocks = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    assert len(blocks) == 1
    assert parse_scenario(blocks[0], name="doc").settings.drift[0].at_s == 60.0


def test_the_python_in_it_runs() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    names: dict[str, object] = {}
    exec(block.replace("seconds=300", "seconds=3"), names)
    assert names["leg"].measured.shape == (150, 3)  # type: ignore[attr-defined]
