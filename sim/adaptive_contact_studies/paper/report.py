"""``results.json``, the figures, and one page that holds everything."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from adaptive_contact_studies.paper.figures import draw_all
from adaptive_contact_studies.paper.tables import markdown
from adaptive_contact_studies.paper.verdicts import headline
from adaptive_contact_studies.show.pages import read_sections, render, unwrapped, write_page

_TITLE: Final = "Leg contact detection from positions: the paper, and what it leaves out"
_ADVICE: Final = "give another folder with --out"


def write_report(results: Mapping[str, Any], out: Path) -> None:
    """Write results, figures and page.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False)
    write_page(out / "results.json", text + "\n", _ADVICE)
    text = _text(results, draw_all(results, out / "figures"))
    write_page(out / "report.html", render("report.html", sections=read_sections(text)), _ADVICE)


def write_document(results: Mapping[str, Any], document: Path, pictures: Path) -> None:
    """Write the run as a Markdown document with its pictures."""
    files = draw_all(results, pictures)
    beside = {name: file.relative_to(document.parent) for name, file in files.items()}
    write_page(document, _text(results, beside) + "\n", "give another file with --docs")


def _text(results: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    front = render("paper/page.md", title=_TITLE, results=results, headline=headline(results))
    return f"{unwrapped(front)}\n\n{markdown(results, pictures)}".rstrip()
