"""The words of faults: every name that the checks use is in the file, and no other."""

from __future__ import annotations

import re
from pathlib import Path

from adaptive_contact.service import findings


def test_every_name_is_said_and_used() -> None:
    source = "".join(p.read_text("utf-8") for p in Path(findings.__file__).parent.glob("*.py"))
    names = [name for name, words in findings.said().items() if "what" in words]
    assert {name for name in names if f'"{name}"' not in source} == set()
    # Where a name is chosen it stands in a condition, or in a table.
    assert set(re.findall(r'Fault\.of\(\s*"([\w-]+)"(?! if)', source)) <= set(names)


def test_every_name_begins_with_its_cause() -> None:
    for name, words in findings.said().items():
        if "what" in words:
            assert findings.Cause(name.partition("-")[0])
            assert set(words) == {"level", "what", "remedy"}
            assert words["level"] in ("error", "warning", "note")
