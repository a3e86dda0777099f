"""Texts that no person writes: refused in one line, soon, and shown, never obeyed by a terminal.

Time is that of the process, so that a busy computer fails nothing.
"""

from __future__ import annotations

import io
import itertools
import json
import time
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from adaptive_contact.errors import AdaptiveContactError
from adaptive_contact.files import parse_toml
from adaptive_contact.model.model_file import load_baseline
from adaptive_contact.printable import printable, printable_json, printable_lines
from adaptive_contact.robot import load_robot
from adaptive_contact.robot.urdf import read_urdf
from adaptive_contact.service.watch import LegView, View
from adaptive_contact.service.watch_table import table

SECONDS = 4.0  # of a busy computer, whose cores are slower; some 1 s of an idle one
MANY = 100_000
ROBOT = '[robot]\nname = "m"\nperiod_s = 0.02\nquantum_rad = 0.005\n[[leg]]\nid = "l"\n'
JOINTS = 'joints = ["a"]\n'
VALUES = {
    "5,000 digits": "1" * 5000,
    "400 digits": "1" * 400,
    "65 bits": str(1 << 65),
    "nested": "[" * MANY,
    "nested and closed": "[" * 900 + "]" * 900,
    "many": "[" + "1," * MANY + "1]",
    "NUL": "\0",
    "long": '"' + "x" * MANY + '"',
}
TOML = {
    **{name: f"quantum_rad = {value}" for name, value in VALUES.items()},
    "dots": "a." * 20_000 + "b = 1",
    "quoted dots": '"a\\"" . \'a\'.' * 10_000 + "b = 1",
    "inline dots": "k = {" + "a." * 20_000 + "b = 1}",
    "lines of dots": "\n".join(f"k{i}." + "a." * 62 + "b = 1" for i in range(1900)),
    "tables of dots": "\n".join(f"[k{i}." + "a." * 62 + "b]" for i in range(1900)),
    "long key": "a" * MANY + " = 1",
    "many tables": "[[leg]]\n" * 30_000,
    "inline": "a = " + "{a = " * 5000,
    "not UTF-8": b"a = '\xff'",
    "16 bits": "a = 1".encode("utf-16"),
    "large": "#" * 10_000_000,
}


def refused(read: Callable[[Path], object], path: Path, data: str | bytes) -> str:
    """The line that a reader says, in time."""
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    began_s = time.process_time()
    with pytest.raises(AdaptiveContactError) as caught:
        read(path)
    assert time.process_time() - began_s < SECONDS
    (line,) = caught.value.lines
    assert "\n" not in line
    return line


@pytest.mark.parametrize("kind", TOML)
def test_robot_toml(tmp_path: Path, kind: str) -> None:
    text = TOML[kind]
    data = text if isinstance(text, bytes) else (ROBOT + JOINTS + text).encode()
    refused(load_robot, tmp_path / "robot.toml", data)


@pytest.mark.parametrize(
    "line",
    ["# " + "." * 300, "# " + ". " * 300, "notes = [" + "1.5, " * 300 + "2.5]"],
)
def test_dots_that_join_no_keys_are_no_matter(line: str) -> None:
    assert parse_toml(line, "robot.toml") is not None


@pytest.mark.parametrize("kind", [*TOML, "gait", "list of seeds"])
def test_scenarios(tmp_path: Path, kind: str) -> None:
    from adaptive_contact_sim.scenario import load_scenario

    more = {"gait": "[walk]\ngait = [['a']]", "list of seeds": "seed = [1]"}
    text = TOML.get(kind) or more[kind]
    data = text if isinstance(text, bytes) else f'mode = "walk"\n{text}'
    data = data.replace("quantum_rad", "seconds") if isinstance(data, str) else data
    refused(lambda path: load_scenario(str(path)), tmp_path / "a.toml", data)


