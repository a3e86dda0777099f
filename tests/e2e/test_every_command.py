"""Every command of the help tree: once with small real input, once with a wrong one; and `make`."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.cli import main
from programs import commands

ROOT = Path(__file__).parents[2]

# In one folder, in order; `adaptive-contact` comes before each.  Of sim baseline, which takes
# hours, there is no small form.
WORKS = """
sim list
scenarios list
sim walk --offline --seconds 90 --record walk.mcap
sim pose --offline --seconds 5 --record pose.mcap
replay walk.mcap --events events.jsonl --plot walk.html
score walk.mcap --events events.jsonl
export walk.mcap --to csv
fit walk.mcap -o legs.json
sim compare --seconds 10 --out compare --picture compare.png
paper --quick --stage dataset --out paper
bench --quick --out bench
scenarios run step-friction4 --quick --seeds 1 --out scenarios
scenarios report --out scenarios --docs pages
demo --seconds 10 --out demo
serve &
bridge virtual --dir bus --ports 1 --realtime &
robot init --device bus/port0 --legs lf,lm,lr,rf,rm,rr --lengths 0.052,0.066,0.138
robot check --config robot.toml
robot learn --config robot.toml --drive --yes --pose 0,0.6,-1.8 --seconds 60
bridge dynamixel --config robot.toml &
bridge virtual --dir sts --servos STS3215 --write-config sts.toml &
bridge feetech --config sts.toml --namespace sts &
watch --once
record live.mcap --seconds 2
doctor --seconds 1
bridge ros2 --config ros2.toml &
bridge foxglove --port 0 &
sim walk &
sim inject friction --value 2
kill
state show
state reset
"""
# What is wrong, and what the one line says; it ends with code 2, and no file is left.
REFUSED = {
    "nosuch": "No such command 'nosuch'; see `adaptive-contact --help`",
    "sim nosuch": "No such command 'nosuch'",
    "bench --baseline nosuch.json": "nosuch.json: cannot be read",
    "bench --out /dev/null/x": "give another --out",
    "bridge dynamixel": "has no port; add [port.main]",
    "bridge feetech": "has no port; add [port.main]",
    "bridge foxglove --port 70000": "Invalid value for '--port'",
    "bridge ros2": "names no topics of ROS 2",
    "bridge virtual --dir /dev/null/x": "give another --dir",
    "demo --robot nosuch": "no robot 'nosuch' is simulated",
    "demo --robot leg5": "does not walk; expected hexapod or quadruped12",
    "demo --seconds nan": "'nan' is no duration; expected seconds",
    "demo --seconds 1": "expected 8 to 3600 s",
    "doctor --seconds 0.1": "Invalid value for '--seconds'",
    "doctor --seconds 1h": "'1h' is 3600 s; expected 0.5 to 600 s",
    "doctor --seconds soon": "'soon' is no duration; expected seconds, or a duration",
    "export nosuch.mcap --to csv": "nosuch.mcap: cannot be read",
    "fit": "Missing argument 'RECORDING...'; see `adaptive-contact fit --help`",
    "fit nosuch.mcap": "nosuch.mcap: cannot be read",
    "fit x.mcap -o /": "/: cannot be written (it is a folder)",
    "paper --out /dev/null/x": "give another --out",
    "record nosuch/x.mcap": "there is no folder",
    "record x.mcap --key a//b --seconds 1": "key expression 'a//b' cannot be used",
    "record x.mcap --seconds -1m": "'-1m' is -60 s; expected 0 s or more",
    "replay nosuch.mcap": "nosuch.mcap: cannot be read",
    "robot check": "has no port",
    "robot init --urdf nosuch.urdf": "nosuch.urdf: cannot be read",
    "robot learn --config nosuch.toml": "nosuch.toml: cannot be read",
    "robot learn --seconds 0": "expected 1 to 3600 s",
    "scenarios list extra": "unexpected extra argument",
    "scenarios report --out nosuch": "no results there",
    "scenarios run --all --out /dev/null/x": "give another --out",
    "scenarios run nosuch": "no scenario 'nosuch'",
    "score nosuch.mcap": "nosuch.mcap: cannot be read",
    "score x.mcap --from 2x": "'2x' is no duration",
    "serve --config nosuch.toml": "nosuch.toml: cannot be read",
    "serve --listen tcp/0.0.0.0:0": "or say --insecure",
    "sim baseline --out nosuch/b.json": "give another --out",
    "sim compare --drift friction:value=4@1s": "a drift begins at 1 s of walks of 120 s; expected",
    "sim compare --gait nosuch": "no gait 'nosuch'",
    "sim inject friction": "has no value; give a number",
    "sim inject mass --shape ramp": "above 0 s; give --duration S",
    "sim inject nosuch --value 4": "no drift 'nosuch'; expected mass,",
    "sim list extra": "unexpected extra argument",
    "sim pose --leg zz --offline --seconds 1": "legs to move are ['zz']",
    "sim walk --gait nosuch --offline": "no gait 'nosuch'",
    "state reset --state nosuch": "nosuch is no folder",
    "state show --state nosuch": "nosuch is no folder",
    "watch --once --wait 1:30": "such as 90s, 10m or 1h30m",
    "watch --xyzzy": "No such option: --xyzzy; see `adaptive-contact watch --help`",
}


def test_every_command_is_tried() -> None:
    for words, found in commands():
        if hasattr(found, "commands"):
            continue
        command = " ".join(words)
        works = re.search(rf"^{command}( |$)", WORKS, re.MULTILINE)
        assert works or command == "sim baseline", command
        assert any(f"{line} ".startswith(f"{command} ") for line in REFUSED), command


@pytest.mark.parametrize("line", REFUSED)
def test_what_is_wrong_is_one_line(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("sys.argv", ["adaptive-contact", *shlex.split(line)])
    main.load_commands()
    assert main.run() == 2
    out, said = capsys.readouterr()
    assert out == ""
    assert said.startswith("adaptive-contact: "), said
    assert said.count("\n") == 1, said
    assert REFUSED[line] in said
    assert "Value error" not in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.timeout(3600)
def test_every_command_works_from_the_wheel(shell: Callable[..., Any]) -> None:
    one = shell()
    models = ROOT / "models" / "adaptive_contact_models" / "hexapod" / "robot.toml"
    ros2 = models.read_text("utf-8").replace("[[leg]]", '[ros2]\nstate = "/state"\n[[leg]]', 1)
    ros2 = re.sub(
        r'^id = "(\w+)"(?:.|\n)*?(?=^\[\[leg\]\]|\Z)',
        lambda leg: leg[0] + f'\n[leg.ros2]\njoints = ["{leg[1]}_a", "{leg[1]}_b", "{leg[1]}_c"]\n',
        ros2,
        flags=re.MULTILINE,
    )
    (one.folder / "ros2.toml").write_text(ros2)
    for line in filter(None, WORKS.splitlines()):
        if line == "kill":
            one.close()
        else:
            # doctor: the virtual robot's other legs hang limp
            one.run(f"adaptive-contact {line}", (0, 1) if line.startswith("doctor") else (0,))
    one.close()


def make(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run `make` in a folder with this environment as it is."""
    venv = Path(sys.prefix)
    return subprocess.run(
        ["make", "-o", venv / ".installed", f"VENV={venv}", *words],
        cwd=folder, capture_output=True, text=True, timeout=1800, check=False,
        env={key: value for key, value in os.environ.items() if not key.startswith("PYTEST")},
    )  # fmt: skip


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources."""
    if shutil.which("make") is None:
        pytest.skip("there is no make here")
    copy: Path = tmp_path_factory.mktemp("made") / "tree"
    left_out = shutil.ignore_patterns(".git", ".venv", "out", "dist", "__pycache__", ".*_cache")
    shutil.copytree(ROOT, copy, ignore=left_out)
    return copy


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "words",
    [
        *("help", "env", "check", "wheel", "kills KILLS=2"),
        *("golden ONLY=leg5", "clean VENV=nosuch"),
    ],
)
def test_a_short_target_of_make_works(tree: Path, words: str) -> None:
    done = make(tree, *words.split())
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.e2e
@pytest.mark.timeout(1800)
def test_what_long_targets_of_make_run_is_there(tree: Path) -> None:
    """Each Python that one starts has a help, which it shows with all that the target gives."""
    targets = re.findall(r"^([a-z-]+):", (tree / "Makefile").read_text("utf-8"), re.MULTILINE)
    assert len(targets) > 20
    python = f"{Path(sys.prefix)}/bin/python"
    for target in targets:
        told = make(tree, "-n", target)
        assert told.returncode == 0, told.stderr
        for line in told.stdout.replace("\\\n", " ").splitlines():
            words = re.match(rf"((?:\w+=\S+ )*){re.escape(python)} (.*)", line)
            if words is None or re.search(
                r"fuzz\.py|mutants|studies\.(family|second)| -m build", line
            ):
                continue  # they have no help
            variables = dict(re.findall(r"(\w+)=(\S+) ", words[1]))
            done = subprocess.run(
                [python, *shlex.split(words[2]), "--help"], cwd=tree, env=os.environ | variables,
                capture_output=True, text=True, timeout=300, check=False,
            )  # fmt: skip
            assert done.returncode == 0, f"{target}: {line}: {done.stderr}"
