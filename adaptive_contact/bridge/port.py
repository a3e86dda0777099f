"""Wraps a serial port for the makers' SDKs, without the faults of their own ports.

docs/bridge.md lists these.  What the packet handlers get wrong is worked around in
:mod:`adaptive_contact.bridge.bus`.

Who has a serial port open: locks are advice, and most software for servos does not ask for it.

Linux shows every process' open files under ``/proc/PID/fd``; two files are the same device where
their device numbers are.  A pseudo-terminal's number counts within its ``devpts`` only, of which
every container has one of its own: there the file system must be the same, too.  Of other users'
processes only root sees the files.  Who has the *other end* of a pseudo-terminal open is its
virtual bus, not a rival, and keeps our end open as well.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import math
import os
import select
import termios
import time
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from adaptive_contact.errors import BusError
from adaptive_contact.robot import Port


class PortLostError(BusError):
    """Reports that an open port is gone: unplugged, or its other end hung up."""


class SdkPort:
    """Wraps a serial port as the SDKs' packet handlers want it.

    Attributes:
        is_open: whether it is.
        is_using: set by the SDKs while they wait for an answer.
        timeout_ms: how long an answer may take beyond its bytes.
        latest_s: monotonic time at which any wait for an answer ends.
        received: bytes read so far.
        arrived: bytes read, or thrown away before a question because they came unasked or too
            late; :class:`~adaptive_contact.bridge.bus.Bus` takes out what it has counted.
        byte_s: how long a byte takes on the wire.
    """

    def __init__(self, name: str, port: Port) -> None:
        self.name, self.port_name, self.baudrate = name, port.device, port.baud
        self.is_open = self.is_using = False
        self._serial: Any = None
        self.timeout_ms = port.timeout_ms
        # Start, eight data bits, stop.
        self.byte_s = 10 / port.baud
        self._deadline = 0.0
        self.latest_s = math.inf
        self.received = 0
        self.arrived = bytearray()
        self._closed_to_others = False
        self._fd = -1

    def open(self) -> None:
        """Open the port and lock it.

        Raises:
            BusError: in one line, why it cannot be opened and what to do.
        """
        from serial import Serial, SerialException

        self.close()
        try:
            self._serial = Serial(
                self.port_name, self.baudrate, timeout=0, write_timeout=0, exclusive=True
            )
            self._fd = self._serial.fileno()
            # Sets an FTDI adapter's latency timer to 1 ms; pseudo-terminals and most other drivers
            # have nothing to set.
            with contextlib.suppress(OSError, ValueError, NotImplementedError):
                self._serial.set_low_latency_mode(True)
            # Not a pseudo-terminal: its other end keeps it, and the mark would outlive a killed
            # bridge.
            if not is_pseudo(self.port_name):
                with contextlib.suppress(OSError):
                    fcntl.ioctl(self._fd, termios.TIOCEXCL)
                    self._closed_to_others = True
            self._serial.reset_input_buffer()
        except SerialException as error:
            raise BusError(_explain(self.name, self.port_name, error)) from error
        except (OSError, termios.error, ValueError) as error:
            raise BusError(
                f"port {self.name}: {self.port_name} cannot be opened ({error}); expected a serial "
                "port such as /dev/ttyUSB0"
            ) from error
        self.is_open = True
        if holders(self.port_name):  # software that does not lock, such as the SDKs' own ports
            self.close()
            raise BusError(_describe_holders(self.name, self.port_name))

    def close(self) -> None:
        """Close the port; errors of a port that is gone anyway are not reported."""
        if self._serial is not None:
            with contextlib.suppress(OSError, termios.error):  # unplugged: nothing left to close
                if self._closed_to_others:
                    fcntl.ioctl(self._fd, termios.TIOCNXCL)
                self._serial.close()
            self._closed_to_others = False
        self.is_open = False
        self.is_using = False

    def lost(self, error: Exception) -> PortLostError:
        """Close after an error of the device, and make the error to raise."""
        self.close()
        return PortLostError(f"port {self.name}: {self.port_name} is gone ({error})")

    # -- what the SDKs' packet handlers call ----------------------------------------------------

    def clearPort(self) -> None:
        """Discard what has come unasked, or too late."""
        # DynamixelSDK's way, tcflush, waits for the kernel's worker that hands bytes over, which
        # on a busy computer may wait itself: a cycle of 84 ms was seen.
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self._fd, 4096):
                self.arrived += data

    def readPort(self, length: int) -> bytes:
        """Read up to ``length`` bytes, sleeping until one is there or time is up."""
        if length <= 0:  # asked for after a packet whose length was too short to be true
            return b""
        left = self._deadline - time.monotonic()
        ready, _, _ = select.select([self._fd], [], [], max(left, 0.0))
        if not ready:
            return b""
        data = os.read(self._fd, length)
        if not data:
            raise OSError(errno.EIO, "hung up")
        self.received += len(data)
        self.arrived += data
        return data

    def writePort(self, packet: list[int]) -> int:
        """Write a packet; a full buffer means that the other end does not take it."""
        return os.write(self._fd, bytes(packet))

    def setPacketTimeout(self, packet_length: int) -> None:
        """Begin to wait for so many bytes."""
        usual = time.monotonic() + packet_length * self.byte_s + self.timeout_ms / 1000.0
        self._deadline = min(usual, self.latest_s)

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Begin to wait for so long."""
        self._deadline = time.monotonic() + msec / 1000.0

    def isPacketTimeout(self) -> bool:
        """Return whether the wait is over."""
        return time.monotonic() > self._deadline


