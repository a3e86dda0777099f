"""Who has a pseudo-terminal open, where another file system has one of the same number."""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.bridge.port import holders, is_pseudo

_TIOCGPTN = 0x80045430
_TIOCSPTLCK = 0x40045431

Holding = Callable[..., int]


@pytest.fixture
def terminals(tmp_path: Path) -> Iterator[Path]:
    """A devpts of its own, as every container has one."""
    folder = tmp_path / "pts"
    folder.mkdir()
    mount = ["mount", "-t", "devpts", "-o", "newinstance,ptmxmode=0666", "devpts", folder]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, timeout=30, check=False)
    except OSError as error:
        pytest.skip(f"mounts nothing here ({error})")
    if done.returncode:
        pytest.skip(f"mounts nothing here, which takes root ({done.stderr.strip()})")
    yield folder
    subprocess.run(["umount", "-l", folder], timeout=30, check=True)


@pytest.fixture
def opened() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as stack:
        yield stack


@pytest.fixture
def holding(program: Callable[..., Any]) -> Holding:
    """A process that has files open and does nothing."""
    waits = "import signal; signal.pause()"

    def start(*files: int) -> int:
        return program("-c", waits, pass_fds=files).process.pid

    return start


def pair_of(folder: Path, index: int, opened: contextlib.ExitStack) -> tuple[int, int]:
    """Both ends of the pair of that number, in a file system of which nobody else knows."""
    while True:
        master = os.open(folder / "ptmx", os.O_RDWR | os.O_NOCTTY)
        opened.callback(os.close, master)
        (found,) = struct.unpack("i", fcntl.ioctl(master, _TIOCGPTN, bytes(4)))
        if found == index:
            fcntl.ioctl(master, _TIOCSPTLCK, struct.pack("i", 0))
            slave = os.open(folder / str(index), os.O_RDWR | os.O_NOCTTY)
            opened.callback(os.close, slave)
            return master, slave


def test_a_terminal_of_a_container_is_not_ours(
    terminals: Path, opened: contextlib.ExitStack, holding: Holding
) -> None:
    master, slave = os.openpty()
    opened.callback(os.close, master)
    opened.callback(os.close, slave)
    ours = os.ttyname(slave)
    index = int(Path(ours).name)
    their_master, their_slave = pair_of(terminals, index, opened)
    theirs = str(terminals / str(index))
    assert os.fstat(slave).st_rdev == os.fstat(their_slave).st_rdev
    assert is_pseudo(ours)
    assert is_pseudo(theirs)

    user, guest = holding(slave), holding(their_slave)
    assert list(holders(ours)) == [user]
    assert list(holders(theirs)) == [guest]

    # A virtual bus has both ends of one pair open.
    bus, their_bus = holding(master, slave), holding(their_master, their_slave)
    assert bus not in holders(ours)
    assert their_bus not in holders(theirs)


def test_what_is_no_terminal(tmp_path: Path, holding: Holding) -> None:
    assert holders(str(tmp_path)) == {}
    assert holders(str(tmp_path / "gone")) == {}
    assert not is_pseudo(str(tmp_path))
    assert not is_pseudo("/dev/null")
    with Path("/dev/full").open("rb") as full:
        assert holding(full.fileno()) in holders("/dev/full")
