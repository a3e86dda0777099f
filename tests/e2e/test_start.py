"""Commands start quickly: what is not needed is not imported."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.e2e

# PySINDy alone takes 1.6 s to import.
HEAVY = {
    "pysindy",
    "sklearn",
    "mujoco",
    "matplotlib",
    "PIL",
    "jinja2",
    "zenoh",
    "mcap",
    "dynamixel_sdk",
    "scservo_sdk",
}

COMMANDS = ("", "serve", "watch", "doctor", "record", "replay", "score", "fit", "demo", "sim walk")

# Prints what was imported once each command has shown its help, as one line of JSON.
CODE = """
import json, sys
from adaptive_contact.cli.main import app, load_commands
load_commands()
imported = {}
for command in json.loads(sys.argv[1]):
    app([*command.split(), "--help"], standalone_mode=False)
    imported[command] = sorted({name.partition(".")[0] for name in sys.modules})
print()
print(json.dumps(imported))
"""


def test_help_imports_nothing_heavy(installed: Any, tmp_path: Path) -> None:
    done = installed.run("-c", CODE, json.dumps(COMMANDS), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage:") == len(COMMANDS)
    imported = json.loads(done.stdout.splitlines()[-1])
    for command in COMMANDS:
        assert "adaptive_contact" in imported[command]
        assert set(imported[command]) & HEAVY == set(), f"{command} --help"


@pytest.mark.parametrize(
    ("imports", "without"),
    [
        ("import adaptive_contact", HEAVY),
        # It takes as long as all else; the first learner loads it.
        ("from adaptive_contact import ContactLearner", {"numba", "llvmlite", "scipy", *HEAVY}),
    ],
)
def test_an_import_loads_nothing_heavy(
    installed: Any, tmp_path: Path, imports: str, without: set[str]
) -> None:
    code = f"{imports}; import sys; print(*sys.modules)"
    done = installed.run("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    imported = {name.partition(".")[0] for name in done.stdout.split()}
    assert "adaptive_contact" in imported
    assert imported & without == set()
