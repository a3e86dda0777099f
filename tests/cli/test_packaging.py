"""The units and rules of `packaging/`: what systemd and the commands say of them."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from adaptive_contact.cli import main

PACKAGING = Path(__file__).parents[2] / "packaging"
UNITS = sorted(PACKAGING.glob("*.service"))
PROGRAM = "/opt/adaptive-contact/bin/adaptive-contact"


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_command_of_a_unit_has_its_options(unit: Path) -> None:
    text = unit.read_text(encoding="utf-8").replace("\\\n", " ")
    (line,) = re.findall(r"^ExecStart=(.*)$", text, flags=re.MULTILINE)
    program, *words = shlex.split(line)
    assert program == PROGRAM
    main.load_commands()
    command: Any = get_command(main.app)
    while hasattr(command, "commands"):
        command = command.commands[words.pop(0)]
    options = {name for parameter in command.params for name in parameter.opts}
    assert {word for word in words if word.startswith("-")} <= options


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
def test_systemd_understands_a_unit(unit: Path, tmp_path: Path) -> None:
    for other in UNITS:
        text = other.read_text(encoding="utf-8").replace(PROGRAM, "/bin/true")
        (tmp_path / other.name).write_text(text, encoding="utf-8")
    said = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(tmp_path / unit.name)],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    ours = [line for line in said.stderr.splitlines() if "adaptive-contact" in line]
    assert ours == []


def test_the_rules_set_what_the_bridge_advises() -> None:
    rules = (PACKAGING / "60-adaptive-contact.rules").read_text(encoding="utf-8")
    lines = [line for line in rules.splitlines() if line and not line.startswith("#")]
    assert any('ATTR{latency_timer}="1"' in line for line in lines)
    for line in lines:
        for part in line.split(", "):
            assert re.fullmatch(r'[A-Z]+(\{[^}]+\})?(==|=|\+=)"[^"]*"', part), part


# What numpy 2.0 to 2.4 have brought.
_SINCE_2 = re.compile(
    r"\bnp\.(a(cos|sin|tan)h?|astype|atan2|bitwise_(count|invert|left_shift|right_shift)|bool|concat|"
    r"cumulative_(prod|sum)|isdtype|u?long|matrix_transpose|matvec|permute_dims|pow|strings|trapezoid|"
    r"unique_(all|counts|inverse|values)|unstack|vecdot|vecmat)\b"
)


def test_no_function_is_used_that_the_least_numpy_lacks() -> None:
    """`packaging/listen` asks for 1.26, what learns for 2.0."""
    root = PACKAGING.parent
    assert (PACKAGING / "listen" / "pyproject.toml").read_text().count("numpy>=1.26") == 3
    assert "numpy>=2.0" in (root / "pyproject.toml").read_text()
    paths = [*(root / "adaptive_contact").rglob("*.py"), *(root / "sim").rglob("*.py")]
    found = {path.name: _SINCE_2.search(path.read_text(encoding="utf-8")) for path in paths}
    assert len(found) > 100
    assert {name: match[0] for name, match in found.items() if match} == {}


@pytest.mark.parametrize("folder", [PACKAGING.parent, PACKAGING / "listen"])
def test_no_address_is_named_that_is_not_there(folder: Path) -> None:
    """A wheel shows `[project.urls]` to who installs it."""
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert not {"urls", "authors", "maintainers"} & set(project)
