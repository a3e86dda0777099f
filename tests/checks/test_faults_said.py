"""The words of faults: every name that the checks use is in the file, and no other."""

from __future__ import annotations

import ast
import re
import string
from pathlib import Path
from typing import get_args

from adaptive_contact.checks import findings


def _checks() -> list[tuple[Path, str]]:
    """The modules of checks: not the one that has a name for each cause."""
    own = Path(findings.__file__)
    rooms = (own.parent, own.parent.parent / "service")
    paths = [path for room in rooms for path in sorted(room.glob("*.py")) if path != own]
    return [(path, path.read_text("utf-8")) for path in paths]


def test_every_name_is_said_and_used() -> None:
    source = "".join(text for _, text in _checks())
    names = [name for name, words in findings.said().items() if "what" in words]
    assert {name for name in names if f'"{name}"' not in source} == set()
    # Where a name is chosen it stands in a condition, or in a table.
    assert set(re.findall(r'Fault\.of\(\s*"([\w-]+)"(?! if)', source)) <= set(names)


def test_every_name_begins_with_its_cause() -> None:
    for name, words in findings.said().items():
        if "what" in words:
            assert name.partition("-")[0] in get_args(findings.Cause)
            assert set(words) == {"level", "what", "remedy"}
            assert words["level"] in ("error", "warning", "note")


def test_every_figure_is_given() -> None:
    given_by, beside = 0, {"detail", "size", "key", "level", "total"}
    for path, text in _checks():
        for call in ast.walk(ast.parse(text)):
            if not (isinstance(call, ast.Call) and ast.unparse(call.func) == "Fault.from_table"):
                continue
            names = [n.value for n in ast.walk(call.args[0]) if isinstance(n, ast.Constant)]
            given = {str(keyword.arg) for keyword in call.keywords} - beside
            for name in set(names) & findings.said().keys():
                words = findings.said()[str(name)]
                asked = {
                    field
                    for part in ("what", "remedy")
                    for _, field, _, _ in string.Formatter().parse(words[part])
                    if field is not None
                }
                assert asked == given, f"{path.name}:{call.lineno}: {name}"
                given_by += 1
    assert given_by > 50


def test_what_befalls_most_comes_first() -> None:
    """Of one level: the whole robot, then most legs."""
    faults = [
        ("lf", findings.Fault("error", "phase", "phase", "turn it")),
        *((leg, findings.Fault("error", "not_this_robot", "no", "look")) for leg in ("rf", "lm")),
        (None, findings.Fault("error", "no_service", "no service", "start it")),
        ("lr", findings.Fault("warning", "limits", "rate", "mend it")),
    ]
    order = ["no_service", "not_this_robot", "phase", "limits"]
    assert [finding.cause for finding in findings.entries(faults)] == order
