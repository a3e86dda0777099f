"""For all tests."""

from __future__ import annotations

import contextlib
import fcntl
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import structlog
from hypothesis import HealthCheck, is_hypothesis_test, settings

from adaptive_contact import compiled
from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.service.refit_process import ONE_BLAS_THREAD

sys.path.insert(0, str(Path(__file__).parent))  # recordings that several of them use

# Of this process and of those that tests start; BLAS reads it when it is loaded.  A leg's matrices
# gain nothing from threads, and threads that wait for each other spin: on a core that another
# process has, a QR factorisation of 600 rows takes 0.4 s instead of 1 ms.
os.environ.update(ONE_BLAS_THREAD)

# Machines are shared: how long an example takes to draw or to run there says nothing of the code.
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")

AHEAD = "from adaptive_contact.core.bank import compile_ahead; compile_ahead()"


def pytest_collection_finish(session: pytest.Session) -> None:
    """Compile the tick before the first test: it takes a core's minute, and no test's time.

    Of several processes one compiles, and the others wait.
    """
    folder = compiled.cache_folder()
    processes = any(item.get_closest_marker("e2e") for item in session.items)
    if not (processes or "adaptive_contact.core.bank" in sys.modules) or folder is None:
        return
    with (folder / "ahead").open("w") as one:
        fcntl.flock(one, fcntl.LOCK_EX)
        if compiled.compiles() and not compiled.is_cached():
            subprocess.run([sys.executable, "-c", AHEAD], check=True)


@pytest.fixture(autouse=True)
def logs_as_before() -> Iterator[None]:
    """A command that a test runs within this process sets up its log, also that of later tests."""
    before = structlog.get_config()
    yield
    structlog.configure(**before)


MET: list[AdaptiveContactError] = []


def _met(self: AdaptiveContactError, *words: object) -> None:
    Exception.__init__(self, *words)
    MET.append(self)


AdaptiveContactError.__init__ = _met  # type: ignore[method-assign]


@pytest.fixture(autouse=True)
def errors_are_a_line(request: pytest.FixtureRequest) -> Iterator[None]:
    """Every message of an error that a test meets is one line; of a bus each of its lines is.

    Texts that are drawn may hold line feeds, which are escaped as they are shown.
    """
    MET.clear()
    yield
    drawn = is_hypothesis_test(request.function)
    assert drawn or [line for error in MET for line in error.lines if "\n" in line] == []


class Said(NamedTuple):
    """How a command ended, and what it said."""

    code: int
    out: str
    err: str


@pytest.fixture
def ours(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Said]:
    """Run a command of ours in this process, to its exit code."""
    from adaptive_contact.cli import main

    main.load_commands()

    def run(*words: object) -> Said:
        monkeypatch.setattr("sys.argv", ["adaptive-contact", *map(str, words)])
        code = main.run()
        return Said(code, *capsys.readouterr())

    return run


@pytest.fixture
def program() -> Iterator[Callable[..., Any]]:
    """Start a :class:`programs.Program`, which ends with the test, the newest first."""
    from programs import Program

    with contextlib.ExitStack() as running:

        def start(*words: object, **where: Any) -> Program:
            return running.enter_context(contextlib.closing(Program(*words, **where)))

        yield start


@pytest.fixture
def cli(program: Callable[..., Any]) -> Callable[..., Any]:
    """Starts one of our commands alone, so that this test does not need all the others."""

    def start(name: str, *words: object, **where: Any) -> Any:
        code = f"import typer; from adaptive_contact.cli.{name} import {name}; typer.run({name})"
        return program("-c", code, *words, **where)

    return start


@pytest.fixture
def router() -> Iterator[Any]:
    """A link that others join, at a free port of loopback."""
    from adaptive_contact.service.link import Link, router_settings

    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        yield link
