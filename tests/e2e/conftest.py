"""The real command line in processes of its own, run from an installed wheel in an empty folder.

Without hatchling (extra ``dev``) no wheel can be built; then the source tree is what runs, and the
tests of the wheel itself are skipped.
"""

from __future__ import annotations

import dataclasses
import fcntl
import os
import re
import shlex
import socket
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from programs import Program

ROOT = Path(__file__).parents[2]

# Of a test that is the first to need a wheel's environment: building it compiles the tick.
BUILD_S = 900


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "built" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.timeout(BUILD_S))


# What the extras bring; an environment without them has the core dependencies only.
EXTRAS = (
    *("mujoco", "mujoco_core", "mujoco_studio", "glfw", "OpenGL"),
    *("dynamixel_sdk", "dynamixel_easy_sdk", "scservo_sdk", "serial"),
    *("matplotlib", "mpl_toolkits", "pylab", "PIL"),
    *("jinja2", "markupsafe"),
)


@dataclasses.dataclass(frozen=True)
class Environment:
    """Where commands run: an interpreter, its variables, and where the wheel lies."""

    python: str
    env: dict[str, str]
    site: Path

    def run(
        self, *args: str | Path, cwd: Path, timeout_s: float = 120.0, answers: str = ""
    ) -> subprocess.CompletedProcess[str]:
        """Run the interpreter to its end."""
        return subprocess.run(
            [self.python, *map(str, args)],
            input=answers,
            cwd=cwd,
            env=self.env,
            capture_output=True,
            text=True,
            encoding="utf-8",
            timeout=timeout_s,
            check=False,
        )