def latency_advice(device: str, root: Path = Path("/sys/bus/usb-serial/devices")) -> str | None:
    """Return what to set if a port's USB adapter holds bytes back longer than 1 ms, or None."""
    name = Path(os.path.realpath(device)).name
    timer = root / name / "latency_timer"
    try:
        value = int(timer.read_text())
    except (OSError, ValueError):
        return None  # no FTDI adapter
    if value <= 1:
        return None
    return (
        f"{device}: the adapter's latency timer is {value} ms, expected 1; "
        f"run: echo 1 | sudo tee {timer}"
    )


def _describe_holders(name: str, device: str) -> str:
    who = ", ".join(f"{process} (process {pid})" for pid, process in holders(device).items())
    return f"port {name}: {device} is in use by {who or 'another program'}; end that one" + (
        ("" if who else f" (`sudo fuser {device}` names it)")
        # Two programs on one port would take each other's answers away.
        + ", or to look on beside it, see 'Two masters on one bus' in docs/bridge.md"
    )


def _explain(name: str, device: str, error: OSError) -> str:
    from serial.tools import list_ports

    code = error.errno
    if code is None and "exclusively lock" in str(error):
        code = errno.EAGAIN
    if code == errno.ENOENT:
        there = ", ".join(sorted(p.device for p in list_ports.comports())) or "none"
        return (
            f"port {name}: {device} does not exist; serial ports here: {there}; plug the adapter "
            "in, or correct the device"
        )
    if code in (errno.EACCES, errno.EPERM):
        return (
            f"port {name}: no permission for {device}; run: sudo usermod -aG dialout $USER, then "
            "log in again"
        )
    if code in (errno.EAGAIN, errno.EBUSY):
        return _describe_holders(name, device)
    unfit = code in (errno.ENOTTY, errno.EINVAL, errno.EISDIR, errno.EIO, errno.ENXIO)
    if unfit or "Could not configure port" in str(error):
        return (
            f"port {name}: {device} is no serial port that can be used; expected one such as "
            "/dev/ttyUSB0"
        )
    return f"port {name}: {device} cannot be opened ({error}); check the adapter"


class _Device(NamedTuple):
    number: int
    # File system of a pseudo-terminal.  A node of any other device is the same device in every one.
    within: int | None


def is_pseudo(device: str) -> bool:
    """Return whether a device is a pseudo-terminal; symbolic links are followed."""
    known = _device(Path(device))
    return known is not None and known.within is not None


def holders(device: str) -> dict[int, str]:
    """Return other processes that have a device open, as far as this user may see: name by id."""
    wanted = _device(Path(device))
    if wanted is None:
        return {}
    found = {}
    for process in Path("/proc").iterdir():
        if not process.name.isdigit() or int(process.name) == os.getpid():
            continue
        if any(_device(file) == wanted for file in _files(process)) and not (
            wanted.within is not None and _has_other_end(process, os.path.realpath(device))
        ):
            found[int(process.name)] = _text(process / "comm") or "a program"
    return dict(sorted(found.items()))


def _device(file: Path) -> _Device | None:
    """Return which device a file is, links followed; None if it is not one, or gone."""
    try:
        status = file.stat()
    except OSError:
        return None
    if not status.st_rdev:
        return None
    # Major device numbers of pseudo-terminals; Documentation/admin-guide/devices.txt of Linux.
    pseudo = os.major(status.st_rdev) in range(136, 144)
    return _Device(status.st_rdev, status.st_dev if pseudo else None)


def _files(process: Path) -> Iterator[Path]:
    try:
        yield from (process / "fd").iterdir()
    except OSError:
        return  # it has ended, or is another user's


def _has_other_end(process: Path, device: str) -> bool:
    """Return whether a process has the other end of a pseudo-terminal of this number open."""
    index = f"tty-index:\t{PurePosixPath(device).name}"
    return any(index in _text(process / "fdinfo" / file.name) for file in _files(process))


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
