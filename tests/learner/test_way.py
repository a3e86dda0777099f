"""How many files a contact passes: what a newcomer opens to follow a sample to its event."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

MOST = 10


def test_a_contact_passes_ten_files_and_none_of_the_learning() -> None:
    """A contact in the tick that also tops its lift is assessed first: it passes more."""
    ran = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("files_of_a_tick.py"))],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True, text=True, timeout=200, check=True,
    )  # fmt: skip
    contacts = [json.loads(line) for line in ran.stdout.splitlines()]
    plain = [files for files in contacts if "detect/swing_labels.py" not in files]
    assert len(plain) >= 3
    for files in plain:
        assert len(files) <= MOST, sorted(files)
        assert not [name for name in files if name.startswith("learn/")]
        assert {"bank.py", "leg_learner.py", "detect/detector.py", "leg_report.py"} <= set(files)
