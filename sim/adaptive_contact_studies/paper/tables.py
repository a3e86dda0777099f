"""What a run found, as text: templates hold the words, ``results.json`` the figures.

Nothing here is a number of its own.  A stage's template in ``show/templates/paper`` makes Markdown
of its part of the tree; the page in HTML and the terminal show what that Markdown says.
"""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from adaptive_contact_studies.paper.figures import draw_all
from adaptive_contact_studies.paper.rows import NO_MODEL
from adaptive_contact_studies.paper.touched import BOTH, SLOW_FAST
from adaptive_contact_studies.paper.verdicts import HALF, headline, losses, span
from adaptive_contact_studies.show.numbers import general, number, per_joint
from adaptive_contact_studies.show.pages import (
    Section,
    read_sections,
    render,
    unwrapped,
    write_page,
)

Tree = Mapping[str, Any]

_TITLE: Final = "Leg contact detection from positions: the paper, and what it leaves out"
_ADVICE: Final = "give another folder with --out"
# Stages with a template, in the order of the page.
_PARTS: Final = (
    *("dataset", "identification", "compression", "collisions", "detection", "workspace", "logs"),
)
_HELD_OUT: Final = ("unseen motions", "unseen moments")


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


def part(name: str, data: Any, pictures: Mapping[str, Path] = {}) -> str:
    """Markdown of one stage."""
    given = {"data": data, "pictures": pictures, "BOTH": BOTH, "SLOW_FAST": SLOW_FAST}
    return unwrapped(render(f"paper/{name}.md", _FILTERS, **given))


def markdown(results: Tree, pictures: Mapping[str, Path] = {}) -> str:
    """Markdown of every stage that ran."""
    ran = (name for name in _PARTS if results.get(name))
    return "\n\n".join(part(name, results[name], pictures) for name in ran)


def sections(results: Tree) -> list[Section]:
    """Every section whose stage ran."""
    return read_sections(markdown(results))


def _at(sweep: Tree, threshold: float | None) -> Tree | None:
    """The point of a sweep at one λ."""
    return next((p for p in sweep["points"] if p["lambda"] == threshold), None)


def _model(point: Tree | None) -> Tree:
    """A point with a model, or nothing."""
    return point if point and point["status"] not in NO_MODEL else {}


def _at_five(sweeps: Sequence[Tree]) -> tuple[list[Tree], list[tuple[Tree, Tree, list[float]]]]:
    """Sweeps whose model λ = 5 breaks; the others with their point, and its error over the best."""
    lost, kept = [], []
    for sweep in sweeps:
        point, best = _at(sweep, 5.0), _at(sweep, sweep["picked"])
        if point is None or point["status"] != "ok":
            lost.append(sweep)
            continue
        errors = [p["test"]["over_floor"] for p in (point, best) if p]
        kept.append((sweep, point, [a / b for a, b in zip(*errors, strict=True)] if best else []))
    return lost, kept


def _tails(data: Tree) -> Iterator[tuple[str, Tree, Tree, Tree | None]]:
    """The paper's detectors that find little at their target rate; their lowest threshold."""
    for name, tail in data["tails"].items():
        own = data["figures"][name]
        row = own["summary"]["rows"]["headline"]
        if not name.startswith("paper") or tail["peaks"] is None or row["recall"] > HALF:
            continue
        counted = [p for p in own["roc"] if p["per_hour"] is not None]
        yield name, tail, row, max(counted, key=lambda p: p["recall"] or 0.0, default=None)


def _before(data: Tree) -> dict[str, Tree]:
    """What the models of the paper's subspaces do on other swings, by library."""
    own = {name: library["before"] or {} for name, library in data["libraries"].items()}
    return {
        name: before
        for name, before in own.items()
        if None not in (before.get("unknown_deg"), before.get("known_deg"))
    }


def _over(rms: float | Sequence[float] | None, floor: float) -> str:
    """Errors as multiples of the noise floor."""
    if rms is None or isinstance(rms, float):
        return number(rms and rms / floor, 1)
    return per_joint([value / floor for value in rms])


def _fitted(rms: Sequence[float] | None, status: str) -> str:
    """Errors of a fit, and its status unless all is well."""
    if rms is None:
        return status
    return per_joint(rms, 3) + ("" if status == "ok" else f" ({status})")


def _best(errors: Mapping[str, float | None]) -> tuple[str, float, float] | None:
    """The library with the least error, the error, and that of the default's."""
    known = {name: error for name, error in errors.items() if error is not None}
    if "servo" not in known:
        return None
    best = min(known, key=lambda name: known[name])
    return best, known[best], known["servo"]


def _best_held_out(arm: Tree) -> dict[str, tuple[str, float, float]]:
    """The best library by what was held out."""
    found = {}
    for held_out in _HELD_OUT:
        errors = (arm[held_out].get("rms_deg") or {}).items()
        best = _best({name: rms and sum(rms) / len(rms) for name, rms in errors})
        if best:
            found[held_out] = best
    return found


def _alarmed(arm: Tree) -> dict[str, Tree]:
    """False alarms, where they are many more than the target rate."""
    found = {held_out: arm[held_out].get("false_alarms") or {} for held_out in _HELD_OUT}
    return {
        held_out: alarms
        for held_out, alarms in found.items()
        if alarms.get("per_hour") is not None and alarms["events"] > 1 + 3 * alarms["expected"]
    }


def _gains(pendulum: Tree) -> list[str]:
    return [general(gain) for gain in pendulum["gains"]]


def _gain_ratios(pendulum: Tree) -> list[float]:
    """Error of a model of another gain over that of one of the gain it is tried at."""
    gains, own = _gains(pendulum), pendulum["libraries"]["servo"]["rms_deg"]
    return [
        own[fitted][tried] / own[tried][tried]
        for fitted in gains
        for tried in gains
        if fitted != tried and own[fitted][tried] is not None and own[tried][tried]
    ]


def _best_at_gains(pendulum: Tree) -> dict[str, tuple[str, float, float]]:
    """The best library at every gain, refitted there."""
    libraries = pendulum["libraries"].items()
    found = {
        gain: _best({name: library["rms_deg"][gain][gain] for name, library in libraries})
        for gain in _gains(pendulum)
    }
    return {gain: best for gain, best in found.items() if best}


_FILTERS: Final[Mapping[str, Any]] = {
    "alarmed": _alarmed,
    "at": _at,
    "at_five": _at_five,
    "before": _before,
    "best_at_gains": _best_at_gains,
    "best_held_out": _best_held_out,
    "degrees": math.degrees,
    "fitted": _fitted,
    "gain_ratios": _gain_ratios,
    "gains": _gains,
    "losses": losses,
    "median": statistics.median,
    "model": _model,
    "over": _over,
    "span": span,
    "tails": _tails,
}
