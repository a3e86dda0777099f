"""Trees of revisions, and what their learners make of recordings; kept by content.

An outcome is named by a hash of all that decides it: the tree's modules, the recording, the
replaying program, the versions of the interpreter and the packages, and what they compute with:
BLAS has kernels of its own for each processor, which differ in the last digits.  So a revision is
replayed once, and one that differs in its documents only is not replayed at all.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import llvmlite.binding
import msgspec
import numpy  # noqa: F401 - its BLAS is among the kernels
import threadpoolctl

__all__ = [
    "ONE_THREAD",
    "PACKAGE",
    "ROOT",
    "Playing",
    "Tree",
    "load",
    "missing",
    "of_revision",
    "playing",
    "working",
]

ROOT: Final = Path(__file__).resolve().parents[2]
_PLAY: Final = Path(__file__).with_name("play.py")
# What a revision is replayed with; its simulator and its models are not used.
PACKAGE: Final = "adaptive_contact"
_NUMERIC: Final = ("numpy", "scipy", "scikit-learn", "pysindy", "msgspec", "numba", "llvmlite")
ONE_THREAD: Final = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


@dataclass(frozen=True)
class Tree:
    """A revision's package in a folder of its own.

    Attributes:
        name: for people.
        path: the folder that holds the package.
        digest: of its modules.
    """

    name: str
    path: Path
    digest: str

    @classmethod
    def at(cls, name: str, path: Path) -> Tree:
        """The tree in a folder."""
        digest = hashlib.sha256()
        for file in sorted((path / PACKAGE).rglob("*.py")):
            digest.update(f"{file.relative_to(path)}\0".encode())
            digest.update(hashlib.sha256(file.read_bytes()).digest())
        return cls(name, path, digest.hexdigest()[:16])


def of_revision(revision: str, folder: Path) -> Tree:
    """Check a git revision out into a folder.

    Raises:
        SystemExit: there is none of that name.
    """
    asked = subprocess.run(
        ["git", "rev-parse", "--verify", "--quiet", f"{revision}^{{commit}}"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    commit = asked.stdout.strip()
    if asked.returncode:
        sys.exit(f"found no revision '{revision}'; expected a commit, a branch or a tag: git log")
    path = folder / commit[:16]
    if not path.is_dir():
        archive = subprocess.run(
            ["git", "archive", commit, PACKAGE], cwd=ROOT, capture_output=True, check=True
        )
        draft = folder / f"{commit[:16]}.draft-{os.getpid()}"
        with tarfile.open(fileobj=BytesIO(archive.stdout)) as tar:
            tar.extractall(draft, filter="data")
        _put(draft, path)
    return Tree.at(revision if revision == commit else f"{revision} ({commit[:7]})", path)


def working(folder: Path, name: str = "working tree") -> Tree:
    """Copy the working tree's package, so that it may be edited meanwhile."""
    path = folder / f"working-{os.getpid()}"
    shutil.rmtree(path, ignore_errors=True)
    source = ROOT / PACKAGE
    shutil.copytree(source, path / PACKAGE, ignore=shutil.ignore_patterns("__pycache__"))
    return Tree.at(name, path)


@dataclass
class Playing:
    """Recordings that a tree's learners replay in processes of their own.

    Attributes:
        tree: whose.
        outcomes: file of each recording, complete once it is there.
        processes: by recording, of those that are being replayed.
    """

    tree: Tree
    outcomes: dict[str, Path]
    processes: dict[str, subprocess.Popen[str]]

    def done(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Recordings with their outcomes, in the order asked for, as they are finished.

        Raises:
            SystemExit: a process ended before all were.
        """
        for name, path in self.outcomes.items():
            while not path.is_file():
                process = self.processes[name]
                assert process.stdout is not None
                # A line for each file, which is there when its line is.
                if not process.stdout.readline() and not path.is_file():
                    sys.exit(
                        f"{self.tree.name}: replaying '{name}' ended with code {process.wait()}; "
                        "expected an outcome: see above"
                    )
            yield name, load(path)

    def end(self) -> None:
        """End the processes; whatever is finished stays."""
        for process in {id(one): one for one in self.processes.values()}.values():
            process.kill()
            process.communicate()


def missing(tree: Tree, recordings: Mapping[str, Path], folder: Path) -> list[str]:
    """Names of recordings that have no outcome yet."""
    outcomes = _files(tree, recordings, folder)
    return [name for name, path in outcomes.items() if not path.is_file()]


@contextmanager
def playing(
    tree: Tree, recordings: Mapping[str, Path], folder: Path, *, processes: int = 1
) -> Iterator[Playing]:
    """Replay recordings that have no outcome yet, in processes that end with the context.

    Args:
        tree: whose learners.
        recordings: files, by name.
        folder: of outcomes.
        processes: at most so many at a time.
    """
    outcomes = _files(tree, recordings, folder)
    folder.mkdir(parents=True, exist_ok=True)
    wanted = missing(tree, recordings, folder)
    one = Playing(tree, outcomes, {})
    try:
        for first in range(min(processes, len(wanted))):
            names = wanted[first::processes]
            files = [str(f) for name in names for f in (recordings[name], outcomes[name])]
            process = subprocess.Popen(
                [sys.executable, "-P", str(_PLAY), str(tree.path), *files],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(tree.path)},
                stdout=subprocess.PIPE,
                text=True,
            )
            one.processes |= dict.fromkeys(names, process)
        yield one
    finally:
        one.end()


def load(path: Path) -> dict[str, Any]:
    """An outcome from its file."""
    outcome: dict[str, Any] = msgspec.msgpack.decode(path.read_bytes())
    return outcome


def tidy(folder: Path, keep: Sequence[Path]) -> None:
    """Drop outcomes that have not been asked for lately: the oldest beyond a gigabyte."""
    room = 1_000_000_000
    files = sorted(folder.glob("*.msgpack"), key=lambda f: f.stat().st_mtime, reverse=True)
    for file in files:
        room -= file.stat().st_size
        if room < 0 and file not in keep:
            file.unlink()


def _files(tree: Tree, recordings: Mapping[str, Path], folder: Path) -> dict[str, Path]:
    return {name: folder / f"{name}-{_key(tree, of)}.msgpack" for name, of in recordings.items()}


def _key(tree: Tree, recording: Path) -> str:
    digest = hashlib.sha256(f"{tree.digest} {recording.name} {sys.version}".encode())
    for package in _NUMERIC:
        try:
            digest.update(f"{package} {importlib.metadata.version(package)}\0".encode())
        except importlib.metadata.PackageNotFoundError:
            digest.update(f"{package} -\0".encode())
    digest.update(_PLAY.read_bytes())
    kernels = sorted(str(one.get("architecture")) for one in threadpoolctl.threadpool_info())
    digest.update(f"{kernels} {llvmlite.binding.get_host_cpu_name()}".encode())
    return digest.hexdigest()[:16]


def _put(draft: Path, path: Path) -> None:
    try:
        draft.replace(path)
    except OSError:  # another run was faster
        shutil.rmtree(draft)
