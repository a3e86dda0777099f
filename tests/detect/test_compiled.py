"""Where compiled code is kept, and that it says the same uncompiled."""

from __future__ import annotations

import ast
import inspect
import os
import shutil
import subprocess
import sys
import textwrap
import time
from collections import namedtuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adaptive_contact import compiled
from adaptive_contact.detect.layout import LEG, new_legs, scalars_of
from adaptive_contact.learn.rls import LEARNED, learn_row


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
    assert found is not None
    assert found.parent == folder / "home" / ".cache" / "adaptive-contact"
    assert found.stat().st_mode & 0o777 == 0o700
    assert found.parent.stat().st_mode & 0o777 == 0o700
    assert not compiled.is_cached()


@pytest.mark.parametrize("variable", [compiled.CACHE_VARIABLE, "CACHE_DIRECTORY"])
def test_a_named_folder_comes_first(
    folder: Path, monkeypatch: pytest.MonkeyPatch, variable: str
) -> None:
    monkeypatch.setenv(variable, str(folder / "named"))
    assert compiled.cache_folder() is not None
    assert compiled.cache_folder().parent == folder / "named"  # type: ignore[union-attr]


def test_a_folder_that_others_may_write_to_holds_no_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What lies there is executed."""
    theirs = folder / "theirs"
    theirs.mkdir()
    theirs.chmod(0o777)
    monkeypatch.setenv(compiled.CACHE_VARIABLE, str(theirs))
    found = compiled.cache_folder()
    assert found is not None
    assert theirs not in found.parents
    assert not list(theirs.iterdir())


def test_a_link_is_no_folder_of_the_users_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "elsewhere").mkdir()
    (folder / "link").symlink_to(folder / "elsewhere")
    monkeypatch.setenv(compiled.CACHE_VARIABLE, str(folder / "link"))
    assert compiled.cache_folder() is not None
    assert not list((folder / "elsewhere").iterdir())


def test_without_a_home_the_folder_for_temporary_files_serves(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/proc/nobody")  # as of a system user
    found = compiled.cache_folder()
    assert found is not None
    assert found.parent == folder / "tmp" / f"adaptive-contact-{os.getuid()}"


def test_no_folder_is_no_error(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(compiled.CACHE_VARIABLE, "")
    assert compiled.cache_folder() is None
    assert not compiled.is_cached()


def test_a_part_of_it_is_not_all(folder: Path) -> None:
    """A start that finds a part would compile the rest itself, and keep the memory for it."""
    code = """
from adaptive_contact import compiled
(compiled.cache_folder() / "part.nbi").touch()
print(compiled.is_cached())
"""
    if not compiled.compiles():
        pytest.skip("nothing is compiled here")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["False"]


@pytest.mark.slow  # compiles everything
def test_all_of_it_is_kept(folder: Path) -> None:
    code = """
