"""``results.json``, the figures, and one page that holds everything."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.files import cannot_write, write_file
from adaptive_contact_studies.paper.figures import draw_all
from adaptive_contact_studies.paper.tables import Headline, headline, sections
from adaptive_contact_studies.paper.tables_format import Section, Table

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
_STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem;
       color: #1b1e22; background: #fff; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: .8rem 0; font-size: .82rem; display: block;
        overflow-x: auto; max-width: 100%; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
th, td { border-bottom: 1px solid #dde1e6; padding: .2rem .6rem; text-align: right;
         white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1rem 0; } figcaption { font-size: .82rem; color: #555; }
img { max-width: 100%; } code { background: #f1f3f5; padding: 0 .2rem; }
.yes { color: #00724f; font-weight: 600; } .no { color: #b3261e; font-weight: 600; }
"""


_ADVICE: Final = "give another folder with --out"


def write_report(results: Mapping[str, Any], out: Path) -> None:
    """Write results, figures and page.

    Args:
        results: the tree of a run.
        out: folder.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(results, indent=1, ensure_ascii=False, allow_nan=False)
        write_file(out / "results.json", text + "\n", advice=_ADVICE)
        pictures = draw_all(results, out / "figures")
        write_file(out / "report.html", _page(results, pictures), advice=_ADVICE)
    except OSError as error:
        raise ConfigurationError(cannot_write(out, error, _ADVICE)) from error


def write_document(results: Mapping[str, Any], document: Path, pictures: Path) -> None:
    """Write the run as a Markdown document with its pictures.

    Args:
        results: the tree of a run.
        document: the file, such as ``docs/paper.md``.
        pictures: folder of the pictures, beside or below the document's.
    """
    files = draw_all(results, pictures)
    document.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"# {_TITLE}", "", _origin(results), ""]
    lines += _markdown(_promises(headline(results)))
    for section in sections(results):
        lines += [f"## {section.title}", "", section.text, ""]
        for name in section.pictures:
            if name in files:
                where = files[name].relative_to(document.parent)
                lines += [f"![{_CAPTIONS[name]}]({where})", "", f"*{_CAPTIONS[name]}*", ""]
        for table in section.tables:
            lines += _markdown(table)
    write_file(document, "\n".join(lines).rstrip() + "\n")


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


def _markdown(table: Table) -> list[str]:
    def line(cells: Any) -> str:
        return "| " + " | ".join(str(c).replace("|", "\\|") for c in cells) + " |"

    rule = "|" + "---|" * len(table.header)
    return [f"**{table.title}**", "", line(table.header), rule, *map(line, table.rows), ""]


def _page(results: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    parts = [f"<h1>{html.escape(_TITLE)}</h1>", f"<p>{_inline(_origin(results))}</p>"]
    parts.append(_table(_promises(headline(results))))
    for section in sections(results):
        parts.append(_section(section, pictures))
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(_TITLE)}</title><style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def _section(section: Section, pictures: Mapping[str, Path]) -> str:
    parts = [f"<h2>{html.escape(section.title)}</h2>", f"<p>{_inline(section.text)}</p>"]
    for name in section.pictures:
        if name in pictures:
            data = base64.b64encode(pictures[name].read_bytes()).decode()
            caption = html.escape(_CAPTIONS[name])
            parts.append(
                f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
                f"<figcaption>{caption}</figcaption></figure>"
            )
    parts += [_table(table) for table in section.tables]
    return "\n".join(parts)


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in table.header)
    rows = []
    for row in table.rows:
        cells = []
        for cell in row:
            mark = {"yes": ' class="yes"', "**no**": ' class="no"'}.get(cell, "")
            cells.append(f"<td{mark}>{_inline(cell)}</td>")
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return (
        f"<table><caption>{_inline(table.title)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _inline(text: str) -> str:
    """Escaped, with ``**bold**`` and backticks."""
    safe = html.escape(text)
    safe = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", safe)
    return re.sub(r"`(.+?)`", r"<code>\1</code>", safe)
