"""A walk of the shipped hexapod, simulated once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def walk_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its recording, of a minute and a half."""
    path: Path = tmp_path_factory.mktemp("walk") / "walk.mcap"
    words = ["sim", "walk", "--seconds", "90", "--seed", "4", "--offline", "--record", str(path)]
    # A process of its own: the command takes signals over.
    subprocess.run([sys.executable, "-m", "adaptive_contact", *words], check=True, timeout=600)
    return path