from adaptive_contact import compiled
from adaptive_contact.bank import compile_ahead
compile_ahead()
print(compiled.is_cached())
print(len(list(compiled.cache_folder().rglob("*.nbc"))) > 3)
"""
    if not compiled.compiles():
        pytest.skip("nothing is compiled here")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["True", "True"]


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
    os.utime(one / "adaptive_contact" / "detect" / "detector.py")  # installed again
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


def test_the_tests_of_a_swing_pass_uncompiled() -> None:
    """They drive single steps of the tick; `make uncompiled` runs all of them so."""
    tests = [
        str(Path(__file__).parents[1] / "learner" / f"test_{name}.py")
        for name in ("segments", "ground")
    ]
    subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *tests],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, check=True,
    )  # fmt: skip


def test_what_earlier_versions_compiled_goes_after_a_quarter(folder: Path) -> None:
    if not compiled.compiles():
        pytest.skip("nothing is compiled here")
    found = compiled.cache_folder()
    assert found is not None
    old, recent = (found.with_name(f"compiled-{name}") for name in ("old", "recent"))
    for other, days in ((old, 91), (recent, 89)):
        other.mkdir()
        (other / "whole").touch()
        then = time.time() - days * 86400
        os.utime(other / "whole", (then, then))
    compiled.note_cached()
    assert compiled.is_cached()
    assert (old.exists(), recent.exists()) == (False, True)


GIVEN = compiled.Handover(values=(np.float64, 2), at=(np.int64, 1), legs=(LEG, 1))
receive_given = GIVEN.receive


@compiled.compiled
def turned_in(handed):  # type: ignore[no-untyped-def]
    """Reads and writes what was handed over."""
    values, at, legs = receive_given(handed)
    values[at[0], at[1]] += 1.0
    legs[1].seq = values.shape[0] * 100 + values.shape[1]
    return values[at[0]].sum()


def test_arrays_are_handed_over_as_they_are() -> None:
    values, at, legs = np.arange(12.0).reshape(3, 4), np.array([2, 1]), new_legs(2)
    turn_in = GIVEN.bind(turned_in, {"legs": legs, "values": values, "more": 0, "at": at})
    assert turn_in() == 8 + 10 + 10 + 11
    assert values[2, 1] == 10.0
    assert legs[1]["seq"] == 304
    at[0] = 0  # the arrays themselves, not what they were
    assert turn_in() == 0 + 2 + 2 + 3


Own = namedtuple("Own", "grid ends first second")
PARTED = compiled.Handover(
    side_by_side=(np.float64, 2), grid=(np.float64, 3), places=(np.int64, 2), ends=(np.int64, 1)
)
receive_parted = PARTED.receive
own_of = PARTED.part(Own, {"first": ("side_by_side", 0), "second": ("side_by_side", 2)}, ("ends",))


@compiled.compiled
def doubled(handed, row):  # type: ignore[no-untyped-def]
    """Doubles what is of one row; returns shapes."""
    own = own_of(receive_parted(handed), row)
    own.first[:] *= 2.0
    own.second[:] *= 2.0
    own.grid[1, 0] *= 2.0
    own.ends[0] += 1
    return own.grid.shape[0], own.grid.shape[1], len(own.first), len(own.second), len(own.ends)


@pytest.mark.parametrize("row", [0, 2])
def test_the_arrays_of_one_row_are_views_of_those_of_all(row: int) -> None:
    arrays = {
        "side_by_side": np.arange(1.0, 31.0).reshape(3, 10),
        "grid": np.arange(1.0, 37.0).reshape(3, 3, 4),
        "places": np.array([[0, 4], [4, 5], [5, 10]]),
        "ends": np.zeros(2, np.int64),
    }
    expected = {name: array.copy() for name, array in arrays.items()}
    expected["side_by_side"][row, [0, 1, 2, 3, 5, 6, 7, 8, 9]] *= 2.0
    expected["grid"][row, 1, 0] *= 2.0
    expected["ends"][0] = 1
    assert PARTED.bind(doubled, arrays)(row) == (3, 4, 4, 5, 2)
    for name, array in arrays.items():
        assert array.tolist() == expected[name].tolist(), name


@pytest.mark.skipif(not compiled.compiles(), reason="uncompiled, any array will do")
@pytest.mark.parametrize(
    "values",
    [np.zeros((3, 4), np.float32), np.zeros(3), np.zeros((3, 4)).T, np.zeros((3, 8))[:, ::2]],
)
def test_an_array_of_another_kind_is_refused(values: np.ndarray) -> None:
    arrays = {"values": values, "at": np.zeros(2, np.int64), "legs": new_legs(1)}
    with pytest.raises(TypeError, match=r"values: found .*expected 2 of float64, contiguous"):
        GIVEN.bind(turned_in, arrays)


@pytest.mark.parametrize(
    ("function", "handover"),
    [(learn_row, LEARNED), (turned_in, GIVEN)],
)
def test_arrays_are_received_by_the_names_they_are_handed_over_by(
    function: Any, handover: compiled.Handover
) -> None:
    source = textwrap.dedent(inspect.getsource(getattr(function, "py_func", function)))
    received = [
        tuple(name.id for name in node.targets[0].elts)  # type: ignore[attr-defined]
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Assign) and "receive_" in ast.unparse(node.value)
    ]
    assert received == [handover.names]


def test_the_scalars_of_a_leg_are_those_of_its_record() -> None:
    legs = new_legs(2)
    leg, before = scalars_of(legs, 1), legs.tobytes()[: LEG.itemsize]
    for number, name in enumerate(LEG.names or ()):
        legs[1][name] = number
        assert getattr(leg, name) == legs[1][name]
        setattr(leg, name, 0)
        assert legs[1][name] == 0
    assert legs.tobytes()[: LEG.itemsize] == before
    with pytest.raises(AttributeError):
        leg.no_such_name = 0


def test_rows_of_a_leg_that_changes_are_kept_uncompiled() -> None:
    """What two lifts have confirmed is joined, and the buffer and the recursion take it."""
    code = """
import numpy as np
from adaptive_contact.learn.replay_buffer import ReplayBuffer
from adaptive_contact.learn.rls import RecursiveLeastSquares
from adaptive_contact.model.labelled_swing import ROW, Rows
rows = Rows(np.ones((3, 4)), np.zeros(3, ROW).view(np.recarray), 1)
buffer = ReplayBuffer()
buffer.add(rows.then(rows), 0, 0)
rls = RecursiveLeastSquares(np.zeros((2, 1)), np.ones((2, 1), bool), np.ones(2), np.ones(1))
assert rls.learn(buffer.values, buffer.next_unlearned()[0])
print(buffer.unlearned, rls.rows)
"""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["5", "1"]
