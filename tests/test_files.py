"""Files that commands write: whole or not at all; links followed; devices and FIFOs kept."""

from __future__ import annotations

import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.errors import BaselineError, ConfigurationError
from adaptive_contact.files import why_not_writable, write_file


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_new_file_has_the_mode_of_any_other_file(tmp_path: Path) -> None:
    write_file(tmp_path / "a", "text ü")
    (tmp_path / "b").write_text("text ü", encoding="utf-8")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode
    assert names(tmp_path) == ["a", "b"]


def test_an_old_file_keeps_its_mode_and_owner(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    path.chmod(0o640)
    if os.geteuid() == 0:
        os.chown(path, 65534, 65534)
    before = path.stat()
    write_file(path, b"new")
    after = path.stat()
    assert path.read_bytes() == b"new"
    assert after.st_ino != before.st_ino
    assert (after.st_mode, after.st_uid, after.st_gid) == (
        (before.st_mode, before.st_uid, before.st_gid)
    )


@pytest.mark.parametrize("exists", [True, False])
def test_a_link_stays_a_link_and_its_target_is_written(tmp_path: Path, exists: bool) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    target = folder / "target"
    if exists:
        target.write_bytes(b"old")
    (tmp_path / "middle").symlink_to("elsewhere/target")
    link = tmp_path / "link"
    link.symlink_to("middle")
    write_file(link, b"new")
    assert link.is_symlink()
    assert (tmp_path / "middle").is_symlink()
    assert target.read_bytes() == b"new"
    assert names(folder) == ["target"]
    assert names(tmp_path) == ["elsewhere", "link", "middle"]


def test_a_loop_of_links_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(ConfigurationError, match="cannot be written"):
        write_file(tmp_path / "a", b"")


def test_a_fifo_is_written_to_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "fifo"
    os.mkfifo(path)
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append(path.read_bytes()))
    reader.start()
    write_file(path, b"x" * 200_000)
    reader.join(10)
    assert got == [b"x" * 200_000]
    assert stat.S_ISFIFO(path.lstat().st_mode)
    assert names(tmp_path) == ["fifo"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_device_is_one_line_of_the_kind_that_is_asked_for() -> None:
    with pytest.raises(BaselineError, match=r"/dev/full: cannot be written \(No space .*\); do so"):
        write_file("/dev/full", b"x", advice="do so", error=BaselineError)


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failure_leaves_the_old_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def fails(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, step, fails)
    with pytest.raises(ConfigurationError, match="No space left"):
        write_file(path, b"new")
    monkeypatch.undo()
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a"]


def test_standard_output_that_is_a_file_keeps_what_was_printed(tmp_path: Path) -> None:
    code = (
        "from adaptive_contact.files import write_file\n"
        "print('before')\n"
        "write_file('/dev/stdout', b'content\\n')\n"
        "print('after')\n"
    )
    out = tmp_path / "out"
    with out.open("wb") as file:
        subprocess.run([sys.executable, "-c", code], stdout=file, check=True, timeout=600)
    assert out.read_text() == "before\ncontent\nafter\n"


def test_what_could_not_be_written_is_known_before(tmp_path: Path) -> None:
    assert why_not_writable(tmp_path) == "it is a folder"
    assert "no folder" in str(why_not_writable(tmp_path / "no" / "file"))
    (tmp_path / "link").symlink_to("no/file")
    assert "no folder" in str(why_not_writable(tmp_path / "link"))
    assert why_not_writable(tmp_path / "file") is None
    assert list(tmp_path.iterdir()) == [tmp_path / "link"], "it is only tried"
    # Where permissions allow it, to root.
    assert "no file can be made in its folder" in str(why_not_writable(Path("/proc/file")))
