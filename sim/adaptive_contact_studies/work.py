"""Does work in parallel, keeps each result, and goes on after an interruption (joblib).

A result is kept under a key of what decides it: the function, its argument, and the sources and
versions that it rests on.  So a run that stopped goes on where it was, and ends with the same
numbers; a result of other sources is never shown.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError
from threadpoolctl import threadpool_limits

from adaptive_contact.errors import ConfigurationError

T = TypeVar("T")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., Any])

# What decides a recording, and what decides what a learner makes of it.
SIMULATOR: Final = ("adaptive_contact_sim", "adaptive_contact.robot")
LEARNER: Final = (
    *("adaptive_contact.arrays", "adaptive_contact.compiled", "adaptive_contact.notes"),
    *("adaptive_contact.core", "adaptive_contact.checks", "adaptive_contact.fit"),
    *("adaptive_contact.model", "adaptive_contact.robot", "adaptive_contact.score"),
    "adaptive_contact_models",
)


def rests_on(*sources: str) -> Callable[[F], F]:
    """Name the modules and packages that decide what a function returns, besides its own module."""

    def marked(do: F) -> F:
        do.sources = (do.__module__, *sources)  # type: ignore[attr-defined]
        return do

    return marked


@functools.cache
def digest(*sources: str) -> str:
    """Hash of the code and data of modules and packages; comments and docstrings do not count."""
    found = hashlib.sha256("".join(map(version, ("numpy", "scipy", "mujoco", "pysindy"))).encode())
    for name in sources:
        origin = Path(str(getattr(find_spec(name), "origin", None)))
        files = origin.parent.rglob("*") if origin.name == "__init__.py" else [origin]
        decisive = (f for f in files if f.suffix in (".py", ".json", ".toml"))
        for file in sorted(f for f in decisive if "virtual" not in f.parts):  # moves no robot here
            found.update(_code(file) if file.suffix == ".py" else file.read_bytes())
    return found.hexdigest()[:16]


def _code(file: Path) -> bytes:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            del node.body[0]
    return ast.dump(tree).encode()


@dataclass(frozen=True)
class Work:
    """How work is done, and where its results are kept."""

    folder: Path | None = None  # results lie in its folder ``cache``; None keeps none
    processes: int = 1
    shown: bool = False  # whether its progress is printed, on stderr

    def __post_init__(self) -> None:
        if self.folder is not None:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:  # said before the work, not after
                raise ConfigurationError(
                    f"{self.folder}: cannot be made ({error.strerror}); give another --out"
                ) from error

    def one(self, do: Callable[[Work, T], R], item: T) -> R:
        """Return what a function of :func:`rests_on` makes of an item; made now unless it is kept.

        Its items have texts that say all of them (``repr``).
        """
        folder = None if self.folder is None else self.folder.resolve() / "cache"
        kept: Callable[..., R] = joblib.Memory(folder, verbose=0).cache(
            _do, ignore=["work", "do", "item"]
        )
        return kept(self, do, item, _key(do, item))

    def each(self, what: str, do: Callable[[Work, T], R], items: Sequence[T]) -> list[R]:
        """Do :meth:`one` of all items, several at a time; results in the order of the items.

        Args:
            what: is done, for people.
            do: a function of a module.
            items: what to do it on.

        Raises:
            ConfigurationError: a process ended, or the sources changed meanwhile.
        """
        if self.shown:
            print(f"{what}: {len(items)}", file=sys.stderr)
        jobs = [joblib.delayed(_checked)(Work(self.folder), do, i, _key(do, i)) for i in items]
        try:
            # Those of a process that was killed end what they are at, and then go.  One that has
            # gone as there was nothing to do is started again, which needs no word.
            with (
                warnings.catch_warnings(action="ignore", category=UserWarning),
                joblib.parallel_config("loky", idle_worker_timeout=20),
            ):
                workers = joblib.Parallel(
                    max(1, min(self.processes, len(items))),
                    verbose=10 if self.shown else 0,
                    batch_size=1,
                    pre_dispatch="all",  # so that it knows how much is left
                )
                return list(workers(jobs))
        except TerminatedWorkerError as error:
            raise ConfigurationError(
                "a process ended that was at work (out of memory?); run the same command again to "
                "go on, with fewer processes"
            ) from error
        except KeyboardInterrupt:
            if self.shown:
                print("interrupted; the same command goes on from here", file=sys.stderr)
            raise


def _key(do: Callable[..., Any], item: object) -> str:
    sources = getattr(do, "sources", (do.__module__,))
    text = f"{do.__module__}.{do.__qualname__} {digest(*sources)} {item!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _do(work: Work, do: Callable[[Work, T], R], item: T, key: str) -> R:
    with threadpool_limits(1):  # matrices as small as a leg's gain nothing from threads
        return do(work, item)


def _checked(work: Work, do: Callable[[Work, T], R], item: T, key: str) -> R:
    """In a worker: one item of many.

    Raises:
        ConfigurationError: the source here is not that of the process that asks.
    """
    if _key(do, item) != key:
        raise ConfigurationError(
            "the source of adaptive-contact was changed while the run was going on; start the same "
            "command again"
        )
    return work.one(do, item)
