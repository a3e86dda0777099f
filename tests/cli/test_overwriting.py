"""No command writes over a file that is there, unless --force says so."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from adaptive_contact.cli import main

KEPT = b"somebody's work"
# Each option that names what a command writes: by its command, words around the file.
WRITTEN: dict[tuple[str, ...], tuple[str, ...]] = {
    ("record", "file"): ("FILE",),
    ("replay", "events"): ("in.mcap", "--events", "FILE"),
    ("replay", "plot"): ("in.mcap", "--plot", "FILE"),
    ("export", "out"): ("in.mcap", "--to", "mcap", "-o", "FILE"),
    ("fit", "out"): ("in.mcap", "-o", "FILE"),
    ("sim", "pose", "record"): ("--offline", "--seconds", "1", "--record", "FILE"),
    ("sim", "compare", "picture"): ("--picture", "FILE"),
    ("sim", "pose", "render"): ("--offline", "--seconds", "1", "--render", "FILE"),
    ("sim", "walk", "record"): ("--offline", "--seconds", "1", "--record", "FILE"),
    ("sim", "walk", "render"): ("--offline", "--seconds", "1", "--render", "FILE"),
    ("sim", "baseline", "out"): ("--out", "FILE"),
    ("bridge", "virtual", "write_config"): ("--write-config", "FILE"),
    ("bridge", "virtual", "record"): ("--scenario", "walk", "--record", "FILE"),
    ("bridge", "virtual", "directory"): ("--dir", "FOLDER/port0"),
    ("robot", "init", "out"): ("--legs", "l", "--joints", "2", "--out", "FILE"),
    ("robot", "check", "picture"): ("--picture", "FILE"),
    ("robot", "learn", "out"): ("--out", "FILE"),
    ("robot", "learn", "recording"): ("--recording", "FILE"),
    ("demo", "out"): ("--out", "FOLDER/summary.json"),
    ("bench", "out"): ("--out", "FOLDER/bench.json"),
    ("paper", "docs"): ("--docs", "FILE"),
    ("scenarios", "report", "docs"): ("--docs", "FOLDER/adaptation.md"),
}
# What commands read, folders of the studies, in which the same command goes on, and the folder in
# which the live page makes files of new names.
OTHERS = {
    *(
        "baseline",
        "zenoh_config",
        "ros_zenoh_config",
        "state",
        "scenario",
        "urdf",
        "more",
        "device",
        "record_to",
    ),
    *(("replay", "file"), ("export", "file"), ("score", "events"), ("fit", "recordings")),
    *(("export", "events"), ("score", "recording")),
    *(("paper", "out"), ("scenarios", "run", "out"), ("scenarios", "report", "out")),
    ("sim", "compare", "out"),
}


def _all(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Options that name files, each by its command."""
    for option in command.params:
        if re.search("FILE|DIR|FOLDER|OUT|PATH$|RECORD|MCAP", str(option.metavar)):
            yield (*path, option.name)
    for name, below in getattr(command, "commands", {}).items():
        yield from _all(below, (*path, name))


@pytest.fixture
def said(monkeypatch: Any, tmp_path: Path, ours: Any) -> Any:
    """Run a command in an empty folder: its exit code, and what it says on standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str]:
        code, _, err = ours(*words)
        return code, err

    return run


@pytest.mark.parametrize("where", WRITTEN, ids=" ".join)
def test_a_file_that_is_there_is_kept(where: tuple[str, ...], tmp_path: Path, said: Any) -> None:
    file = Path("out.png")
    words = list(WRITTEN[where])
    for k, word in enumerate(words):
        if word.startswith("FOLDER/"):
            file, words[k] = Path("folder", Path(word).name), "folder"
            file.parent.mkdir()
    file.write_bytes(KEPT)
    words = [str(file) if word == "FILE" else word for word in words]
    code, line = said(*where[:-1], *words)
    assert code == 2
    assert re.fullmatch(rf"adaptive-contact: \S*{file} exists already.*\n", line)
    assert file.read_bytes() == KEPT
    assert [p for p in tmp_path.rglob("[!.]*") if p.is_file()] == [tmp_path / file]


def test_every_option_that_names_a_file_is_looked_at() -> None:
    main.load_commands()
    found = set(_all(get_command(main.app)))
    assert {one for one in found if one not in OTHERS and one[-1] not in OTHERS} == {*WRITTEN}


def test_a_picture_is_what_its_name_says(said: Any) -> None:
    code, line = said("sim", "compare", "--picture", "walks.svg")
    assert (code, line) == (
        2,
        "adaptive-contact: --picture walks.svg: expected a name that ends with .png\n",
    )


def test_force_replaces(said: Any) -> None:
    file = Path("walk.mcap")
    file.write_bytes(KEPT)
    words = ("sim", "walk", "--offline", "--seconds", "0.1", "--record", "walk.mcap")
    assert said(*words, "--force") == (0, "")
    recorded = file.read_bytes()
    assert recorded != KEPT
    code, line = said("replay", "walk.mcap", "--events", "walk.mcap", "--force")
    assert (code, "what the command reads" in line) == (2, True)
    code, line = said("replay", "walk.mcap", "--events", "x", "--plot", "x")
    assert (code, "given twice" in line) == (2, True)
    assert file.read_bytes() == recorded


def test_what_stands_in_a_usual_folder_is_made_again(said: Any) -> None:
    """A study that is refused for another reason shows that its files were none."""
    for name in ("out/demo/summary.json", "docs/adaptation.md"):
        Path(name).parent.mkdir(parents=True)
        Path(name).write_bytes(KEPT)
    assert "expected 8 to 3600 s" in said("demo", "--seconds", "1")[1]
    assert "no results there" in said("scenarios", "report")[1]
    assert "exists already" in said("scenarios", "report", "--docs", "./docs/../docs")[1]
