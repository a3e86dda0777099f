"""Documentation that cannot go stale unseen: links, names, command lines, make targets, Python."""

from __future__ import annotations

import ast
import contextlib
import re
import shlex
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from typer.main import get_command

from adaptive_contact.cli import main

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
HISTORY = ROOT / "CHANGELOG.md"  # names what was there then
PACKAGES = (ROOT / "adaptive_contact", *(ROOT / "sim").glob("adaptive_contact_*"))
SOURCES = sorted(
    path
    for folder in (*PACKAGES, ROOT / "models", ROOT / "tests", ROOT / "examples", ROOT / "docs")
    for path in folder.rglob("*.py")
)

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_CODE = re.compile(r"`([^`]+)`")
_LINK = re.compile(r"\]\(<?([^)\s>]+)>?\)")
_FILE = re.compile(r"(?<![\w/.*<-])((?:[\w-]+/)*[\w-]+\.py)\b")
_FOLDER = re.compile(
    r"`((?:tests|docs|examples|packaging|sim|models|adaptive_contact)(?:/[\w-]+)+)/?`"
)
_MEMBER = re.compile(r"(?<![\w.])([A-Z]\w+)\.([a-z_]\w*)")
_SHELLS = ("", "bash", "console", "sh", "shell")


class Quote(NamedTuple):
    """A command as a page writes it; in a fence it is whole, in a sentence it may be cut short."""

    page: str
    words: tuple[str, ...]
    whole: bool

    def __str__(self) -> str:
        return f"{self.page}: {' '.join(self.words)}"


@cache
def parts(page: Path) -> tuple[str, tuple[tuple[str, str], ...]]:
    """The text without its fences, and the fences with their language."""
    text = page.read_text(encoding="utf-8")
    return _FENCE.sub("", text), tuple(_FENCE.findall(text))


@cache
def anchors(page: Path) -> frozenset[str]:
    """Anchors of the headings, as GitHub makes them."""
    found: list[str] = []
    for title in re.findall(r"^#+ +(.*?) *#*$", parts(page)[0], re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title.lower()).replace("`", "")
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        found.append(f"{slug}-{found.count(slug)}" if slug in found else slug)
    return frozenset(found)


def quotes(name: str) -> list[Quote]:
    """Command lines of all pages that begin with a name."""
    found = []
    for page in PAGES:
        text, fences = parts(page)
        where = str(page.relative_to(ROOT))
        lines = [
            (line, True)
            for language, body in fences
            if language in _SHELLS
            for line in body.replace("\\\n", " ").splitlines()
        ]
        # A line break inside a code span is a space.
        lines += [(" ".join(span.split()), False) for span in _CODE.findall(text)]
        for line, whole in lines:
            line = re.sub(r"^(\$ |[A-Z_]+=\S+ |\.venv/bin/)+", "", line.strip())
            line = re.sub(r"^python3? -m adaptive_contact\b", "adaptive-contact", line)
            if re.match(r"adaptive-contact( [a-z]+)*:", line):
                continue  # what a command said, not one
            if re.match(rf"{name}(\s|$)", line):
                words = shlex.split(re.split(r" [|>&;]", line)[0], comments=True)
                found.append(Quote(where, tuple(words), whole))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere_and_python_compiles(page: Path) -> None:
    for language, body in parts(page)[1]:
        if language == "python":
            compile(body, str(page), "exec")
    for target in _LINK.findall(parts(page)[0]):
        if re.match(r"[a-z]+:", target):
            continue  # of another site, which a test does not ask
        path, _, anchor = target.partition("#")
        there = (page.parent / path).resolve() if path else page
        assert there.exists(), f"{target}: no such file"
        assert there.is_relative_to(ROOT), f"{target}: leads out of the repository"
        if anchor:
            assert anchor in anchors(there), f"{target}: no such heading"


