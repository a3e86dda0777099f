"""Trees of revisions, and what their learners make of recordings."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import msgspec

ROOT: Final = Path(__file__).resolve().parents[2]
# What a revision is replayed with; its simulator and its models are not used.
PACKAGE: Final = "adaptive_contact"
ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


def of_revision(revision: str, folder: Path) -> Path:
    """Check a git revision's package out into a folder.

    Raises:
        SystemExit: there is none of that name.
    """
    asked = subprocess.run(
        ["git", "archive", revision, PACKAGE], cwd=ROOT, capture_output=True, check=False
    )
    if asked.returncode:
        sys.exit(f"found no revision '{revision}'; expected a commit, a branch or a tag: git log")
    with tarfile.open(fileobj=BytesIO(asked.stdout)) as tar:
        tar.extractall(folder, filter="data")
    return folder


def replayed(
    trees: Sequence[Path], recordings: Mapping[str, Any], folder: Path
) -> list[dict[str, dict[str, Any]]]:
    """What the learners of each tree make of recordings, by name; all trees at a time.

    Raises:
        SystemExit: a process ended before all were replayed.
    """
    files = {name: folder / f"{name}.recording" for name in recordings}
    for name, path in files.items():
        path.write_bytes(msgspec.msgpack.encode(recordings[name]))
    processes, outcomes = [], []
    for number, tree in enumerate(trees):
        outcomes.append({name: folder / f"{name}.{number}" for name in recordings})
        pairs = [str(f) for name in recordings for f in (files[name], outcomes[-1][name])]
        processes.append(
            subprocess.Popen(
                [sys.executable, "-P", str(Path(__file__).with_name("play.py")), str(tree), *pairs],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(tree)},
            )
        )
    codes = [process.wait() for process in processes]
    if any(codes):
        sys.exit(f"replaying ended with codes {codes}; expected outcomes: see above")
    return [
        {name: msgspec.msgpack.decode(path.read_bytes()) for name, path in of.items()}
        for of in outcomes
    ]
