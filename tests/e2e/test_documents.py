"""The documents' code blocks, run as they stand.

Python that talks to a service is run by test_walk.py and tests/service/test_docs.py, the loop
without one by tests/test_docs.py.
"""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh

from adaptive_contact.robot import parse_robot
from urdfs import quadruped

pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.timeout(3600)]

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MODELS = ROOT / "models" / "adaptive_contact_models"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMAND = re.compile(
    r"(\$ |[A-Z_]+=\S+ |\.venv/bin/)*"
    r"(adaptive-contact (?!([a-z]+ ?)*:)|python3? |pip |make |sudo |journalctl |ros2 |kill )"
)
# Lines that are not run here, and why.
ELSEWHERE = {
    r"make (demo|test)|adaptive-contact demo --robot": "the tests, and tests/e2e/test_demo.py",
    r"pip |python3 -m venv": "needs a package index",
    r"sudo |journalctl ": "changes the computer",
    r"ros2 |.* (free|walk) --config": "needs ROS 2; bags are those of tests/ros2",
    r"adaptive-contact sim baseline": "takes hours",
}
# What a page takes for granted, before a line that begins so.
GIVEN = {
    "README.md": {
        "adaptive-contact robot init": ["adaptive-contact bridge virtual --dir bus --realtime &"],
        "adaptive-contact serve --config robot.toml &": ["fresh", "hexapod"],
        "adaptive-contact record": ["adaptive-contact sim walk"],
    },
    "operating.md": {
        "adaptive-contact serve --config robot.toml": ["hexapod", "baseline legs.json"],
        "adaptive-contact watch --web": ["adaptive-contact serve", "adaptive-contact sim walk"],
        "adaptive-contact state reset": ["kill"],
    },
    "recordings.md": {"adaptive-contact bridge foxglove": ["adaptive-contact serve"]},
    "robot.md": {
        "adaptive-contact robot init": ["urdf solo12.urdf _FOOT"],
        "adaptive-contact robot check": [
            "fresh", "hexapod", "adaptive-contact serve", "adaptive-contact sim walk",
        ],
    },
    "ros2.md": {"adaptive-contact serve": ["adaptive-contact serve", "ros2"]},
    "security.md": {"adaptive-contact watch": [
            "users", "adaptive-contact serve --zenoh-config service.json5",
        ]},
    "simulator.md": {
        "adaptive-contact sim walk  ": ["adaptive-contact serve"],
        "adaptive-contact sim walk --scenario": ["kill"],
        "adaptive-contact sim walk --robot quadruped12 --gait": ["adaptive-contact serve"],
        "adaptive-contact sim inject": ["adaptive-contact sim walk"],
    },
    "tutorial.md": {
        "adaptive-contact robot init --urdf": ["fresh", "urdf my.urdf _foot"],
        "adaptive-contact robot check --live": ["python source.py"],
        "adaptive-contact state reset": [
            "fresh", "hexapod", "adaptive-contact serve --config robot.toml",
            "adaptive-contact sim walk --seconds 10", "kill",
        ],
    },
}  # fmt: skip
# Lines that do not end with 0: what is refused on the page, and what finds legs that hang limp.
CODES = {
    "--listen tcp/0.0.0.0": (2,), "adaptive-contact doctor": (0, 1), "-m pdb": (0, 1),
    "robot learn": (0, 2),
}  # fmt: skip
# A source of legs that swing in free air, at the robot's rate, until it is stopped.  Their servos
# rub, as all do: they rest two steps off their goals.  Without it readings are a function of goals.
SOURCE = """
import signal, sys, time
import numpy as np
from adaptive_contact.bridge.training import free_swings
from adaptive_contact.robot import load_robot
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import ServoSample, servo_key
signal.signal(signal.SIGINT, lambda *_: sys.exit())
robot, rng, home = load_robot("robot.toml"), np.random.default_rng(8), np.array([0.0, 0.6, -1.2])
step = robot.quantum_rad
with Link.open(client_settings([sys.argv[2]])) as link:
    legs = [
        [link.publisher(servo_key(leg.id)), home,
         free_swings(leg, home, rng, amplitude_rad=0.5, max_step_rad=0.15)]
        for leg in robot.legs
    ]
    print("joined", flush=True)
    due_s = time.monotonic()
    for seq in range(10**9):
        for leg in legs:
            goal = np.rint(np.array(next(leg[2])) / step) * step
            measured = np.rint((leg[1] + rng.normal(0, 0.3 * step, 3)) / step) * step
            lag = goal - leg[1]
            pull = np.sign(lag) * np.maximum(np.abs(lag) - 2.0 * step, 0.0)
            leg[1] = leg[1] + 0.09 * np.clip(pull / 0.164, -1.0, 1.0)
            leg[0].put(ServoSample(t_ns=round(seq * robot.period_s * 1e9), seq=seq, run=3,
                                   measured=measured.tolist(), desired=goal.tolist()))
        due_s += robot.period_s
        time.sleep(max(due_s - time.monotonic(), 0.0))
"""


