"""A folder of states: atomic saves, one owner, and the one before as a way back."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.state import (
    Identity,
    Record,
    Refused,
    StateStore,
    is_of_leg,
    list_states,
    robot_folder,
    store,
)
from adaptive_contact.service.state.format import default_folder

from .conftest import WHO, record


@pytest.fixture
def opened(tmp_path: Path) -> Any:
    made = StateStore.open(tmp_path, "mini")
    yield made
    made.close()


def versions(made: StateStore) -> list[int | str]:
    found = [one for _, one in made.candidates(WHO)]
    return [one.why if isinstance(one, Refused) else one.model_version for one in found]


def test_a_damaged_newest_leaves_the_one_before_and_is_set_aside(opened: StateStore) -> None:
    opened.save(record(1))
    opened.save(record(2))
    newest = opened.path(WHO)
    newest.write_bytes(newest.read_bytes()[:-1])
    (path, refused), (_, before) = list(opened.candidates(WHO))
    assert isinstance(refused, Refused)
    assert isinstance(before, Record)
    opened.set_aside(path)
    assert versions(opened) == [1]
    opened.save(record(3))
    opened.save(record(4))
    assert versions(opened) == [4, 3]
    assert newest.with_name(f"{newest.name}.refused").is_file()


def test_the_newest_and_the_one_before_are_set_aside_side_by_side(opened: StateStore) -> None:
    opened.save(record(1))
    opened.save(record(2))
    for path, _ in list(opened.candidates(WHO)):
        opened.set_aside(path)
    assert versions(opened) == []
    kept = list_states(opened.folder.parent)
    name = opened.path(WHO).stem
    assert {stored.path.name: stored.record.model_version for stored in kept} == {  # type: ignore[union-attr]
        f"{name}.state.refused": 2,
        f"{name}.before.refused": 1,
    }


@pytest.mark.parametrize("step", ["write", "fsync", "replace_state", "replace_new"])
def test_a_failure_at_any_step_leaves_a_whole_state(
    opened: StateStore, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    opened.save(record(1))
    opened.save(record(2))
    where, name, suffix = {
        "write": (store, "pack", ""),
        "fsync": (os, "fsync", ""),
        "replace_state": (os, "replace", ".state"),
        "replace_new": (os, "replace", ".new"),
    }[step]
    does = getattr(where, name)

    def fails(first: Any, *more: Any, **at: Any) -> Any:
        if not suffix or first.endswith(suffix):
            raise OSError(errno.ENOSPC, "No space left on device")
        return does(first, *more, **at)

    monkeypatch.setattr(where, name, fails)
    with pytest.raises(OSError, match="No space left"):
        opened.save(record(3))
    monkeypatch.undo()
    left = versions(opened)
    assert left in ([2, 1], [2], [2, 2])
    assert not opened.path(WHO).with_suffix(".new").exists()
    opened.save(record(4))
    assert versions(opened)[0] == 4


def test_one_service_at_a_time_saves(opened: StateStore, tmp_path: Path) -> None:
    opened.save(record(1))
    second = StateStore.open(tmp_path, "mini")
    assert "in use by another service" in second.trouble
    assert versions(second) == [1]
    with pytest.raises(OSError, match="in use by another service"):
        second.save(record(2))
    assert versions(opened) == [1]


def test_a_folder_that_was_removed_is_made_anew_and_held(
    opened: StateStore, tmp_path: Path
) -> None:
    opened.save(record(1))
    shutil.rmtree(opened.folder)
    opened.save(record(2))
    assert versions(opened) == [2]
    second = StateStore.open(tmp_path, "mini")
    assert "in use by another service" in str(second.trouble)


def test_a_folder_that_another_took_meanwhile_is_left_to_it(
    opened: StateStore, tmp_path: Path
) -> None:
    shutil.rmtree(opened.folder)
    second = StateStore.open(tmp_path, "mini")
    assert second.trouble is None
    with pytest.raises(OSError, match="in use by another service"):
        opened.save(record(1))
    second.close()
    assert opened.reopen()


def test_a_file_system_without_locks_is_told_as_such(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    made = StateStore.open(tmp_path, "mini")
    assert "cannot be locked (no locks available)" in str(made.trouble)


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("not a folder")
    made = StateStore.open(file, "mini")
    assert "cannot be written to" in made.trouble
    assert "--no-state" in made.trouble
    assert versions(made) == []


def test_names_stay_inside_the_folder(tmp_path: Path) -> None:
    for name in ("../up", "a/b", "", ".", "..", "é" * 300, "x\0y"):
        folder = robot_folder(tmp_path, name)
        assert folder.parent == tmp_path
        assert folder.name not in ("", ".", "..")
        assert len(folder.name.encode()) < 200
    assert robot_folder(tmp_path, "a/b") != robot_folder(tmp_path, "a_b")
    assert robot_folder(tmp_path, "hexapod-ax12a").name == "hexapod-ax12a"


def test_unreadable_and_huge_files_are_refused(
    opened: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened.path(WHO).mkdir()
    assert versions(opened) == ["cannot be read (is a directory)"]
    opened.path(WHO).rmdir()
    opened.save(record(1))
    monkeypatch.setattr(store, "MAX_BYTES", 100)
    assert "larger than" in str(versions(opened)[0])


def test_the_default_folder_is_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "adaptive-contact"
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_folder() == tmp_path / ".local/state/adaptive-contact"


def test_who_has_no_home_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    with pytest.raises(ConfigurationError, match="give --state DIR, or --no-state"):
        default_folder()


@pytest.mark.parametrize("leg", ["rf", "front-left", "_x", "a.b"])
def test_a_damaged_file_is_known_by_its_name(leg: str) -> None:
    path = StateStore(Path("x")).path(Identity("mini", leg, "servo", "0123456789abcdef"))
    assert is_of_leg(path, leg)
    for suffix in (".refused", ".state.refused", ".before.refused", ".old"):
        assert is_of_leg(path.with_suffix(suffix), leg)
    assert not is_of_leg(path, leg.partition("-")[0] + "y")
    assert not is_of_leg(path, "front")


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_folders_and_files_are_the_user_s_own(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        made = StateStore.open(tmp_path / "parent" / "root", "mini")
        made.save(record(1))
        made.save(record(2))
    finally:
        os.umask(old)
    assert made.exposed is None
    assert mode(made.folder) == mode(made.folder.parent) == 0o700
    assert {mode(path) for path in made.folder.iterdir()} == {0o600}
    made.close()


@pytest.mark.parametrize("suffix", [".new", ".state", ".before"])
@pytest.mark.parametrize("kind", ["symbolic", "hard"])
def test_a_save_writes_through_no_link(opened: StateStore, suffix: str, kind: str) -> None:
    victim = opened.folder.parent / "victim"
    victim.write_bytes(b"precious")
    planted = opened.path(WHO).with_suffix(suffix)
    if kind == "symbolic":
        planted.symlink_to(victim)
    else:
        planted.hardlink_to(victim)
    for version in (1, 2, 3):
        opened.save(record(version))
    assert victim.read_bytes() == b"precious"
    assert versions(opened) == [3, 2]
    assert not any(path.is_symlink() for path in opened.folder.iterdir())
    assert {path.suffix for path in opened.folder.iterdir()} == {".state", ".before", ""}


def test_a_planted_lock_or_folder_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "root").mkdir()
    folder = tmp_path / "root" / "mini"
    folder.symlink_to(victim)
    made = StateStore.open(tmp_path / "root", "mini")
    assert "it is a link" in made.trouble
    assert list(victim.iterdir()) == []
    folder.unlink()
    folder.mkdir()
    (folder / "lock").symlink_to(victim / "file")
    assert not made.reopen()
    assert made.trouble is not None
    assert list(victim.iterdir()) == []


def test_what_is_no_file_is_refused_at_once(opened: StateStore) -> None:
    newest = opened.path(WHO)
    os.mkfifo(newest)  # to open it would wait for a writer
    newest.with_suffix(".before").symlink_to("/dev/zero")
    assert versions(opened) == ["not a file", "a link, which no state is"]


def test_a_folder_swapped_for_a_link_while_it_is_open_gets_nothing(
    opened: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    victim = opened.folder.parent / "victim"
    victim.mkdir()
    real = os.fsync

    def swap(handle: int) -> None:  # in the middle of a save
        monkeypatch.setattr(os, "fsync", real)
        opened.folder.rename(opened.folder.with_name("moved"))
        opened.folder.symlink_to(victim)

    monkeypatch.setattr(os, "fsync", swap)
    opened.save(record(1))
    assert list(victim.iterdir()) == []


@pytest.mark.parametrize(
    ("what", "mode", "said"),
    [
        ("root", 0o770, "chmod"),
        ("folder", 0o770, "chmod"),
        ("state", 0o770, "chmod"),
        ("root", 0o1777, "None"),  # sticky, such as /tmp
    ],
)
def test_what_others_may_write_to_is_reported(
    tmp_path: Path, what: str, mode: int, said: str
) -> None:
    root = tmp_path / "root"
    made = StateStore.open(root, "mini")
    made.save(record(1))
    made.close()
    path = {"root": root, "folder": made.folder, "state": made.path(WHO)}[what]
    path.chmod(mode)
    again = StateStore.open(root, "mini")
    assert again.trouble is None
    assert said in str(again.exposed)
    assert (path.name in str(again.exposed)) is (said == "chmod")
    again.close()
