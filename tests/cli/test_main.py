"""What the command line does when it is not understood or interrupted."""

from __future__ import annotations

import os
import queue
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact import compiled
from adaptive_contact.cli import _compiling
from adaptive_contact.compiled import CACHE_VARIABLE, compiles
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire.received import Received
from waiting import free_address

SOURCES = os.pathsep.join(path for path in sys.path if path)
WIDE = {**os.environ, "PYTHONPATH": SOURCES, "COLUMNS": "200", "TERM": "xterm"}


def ran(*words: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *words]
    given = {"capture_output": True, **options}
    return subprocess.run(command, text=True, env=WIDE, timeout=600, check=False, **given)  # type: ignore[call-overload,no-any-return]


def test_no_command_is_the_help(ours: Callable[..., Any]) -> None:
    for words in ([], ["sim"]):
        done = ours(*words)
        assert "Usage:" in done.out + done.err
        assert "Traceback" not in done.err


@pytest.mark.parametrize("where", ["load_commands", "app"])
def test_an_interrupt_says_nothing(where: str) -> None:
    """While commands are loaded, and in one that does not deal with it itself."""
    code = (
        "import adaptive_contact.cli.main as cli\n"
        "def interrupted(*_, **__): raise KeyboardInterrupt\n"
        "cli.load_commands = lambda asked: None\n"
        f"cli.{where} = interrupted\n"
        "cli.main()"
    )
    done = ran("-c", code)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_stop_leaves_no_part_of_a_file(
    program: Any, tmp_path: Path, number: signal.Signals
) -> None:
    code = (
        "import pathlib, signal, sys\n"
        "import adaptive_contact.cli.main as cli\n"
        "from adaptive_contact.files import whole_file\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # the tests may run under nohup
        "def writes(**_):\n"
        "    with whole_file(pathlib.Path(sys.argv[1])) as file:\n"
        "        file.write(b'half')\n"
        "        print('writing', flush=True)\n"
        "        while True: signal.pause()\n"
        "cli.load_commands = lambda asked: None\n"
        "cli.app = writes\n"
        "cli.main()"
    )
    child = program("-c", code, tmp_path / "out.csv")
    child.wait_line("writing")
    assert child.stop(number) == 128 + number
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_while_the_tick_is_compiled_is_clean(
    program: Any, tmp_path: Path, number: signal.Signals
) -> None:
    """To all processes of a terminal or a unit, as Ctrl-C and systemd do it; it is seen before."""
    if not compiles():
        pytest.skip("nothing is compiled here")
    cache, address = tmp_path / "cache", f"tcp/{free_address()}"
    words = ("serve", "--no-state", "--listen", address)
    where = {"env": {**WIDE, CACHE_VARIABLE: str(cache)}, "start_new_session": True}
    serve = program("-m", "adaptive_contact", *words, **where)
    serve.wait_line("compiling the arithmetic")
    statuses: queue.SimpleQueue[Received] = queue.SimpleQueue()
    with Link.open(client_settings([address])) as link:
        link.subscribe(SERVICE_STATUS, statuses.put)
        assert b"compiling the arithmetic" in statuses.get(timeout=60.0).payload
    os.killpg(serve.process.pid, number)
    assert serve.wait(600) == 0
    assert len(serve.lines) == 1
    assert not list(cache.glob("compiled-*/whole"))


def test_a_first_start_says_how_long_it_compiles_and_how_long_it_took(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if not compiles():
        pytest.skip("nothing is compiled here")
    work = "import time\nwhile time.process_time() < 2.0: pass\n"
    mark = "from adaptive_contact.compiled import mark_cache_complete; mark_cache_complete()"
    monkeypatch.setattr(_compiling, "_CODE", work + mark)
    monkeypatch.setattr("adaptive_contact.core.bank.compile_ahead", lambda: None)
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path))
    compiled.cache_folder.cache_clear()
    try:
        _compiling.compile_tick()
        first, second = capsys.readouterr().err.splitlines()
        assert "for this computer, once: half a minute" in first
        assert re.fullmatch(r"adaptive-contact: compiled after \d+ s", second)
        _compiling.compile_tick()
        assert capsys.readouterr().err == "", "once"
    finally:
        compiled.cache_folder.cache_clear()


@pytest.mark.parametrize(("asked", "others"), [("score", 0), ("state", 0), ("nosuch", 10)])
def test_a_command_loads_itself_alone(asked: str, others: int) -> None:
    """All of them where it is none, so that the likeliest can be named."""
    code = (
        "import sys\n"
        "from adaptive_contact.cli.main import main\n"
        f"sys.argv = ['adaptive-contact', {asked!r}, '--help']\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "here = 'adaptive_contact.cli.'\n"
        f"skip = {{here + name for name in ('main', {asked!r})}}\n"
        "print(sum(n.startswith(here) and '._' not in n for n in {*sys.modules} - skip))"
    )
    done = ran("-c", code)
    found = int(done.stdout.splitlines()[-1])
    assert found == 0 if others == 0 else found >= others


CLEANING = """
import os, signal, sys, time
from adaptive_contact.cli import _signals
_signals.interrupt_once()
try:
    try:
        os.kill(os.getpid(), signal.SIGINT)
    finally:
        time.sleep(float(sys.argv[1]))
        os.kill(os.getpid(), signal.SIGINT)
        print("cleaned up")
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize(
    ("before", "later_s", "said"),
    [
        ("", "0", "cleaned up\ninterrupted\n"),
        ("", "2.1", "interrupted\n"),
        ("signal.signal(2, signal.SIG_IGN); ", "0", "cleaned up\n"),  # ignored, it stays so
    ],
)
def test_a_second_ctrl_c_waits_until_the_first_has_cleaned_up(
    before: str, later_s: str, said: str
) -> None:
    code = CLEANING.replace("_signals.interrupt", f"{before}_signals.interrupt")
    assert ran("-c", code, later_s).stdout == said