@cache
def members() -> dict[str, set[str]]:
    """Names of what each class of ours has."""
    found: dict[str, set[str]] = {}
    for source in SOURCES:
        for of in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
            if isinstance(of, ast.ClassDef):
                names = found.setdefault(of.name, set())
                for inner in ast.walk(of):
                    if isinstance(inner, ast.FunctionDef):
                        names.add(inner.name)
                    elif isinstance(inner, ast.Attribute):
                        names.add(inner.attr)
                    elif isinstance(inner, ast.Name) and isinstance(inner.ctx, ast.Store):
                        names.add(inner.id)
    return found


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page != HISTORY],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_files_and_members_named_exist(page: Path) -> None:
    """Each ``path/file.py`` and ``path/folder``, and each ``Class.member`` of a class of ours."""
    text = page.read_text(encoding="utf-8")
    files = [source.relative_to(ROOT).as_posix() for source in SOURCES]
    for name in _FILE.findall(text):
        assert any(f"/{file}".endswith(f"/{name}") for file in files), f"{name}: no such file"
    for name in _FOLDER.findall(text):
        assert (ROOT / name).exists(), f"{name}: no such folder"
    for name, member in _MEMBER.findall(text):
        if member not in ("py", "csv"):  # not a file
            of = members().get(name)
            assert of is None or member in of, f"{name} has no {member}"


def test_every_decision_is_listed() -> None:
    folder = ROOT / "docs" / "decisions"
    listed = (folder / "README.md").read_text()
    notes = sorted(folder.glob("0*.md"))
    assert len(notes) > 40
    for note in notes:
        title = note.read_text().splitlines()[0].removeprefix("# ")
        assert f"- [{title}]({note.name})" in listed
    assert listed.count("](0") == len(notes)


def test_extras_named_exist() -> None:
    there = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = {
        extra: page.name
        for page in PAGES
        for extras in re.findall(r"'(?:\.|adaptive-contact)\[([\w,-]+)\]'", page.read_text("utf-8"))
        for extra in extras.split(",")
    }
    assert {"sim", "plot", "dynamixel"} <= set(named)
    assert named.keys() <= there["optional-dependencies"].keys(), named


@pytest.fixture(scope="module")
def program() -> Any:
    """The whole command line."""
    main.load_commands()
    return get_command(main.app)


@pytest.mark.parametrize("quote", sorted(set(quotes("adaptive-contact"))), ids=str)
def test_commands_parse(program: Any, quote: Quote) -> None:
    _, *words = quote.words
    words = [w.strip("[]") for w in words if w.strip("[]") not in ("…", "...", "")]
    command = program
    while words and hasattr(command, "commands"):
        name = words.pop(0)
        if name.startswith("-"):
            assert name in ("--help", "--version", "--install-completion")
            return
        assert name in command.commands, f"no command '{name}'"
        command = command.commands[name]
    if hasattr(command, "commands"):
        return  # a group is named
    if quote.whole and quote.words[1:3] in (("robot", "check"), ("robot", "learn")):
        assert "--config" in words, "without --config it is the shipped hexapod's"
    # With --help, options are read but nothing is missed; what is wrong raises a usage error.
    arguments = words if quote.whole else [*words, "--help"]
    with contextlib.suppress(typer.Exit):
        command.make_context(command.name, arguments)


@pytest.mark.parametrize("quote", sorted(set(quotes("make"))), ids=str)
def test_make_targets_exist(quote: Quote) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in quote.words[1:]:
        if re.fullmatch(r"[a-z][a-z-]*", target):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"no target '{target}'"


def test_the_readme_s_control_loop_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it stands there, on a walk of the simulator: it reports touches and their ends."""
    from adaptive_contact.model import save_baseline, shipped_baseline
    from adaptive_contact.robot import shipped_robot
    from adaptive_contact_sim import SimulationSettings, WalkSettings
    from adaptive_contact_sim.arrays import record_arrays

    loops = [body for kind, body in parts(ROOT / "README.md")[1] if "control_loop" in body]
    assert len(loops) == 1
    models = ROOT / "models" / "adaptive_contact_models" / "hexapod"
    (tmp_path / "robot.toml").write_text((models / "robot.toml").read_text())
    learned = shipped_baseline(shipped_robot().name)
    assert learned is not None
    save_baseline(learned, tmp_path / "legs.json")
    walk = record_arrays(SimulationSettings(motion=WalkSettings(), seed=3), 6.0)
    leg = walk.legs["rf"]

    def control_loop() -> Any:
        for k, t_ns in enumerate(walk.t_ns):
            yield int(t_ns), leg.measured[k].tolist(), leg.desired[k].tolist()

    monkeypatch.chdir(tmp_path)
    exec(compile(loops[0], "README.md", "exec"), {"control_loop": control_loop})
    said = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("touches at ") for line in said) >= 2
    assert sum(line.startswith("lets go at ") for line in said) >= 2
