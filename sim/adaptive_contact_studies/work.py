"""Does work in parallel, keeps each result, and goes on after an interruption (joblib).

A result is kept under a key of what decides it: the function, its argument, and the sources and
versions that it rests on.  So a run that stopped goes on where it was, and ends with the same
numbers; a result of other sources is never shown.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, TypeVar

import joblib
from joblib.externals.loky.process_executor import TerminatedWorkerError
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from adaptive_contact.durations import duration
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
    console: Console | None = None  # where progress goes

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
        kept: Callable[..., R] = self._kept
        return kept(self, do, item, _key(do, item))

    @property
    def _kept(self) -> Any:
        folder = None if self.folder is None else self.folder.resolve() / "cache"
        return joblib.Memory(folder, verbose=0).cache(_do, ignore=["work", "do", "item"])

    def each(
        self,
        what: str,
        do: Callable[[Work, T], R],
        items: Sequence[T],
        weight: Callable[[T], float] = lambda _: 1.0,
    ) -> list[R]:
        """Do :meth:`one` of all items, several at a time; results in the order of the items.

        Args:
            what: is done, for people.
            do: a function of a module.
            items: what to do it on.
            weight: of an item, for the progress.

        Raises:
            ConfigurationError: a process ended, or the sources changed meanwhile.
        """
        found: dict[int, R] = {}
        here, kept = replace(self, console=None), self._kept
        jobs = []
        for number, item in enumerate(items):
            key = _key(do, item)
            if kept.check_call_in_cache(here, do, item, key):
                found[number] = here.one(do, item)
            else:
                jobs.append(joblib.delayed(_numbered)(here, do, number, item, key))
        total = sum(weight(item) for number, item in enumerate(items) if number not in found)
        workers = max(1, min(self.processes, len(jobs)))
        try:
            # Those of a process that was killed end what they are at, and then go.  One that has
            # gone as there was nothing to do is started again, which needs no word.
            with (
                warnings.catch_warnings(action="ignore", category=UserWarning),
                joblib.parallel_config("loky", idle_worker_timeout=20),
                self._progress(what, total) as advance,
            ):
                made = joblib.Parallel(workers, return_as="generator_unordered", batch_size=1)
                for number, result in made(jobs):
                    found[number] = result
                    advance(weight(items[number]))
        except TerminatedWorkerError as error:
            raise ConfigurationError(
                "a process ended that was at work (out of memory?); run the same command again to "
                "go on, with fewer processes"
            ) from error
        return [found[number] for number in range(len(items))]

    @contextlib.contextmanager
    def _progress(self, what: str, total: float) -> Iterator[Callable[[float], None]]:
        """Show how far some work is: a bar on a terminal, now and then a line elsewhere."""
        console = self.console or Console(quiet=True)
        start = last = time.monotonic()
        done = 0.0
        bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        with bar:
            task = bar.add_task(what, total=total)

            def advance(amount: float) -> None:
                nonlocal done, last
                done += amount
                bar.update(task, advance=amount)
                now = time.monotonic()
                # Between two lines of progress where there is no terminal.
                if bar.disable and now - last > 20.0:
                    last, passed_s = now, now - start
                    left = duration(passed_s * (total / done - 1.0))
                    share = f"{100 * done / total:.0f} % in {duration(passed_s)}"
                    console.print(f"{what}: {share}, about {left} to go", highlight=False)

            yield advance
        console.print(f"{what}: {time.monotonic() - start:.0f} s", highlight=False)


def _key(do: Callable[..., Any], item: object) -> str:
    sources = getattr(do, "sources", (do.__module__,))
    text = f"{do.__module__}.{do.__qualname__} {digest(*sources)} {item!r}"
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _do(work: Work, do: Callable[[Work, T], R], item: T, key: str) -> R:
    with threadpool_limits(1):  # matrices as small as a leg's gain nothing from threads
        return do(work, item)


def _numbered(
    work: Work, do: Callable[[Work, T], R], number: int, item: T, key: str
) -> tuple[int, R]:
    """In a worker: one item of many.

    Raises:
        ConfigurationError: the source here is not that of the process that asks.
    """
    if _key(do, item) != key:
        raise ConfigurationError(
            "the source of adaptive-contact was changed while the run was going on; start the same "
            "command again"
        )
    return number, work.one(do, item)