def _bare_variables() -> dict[str, str]:
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    kept = {k: v for k, v in os.environ.items() if k not in hidden}
    # Several processes share two cores: BLAS threads that spin would only be in the way.
    return kept | {"COLUMNS": "200", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def _linked(folder: Path, without: tuple[str, ...] = ()) -> str:
    """A folder with links to this environment's packages, but not to its own.

    Their ``.pth`` files are left out: through those an editable install of this project would come
    along.
    """
    folder.mkdir()
    ours = ("adaptive_contact", "__editable__", "_editable")
    for entry in Path(sysconfig.get_paths()["purelib"]).iterdir():
        name = entry.name
        if name.endswith(".pth") or name.startswith(ours):
            continue
        if re.split(r"[.-]", name)[0] not in without:
            (folder / name).symlink_to(entry)
    return str(folder)


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel of this source tree, and an environment that holds it.

    Made and compiled once: the first process of several makes it, and the others wait.
    """
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "built"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as one:
        fcntl.flock(one, fcntl.LOCK_EX)
        if not (folder / "whole").exists():
            _build(folder)
            (folder / "whole").touch()
    return folder


def _build(folder: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT]
    done = subprocess.run(build, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    venv = [sys.executable, "-m", "venv", "--without-pip", folder / "venv"]
    subprocess.run(venv, check=True, timeout=600)
    made = _environment(folder, _linked(folder / "full"))
    pip = [sys.executable, "-m", "pip", "--python", made.python, "--disable-pip-version-check"]
    install = [*pip, "install", "--quiet", "--no-deps", "--no-index", *folder.glob("*.whl")]
    subprocess.run(install, check=True, timeout=600, env=_bare_variables())
    # Before a command's time is limited.
    ahead = "from adaptive_contact.core.bank import compile_ahead; compile_ahead()"
    assert made.run("-c", ahead, cwd=folder, timeout_s=BUILD_S).returncode == 0


def _environment(folder: Path, packages: str) -> Environment:
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    # What it compiles is of no use to any other installation, so none of it stays.
    own = {"ADAPTIVE_CONTACT_CACHE": str(folder / "cache"), "PYTHONPATH": packages}
    return Environment(str(folder / "venv" / "bin" / "python"), _bare_variables() | own, site)


@pytest.fixture(scope="session")
def installed(built: Path) -> Environment:
    """The wheel with all extras."""
    return _environment(built, str(built / "full"))


@pytest.fixture(scope="session")
def bare(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel with its core dependencies only."""
    return _environment(built, _linked(tmp_path_factory.mktemp("bare") / "packages", EXTRAS))


@pytest.fixture(scope="session")
def without_plot(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel with every extra but ``plot``."""
    plot = ("matplotlib", "mpl_toolkits", "pylab", "PIL")
    return _environment(built, _linked(tmp_path_factory.mktemp("plain") / "packages", plot))


@pytest.fixture
def command(installed: Environment, tmp_path: Path) -> Callable[..., str]:
    """Run a command of ours that succeeds, in the test's folder; its standard output."""

    def run(*args: str | Path, code: int = 0) -> str:
        done = installed.run("-m", "adaptive_contact", *args, cwd=tmp_path)
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout

    return run


@pytest.fixture
def start(
    installed: Environment, program: Callable[..., Program], tmp_path: Path
) -> Callable[..., Program]:
    """Start a command of ours, or with ``script`` one of Python, in the test's folder."""

    def begin(*args: Any, script: bool = False) -> Program:
        words = args if script else ("-m", "adaptive_contact", *args)
        return program(*words, python=installed.python, cwd=tmp_path, env=installed.env)

    return begin


# A fit takes 80 s of a walk, and the tutorial learns for 100 s.
LONGEST_S = 100


class Shell:
    """Runs command lines as a person's shells would: one terminal more for what runs on.

    The router is on a free port, the user's folders are the test's, and what takes minutes is
    shortened.
    """

    RUNS_ON = re.compile(
        r"adaptive-contact (serve|bridge |watch(?!.*--once)|record(?!.*--seconds)|demo.* --web"
        r"|sim (walk|pose)(?!.*(--offline|--seconds)))|python source"
    )
    CONNECTS = re.compile(
        r"adaptive-contact (doctor|watch|record|sim inject|sim (walk|pose)(?!.*--offline)"
        r"|bridge (?!virtual)|robot .*--live)|python (examples|source)"
    )
    READY = r"stop with Ctrl-C|live page at|  up [0-9]|joined"

    def __init__(self, environment: Environment, folder: Path) -> None:
        own = {"HOME": str(folder), "XDG_STATE_HOME": str(folder / "state"), "BROWSER": "true"}
        self.environment = dataclasses.replace(environment, env=environment.env | own)
        self.folder = folder
        self.jobs: list[tuple[str, Program]] = []
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]

    def run(self, line: str, codes: Sequence[int] = (0,), answers: str = "y\n") -> str:
        """What a line says; it ends with one of some exit codes, or runs on."""
        line = re.sub(r"(^|\s+)#.*", "", line)
        variables = dict(re.findall(r"^([A-Z_]+)=(\S+) ", line))
        environment = dataclasses.replace(self.environment, env=self.environment.env | variables)
        line = re.sub(r"^[A-Z_]+=\S+ ", "", line)
        if " && " in line:
            return "".join(self.run(part, codes) for part in line.split(" && "))
        if line.startswith("kill %"):
            self.stop(self.jobs[int(line.removeprefix("kill %")) - 1])
            return ""
        said, words = self._words(line)
        if self.RUNS_ON.match(line) and codes == (0,):
            kind = said.split()[: 3 if "bridge" in line else 2]
            joins = re.search("serve .*--connect", line)
            for job in self.jobs:  # a port, a device and a leg have room for one
                # A service that joins a router needs the one before.
                if job[0].split()[: len(kind)] == kind and not joins:
                    self.stop(job)
            running = Program(
                *words, python=environment.python, cwd=self.folder, env=environment.env
            )
            self.jobs.append((said, running))
            running.wait_line(self.READY, 300.0)
            return "\n".join(running.lines)
        done = environment.run(*words, cwd=self.folder, timeout_s=BUILD_S, answers=answers)
        assert done.returncode in codes, f"{line}: {done.stdout}{done.stderr}"
        assert "Traceback" not in done.stderr, f"{line}: {done.stderr}"
        return done.stdout + done.stderr

    def _words(self, line: str) -> tuple[str, list[str]]:
        """A line as it is here, and what to give to Python."""
        line = line.rstrip("& ")
        if self.CONNECTS.match(line) and "--connect" not in line:
            line += " --connect tcp/127.0.0.1:7447"
        if line.startswith("adaptive-contact serve") and not re.search("--(listen|connect)", line):
            line += " --listen tcp/127.0.0.1:7447"
        if line.startswith("adaptive-contact bridge ros2"):
            line += " --ros-connect tcp/127.0.0.1:7447"
        for found, own in {
            "7447": str(self.port), "192.168.1.7": "127.0.0.1", "host 0.0.0.0": "host 127.0.0.1",
            "--port 8080": "--port 0",
            "bridge foxglove": "bridge foxglove --port 0",
            " examples/": f" {ROOT}/examples/",
        }.items():  # fmt: skip
            line = line.replace(found, own)
        line = re.sub(r"(--seconds) (\d+)", lambda m: f"{m[1]} {min(int(m[2]), LONGEST_S)}", line)
        words = shlex.split(line, comments=True)
        started = ["-m", "adaptive_contact"] if words[0] == "adaptive-contact" else []
        return line, [*started, *words[1:]]

    def stop(self, job: tuple[str, Program]) -> None:
        """End one that runs on, as Ctrl-C does."""
        line, running = job
        if running.process.poll() is None:
            code = running.stop()
            assert code in (0, 130), f"{line}: {code} {running.lines}"
        assert not any("Traceback" in said for said in running.lines), f"{line}: {running.lines}"

    def close(self) -> None:
        """End all, the newest first."""
        for job in reversed(self.jobs):
            self.stop(job)
            job[1].close()
        self.jobs.clear()


@pytest.fixture
def shell(installed: Environment, tmp_path: Path) -> Iterator[Callable[..., Shell]]:
    """Make a shell in a new folder."""
    made: list[Shell] = []

    def make() -> Shell:
        folder = tmp_path / str(len(made))
        folder.mkdir()
        made.append(Shell(installed, folder))
        return made[-1]

    yield make
    for one in made:  # those of a test that failed; a demo ends its children by itself
        for _, job in one.jobs:
            job.close()
