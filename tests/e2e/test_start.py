"""Commands start quickly: what is not needed is not imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.e2e

# PySINDy alone takes 1.6 s to import.
HEAVY = ("pysindy", "sklearn", "mujoco", "matplotlib", "PIL", "zenoh", "mcap", "dynamixel_sdk")

CODE = """
import sys
sys.argv = ["adaptive-contact", *sys.argv[1:]]
from adaptive_contact.cli.main import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print("imported:", *({name.partition(".")[0] for name in sys.modules}))
"""

COMMANDS = ("serve", "watch", "doctor", "record", "replay", "score", "fit", "demo", "sim walk")


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_imports_nothing_heavy(environment: Any, tmp_path: Path, command: str) -> None:
    done = environment.run("-c", CODE, *command.split(), "--help", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Usage" in done.stdout
    imported = done.stdout.rpartition("imported:")[2].split()
    assert "adaptive_contact" in imported
    assert sorted(set(imported) & set(HEAVY)) == []


def test_importing_the_package_imports_nothing_heavy(environment: Any, tmp_path: Path) -> None:
    code = 'import sys, adaptive_contact; print(*{n.partition(".")[0] for n in sys.modules})'
    done = environment.run("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(set(done.stdout.split()) & set(HEAVY)) == []
