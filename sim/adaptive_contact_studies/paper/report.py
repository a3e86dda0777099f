"""``results.json``, the figures, and one page that holds everything."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from adaptive_contact_studies.paper.figures import draw_all
from adaptive_contact_studies.paper.tables import Headline, headline, sections
from adaptive_contact_studies.show.pages import render, write_page
from adaptive_contact_studies.show.tables import Table

__all__ = ["write_document", "write_report"]

_TITLE: Final = "Leg contact detection from positions: the paper, and what it leaves out"
_CAPTIONS: Final = {
    "paper-workspace": "Figure 3 of the paper: workspace (1 cm grid), subspaces, places of feet. "
    "From above the upper subspace shows around the lower one.",
    "paper-responses": "Figure 2 of the paper: femur command, response, predictions; shaded: hold.",
    "paper-sweep": "Figure 4 of the paper (top), the naive prediction (test set) on its own scale, "
    "and what R² does not show. Violet: the λ picked on held-out swings; dashed: λ = 5; grey: some "
    "state has lost all its terms.",
    "paper-collision": "Figure 5 of the paper: one collision (the one drawn in the table). The "
    "predicted error is the reading less what was predicted a tick before; the rule looks at the "
    "change of its size.",
    "paper-roc": "Thresholds swept, on the headline's touches; circles: the aim of one false alarm "
    "per hour. Star: the default detector as it runs, squares: played at other aims; cross: the "
    "ungated learner. Left end: no false alarm was seen, drawn where half an alarm would be. Right "
    "end: with a lower threshold so many free ticks pass that alarms are not counted. A curve that "
    "falls to the right misses touches because of a false alarm shortly before.",
    "paper-tails": "Share of free ticks that score above a value, and above it the highest score "
    "within 120 ms of a headline touch (5, 50, 95 %): a detector finds the touches that score "
    "right of its threshold.",
    "paper-limits": "Recall against speed and force; shaded: what a servo step is at a stretched "
    "leg's foot (speed: in one tick and in three; force: against the servo's drive).",
    "paper-residual-map": "Residual over the workspace, before and after; dashed: the paper's "
    "subspaces; white: not enough held-out swings, or out of reach.",
}
_ADVICE: Final = "give another folder with --out"


def write_report(results: Mapping[str, Any], out: Path) -> None:
    """Write results, figures and page.

    Args:
        results: the tree of a run.
        out: folder.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False)
    write_page(out / "results.json", text + "\n", _ADVICE)
    page = _page("report.html", results, draw_all(results, out / "figures"))
    write_page(out / "report.html", page, _ADVICE)


def write_document(results: Mapping[str, Any], document: Path, pictures: Path) -> None:
    """Write the run as a Markdown document with its pictures.

    Args:
        results: the tree of a run.
        document: the file, such as ``docs/paper.md``.
        pictures: folder of the pictures, beside or below the document's.
    """
    files = draw_all(results, pictures)
    beside = {name: file.relative_to(document.parent) for name, file in files.items()}
    text = _page("report.md", results, beside)
    write_page(document, text.rstrip() + "\n", "give another file with --docs")


def _page(template: str, results: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    return render(
        template,
        title=_TITLE,
        captions=_CAPTIONS,
        origin=_origin(results),
        promises=_promises(headline(results)),
        sections=sections(results),
        pictures=pictures,
    )


def _origin(results: Mapping[str, Any]) -> str:
    machine = results["machine"]
    return (
        f"Made by `{results['command']}` (plan `{results['plan']['name']}`, seed "
        f"{results['plan']['seed']}) on {machine['cores']} cores, Python {machine['python']}; "
        f"simulator {results['physics']}, source {results['source']}. Every figure and table "
        "below is written by the command; `results.json` holds all numbers."
    )


def _promises(lines: list[Headline]) -> Table:
    words = {True: "yes", False: "**no**", None: "-"}
    rows = [[h.what, h.wanted, h.measured, words[h.kept]] for h in lines]
    return Table("The numbers asked for", ["what", "asked for", "measured", "reached"], rows)
