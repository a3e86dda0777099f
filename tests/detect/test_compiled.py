"""Where compiled code is kept, and that it says the same uncompiled."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adaptive_contact import compiled


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment in which only this folder is named."""
    for name in (compiled.CACHE_VARIABLE, "CACHE_DIRECTORY", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr(compiled.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    compiled.cache_folder.cache_clear()
    yield tmp_path
    compiled.cache_folder.cache_clear()


def test_what_is_compiled_is_kept_in_a_folder_of_the_users_own(folder: Path) -> None:
    found = compiled.cache_folder()
    assert found.parent == folder / "home" / ".cache" / "adaptive-contact"
    assert found.stat().st_mode & 0o777 == 0o700
    assert found.parent.stat().st_mode & 0o777 == 0o700
    assert not compiled.is_cached()


@pytest.mark.parametrize(
    ("variable", "value", "parent"),
    [
        (compiled.CACHE_VARIABLE, "{}/named", "{}/named"),
        ("CACHE_DIRECTORY", "{}/named", "{}/named"),
        # What lies where others may write is executed, and a link may lead there.
        (compiled.CACHE_VARIABLE, "{}/theirs", "{}/home/.cache/adaptive-contact"),
        (compiled.CACHE_VARIABLE, "{}/link", "{}/home/.cache/adaptive-contact"),
        ("HOME", "/proc/nobody", f"{{}}/tmp/adaptive-contact-{os.getuid()}"),  # of a system user
    ],
)
def test_a_named_folder_comes_first_unless_others_may_write_to_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, variable: str, value: str, parent: str
) -> None:
    (folder / "theirs").mkdir()
    (folder / "theirs").chmod(0o777)
    (folder / "link").symlink_to(folder / "theirs")
    monkeypatch.setenv(variable, value.format(folder))
    assert str(compiled.cache_folder().parent) == parent.format(folder)
    assert not list((folder / "theirs").iterdir())


def test_no_folder_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiled.CACHE_VARIABLE, "")
    assert compiled.cache_folder() is None
    assert not compiled.is_cached()


PART = '(compiled.cache_folder() / "part.nbi").touch()'
WHOLE = """
from adaptive_contact.core.bank import compile_ahead
compile_ahead()
assert len(list(compiled.cache_folder().rglob("*.nbc"))) > 3
"""


@pytest.mark.parametrize(
    ("kept", "enough"), [(PART, False), pytest.param(WHOLE, True, marks=pytest.mark.slow)]
)
def test_a_part_of_what_is_compiled_is_not_all(folder: Path, kept: str, enough: bool) -> None:
    """A start that finds a part would compile the rest itself, and keep the memory for it."""
    if not compiled.compiles():
        pytest.skip("nothing is compiled here")
    code = f"from adaptive_contact import compiled\n{kept}\nprint(compiled.is_cached())"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == [str(enough)]


def test_another_installation_of_the_same_sources_is_not_compiled_yet(folder: Path) -> None:
    """numba keeps machine code by the place and the time of its source: nothing of it is shared."""
    package = Path(compiled.__file__).parent
    code = "from adaptive_contact import compiled; print(compiled.cache_folder())"
    python = [sys.executable, "-c", code]

    def kept_in(site: Path) -> str:
        env = {**os.environ, "PYTHONPATH": str(site)}
        ran = subprocess.run(python, env=env, capture_output=True, text=True, check=True, cwd="/")
        return ran.stdout

    one, other = (folder / name for name in ("one", "other"))
    for site in (one, other):
        shutil.copytree(package, site / "adaptive_contact")
    first = kept_in(one)
    assert "compiled-" in first
    assert kept_in(other) != first
    assert kept_in(one) == first
    os.utime(one / "adaptive_contact" / "core" / "detect" / "detector.py")  # installed again
    assert kept_in(one) != first


_RUN = """
import json, sys
sys.path.insert(0, {tests!r})
from learner import conftest as made
from adaptive_contact import ContactLearner
from adaptive_contact.robot import parse_robot
robot = parse_robot(made.TOML, source="test")
baseline = made.baseline.__wrapped__(robot)
learner = ContactLearner(robot, "rf", baseline)
events = []
stream = made.samples(*made.FakeLeg(seed=2).run(9, touch=lambda n: 16 if n % 2 else None)[:3])
for k, sample in enumerate(stream):
    if 100 < k < 104 or k == 130:
        continue
    event = learner.update(sample)
    if event is not None:
        events.append([event.seq, event.contact, event.onset_ns, round(event.score, 9)])
status = learner.status
print(json.dumps([events, status.ticks, status.missed, status.buffer.lift_ticks]))
"""


def test_the_tick_says_the_same_uncompiled() -> None:
    """So a debugger and coverage see what runs; a gap, a hole and touches are in it."""
    said = []
    for disabled in ("0", "1"):
        ran = subprocess.run(
            [sys.executable, "-c", _RUN.format(tests=str(Path(__file__).parents[1]))],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        said.append(ran.stdout)
    assert said[0] == said[1]
    assert said[0].count("true") >= 3


def test_what_earlier_versions_compiled_goes_after_a_quarter(folder: Path) -> None:
    if not compiled.compiles():
        pytest.skip("nothing is compiled here")
    found = compiled.cache_folder()
    old, recent = (found.with_name(f"compiled-{name}") for name in ("old", "recent"))
    for other, days in ((old, 91), (recent, 89)):
        other.mkdir()
        (other / "whole").touch()
        then = time.time() - days * 86400
        os.utime(other / "whole", (then, then))
    compiled.mark_cache_complete()
    assert compiled.is_cached()
    assert (old.exists(), recent.exists()) == (False, True)