class Block(NamedTuple):
    """A fence: its language and its text, and the commands in it."""

    language: str
    body: str

    @property
    def commands(self) -> list[str]:
        lines = self.body.replace("\\\n", " ").splitlines()
        if any(line.startswith("$ ") for line in lines):  # the others are what was said
            return [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
        return [line for line in lines if COMMAND.match(line)]


def blocks(page: Path) -> list[Block]:
    return [Block(*found) for found in FENCE.findall(page.read_text(encoding="utf-8"))]


def prepare(shell: Any, what: str, page: Path) -> None:
    """Put there what a page takes for granted."""
    kind, *words = what.split()
    if kind == "hexapod":
        shutil.copy(MODELS / "hexapod" / "robot.toml", shell.folder / "robot.toml")
    elif kind == "baseline":
        shutil.copy(MODELS / "hexapod" / "baseline.json", shell.folder / words[0])
    elif kind == "urdf":
        (shell.folder / words[0]).write_text(quadruped(words[1]))
        (shell.folder / "source.py").write_text(SOURCE)
    elif kind == "ros2":
        (of_page,) = (block.body for block in blocks(page) if block.language == "toml")
        (shell.folder / "robot.toml").write_text(ROBOT + of_page)
    elif kind == "users":
        bodies = [block.body for block in blocks(page)]
        (service,) = (body for body in bodies if "dictionary_file" in body)
        (viewer,) = (body for body in bodies if 'user: "robot", password' in body)
        (users,) = (block.body for block in blocks(page) if block.language == "text")
        own = service.replace("/etc/adaptive-contact/users", str(shell.folder / "users"))
        for name, text in {"service.json5": own, "viewer.json5": viewer, "users": users}.items():
            (shell.folder / name).write_text(text)
            (shell.folder / name).chmod(0o600)
    elif kind == "kill":
        shell.close()
    else:
        shell.run(what)


ROBOT = '[robot]\nname = "x"\nperiod_s = 0.02\nquantum_rad = 0.00511\n'


def pieces(page: Path) -> Iterator[str]:
    """A page's commands; what follows one in a debugger is its input."""
    for block in blocks(page):
        for command in block.commands:
            if not any(re.match(rf"(\.venv/bin/)?({line})", command) for line in ELSEWHERE):
                typed = "".join(re.findall(r"^\(Pdb\) (.*\n)", block.body, re.MULTILINE))
                yield f"{command}\n{typed}" if "-m pdb" in command else command


@pytest.mark.parametrize("page", [page for page in PAGES if [*pieces(page)]], ids=lambda p: p.stem)
def test_every_command_of_a_page_works(shell: Callable[..., Any], page: Path) -> None:
    one = shell()
    given = dict(GIVEN.get(page.name, {}))
    said = {}
    for piece in pieces(page):
        command, _, typed = piece.partition("\n")
        command = command.removeprefix(".venv/bin/").replace("/dev/ttyUSB0", "bus/port0")
        for begin in [begin for begin in given if command.startswith(begin)]:
            for what in given.pop(begin):
                if what == "fresh":
                    one.close()
                    one = shell()
                else:
                    prepare(one, what, page)
        codes = next((codes for part, codes in CODES.items() if part in command), (0,))
        said[command] = one.run(command, codes, typed or "y\n")
        for _ in range(3):  # a busy computer reads too little: what was said is done
            if again := re.search(r"run this again with ((--more \S+ ?)+)", said[command]):
                said[command] = one.run(f"{command} {again[1]}", codes)
    one.close()
    assert all("baseline written" in text for line, text in said.items() if "learn" in line)
    assert not given, "the page has no such line any more"
    if page.stem == "tutorial":
        learned = next(text for line, text in said.items() if "robot learn --config" in line)
        assert learned.count(": good") + learned.count(": usable") == 6
        steps = next(text for line, text in said.items() if "gait_controller" in line)
        assert "stopped on contact" in steps
        assert "error:" not in said["adaptive-contact doctor --seconds 3"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_other_block_of_a_page_can_be_read(page: Path) -> None:
    for language, body in blocks(page):
        if language == "toml" and "[[leg]]" in body:
            parse_robot(ROBOT + body, source=page.name)
        elif language == "toml":
            tomllib.loads(body)
        elif language == "json5":
            zenoh.Config.from_json5(body)
        elif language == "python" and body.startswith("from adaptive_contact_sim"):
            exec(body, {})
        else:
            assert language in ("", "bash", "sh", "console", "text", "json", "python"), language
