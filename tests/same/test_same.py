"""The comparison itself: what it calls the same, and that it sees what it is for."""

from __future__ import annotations

from pathlib import Path

import pytest

from .faults import FAULTS, find, planted
from .recordings import quick, write
from .trees import ROOT, Tree

# -- with learners ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("same") / "quick.msgpack"
    write(quick(), path)
    return path


@pytest.fixture(scope="module")
def sound() -> Tree:
    """The working tree where it lies: of a copy, nothing would be compiled yet."""
    return Tree.at("working tree", ROOT)


# Processes of a planted tree compile a tick that no process has run: minutes on a busy machine.
pytestmark = pytest.mark.timeout(900)

QUICK = "sign of the onset's share"


def found(name: str, recording: Path, sound: Tree, folder: Path) -> str | None:
    """On what a planted fault shows, and how."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    with planted(fault, sound, folder) as tree:
        return find(fault, sound, tree, {"quick": recording}, folder / "outcomes")


def test_a_planted_fault_is_found(
    recording: Path, sound: Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As plain Python: the compiler takes three times as long as both replays."""
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert found(QUICK, recording, sound, tmp_path) is not None


def test_every_fault_can_be_planted_in_this_tree(sound: Tree, tmp_path: Path) -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 20
    for fault in FAULTS:
        with planted(fault, sound, tmp_path) as tree:
            assert tree.digest != sound.digest