@pytest.mark.parametrize(
    "text",
    [
        ROBOT + f"joints = {[f'j{i}' for i in range(20_000)]}",
        ROBOT.replace('"m"', '"' + "m" * MANY + '"') + JOINTS,
    ],
    ids=["joints", "name"],
)
def test_a_robot_has_so_many_joints_and_letters(tmp_path: Path, text: str) -> None:
    assert "expected" in refused(load_robot, tmp_path / "robot.toml", text)


@pytest.mark.parametrize(
    "text",
    [
        *(f'{{"format": 1, "robot": {value}}}' for value in VALUES.values()),
        *(f'{{"format": {value}}}' for value in VALUES.values()),
        '{"a":' * MANY,
        '{"' + "a" * MANY + '":1, "format": 1}',
        '{"format": 1, "a": "\xff"}'.encode("latin-1"),
        " " * 40_000_000,
    ],
    ids=itertools.count(),
)
def test_baselines(tmp_path: Path, text: str | bytes) -> None:
    refused(load_baseline, tmp_path / "baseline.json", text)


def comb(teeth: int, kind: str = "fixed") -> str:
    made = ['<robot name="r"><link name="l0"/>']
    for i in range(1, teeth):
        for name, parent in ((f"l{i}", f"l{i - 1}"), (f"t{i}", f"l{i}")):
            made.append(
                f'<link name="{name}"/><joint name="j{name}" type="{kind}"><axis xyz="0 1 0"/>'
                f'<parent link="{parent}"/><child link="{name}"/></joint>'
            )
    return "".join([*made, "</robot>"])


URDFS = {
    "comb": comb(12_000),
    "comb that turns": comb(12_000, "continuous"),
    "names": "<robot>"
    + "".join(f"<link name='{'a' * 900}{i}'/>" for i in range(8000))
    + "</robot>",
    "laughs": '<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>',
    "outside": '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot name="&a;"/>',
    "nested": "<robot>" + "<a>" * MANY,
    "digits": f"<robot><joint name='a' type='fixed'><origin xyz='{'1' * 5000}'/></joint></robot>",
    "numbers": f"<robot><joint name='a' type='fixed'><origin xyz='{'1 ' * MANY}'/></joint></robot>",
    "attributes": "<robot " + " ".join(f"a{i}='1'" for i in range(MANY)) + "/>",
    "NUL": "<robot>\0</robot>",
    "not UTF-8": b"<robot>\xff</robot>",
    "large": "<robot>" + " " * 10_000_000,
}


@pytest.mark.parametrize("kind", URDFS)
def test_urdfs(tmp_path: Path, kind: str) -> None:
    def read(path: Path) -> None:
        urdf = read_urdf(path)
        urdf.last_links()
        urdf.legs({"a": "l11999" if "comb" in kind else "a" * 900})

    refused(read, tmp_path / "a.urdf", URDFS[kind])


# -- Text from the wire is shown, never obeyed by a terminal

HOSTILE = "\x1b[31mred\x1b]0;title\x07 \x9b2J \u202eback [bold]markup[/] \x7f\r\n"


@given(st.text())
def test_no_control_character_is_left(text: str) -> None:
    shown = printable(text)
    assert not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in shown)
    assert not any(unicodedata.bidirectional(c) in _OVERRIDES for c in shown)
    assert printable(shown) == shown
    assert printable_lines(text).count("\n") == text.count("\n")


_OVERRIDES = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_json_keeps_its_value(text: str) -> None:
    assert json.loads(printable_json(json.dumps([text], ensure_ascii=False))) == [text]


def test_the_table_of_watch_sends_nothing_to_the_terminal() -> None:
    leg = LegView(leg=HOSTILE, note=HOSTILE, kind=HOSTILE, rejects={HOSTILE: 3}, status="valid")
    out = io.StringIO()
    Console(file=out, width=400, color_system=None).print(table(View(legs=[leg], alive=True)))
    text = out.getvalue()
    assert not set(text) & set("\x1b\x07\x9b\u202e\x7f\r")
    assert "[bold]markup[/]" in text
