"""The SDK's port made usable: whom it lets in, what is wrong with a device, how it waits."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from described import AX

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.port import latency_advice
from adaptive_contact.errors import BusError
from adaptive_contact.robot import Port


@pytest.mark.parametrize(
    ("device", "baud", "words"),
    [
        ("/nowhere/x", 57_600, r"port legs: /nowhere/x does not exist; .* plug"),
        (__file__, 57_600, "no serial port"),
        ("p0", -1, r"cannot be opened .* baudrate"),
    ],
)
def test_a_device_that_cannot_be(
    rig: Callable, tmp_path: Path, device: str, baud: int, words: str
) -> None:
    rig(**AX)
    with pytest.raises(BusError, match=words):
        Bus("legs", Port(device=str(tmp_path / device), baud=baud)).open()


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import serial

    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(13, "could not open port: Permission denied")

    monkeypatch.setattr("serial.Serial", refuse)
    with pytest.raises(BusError, match="dialout"):
        Bus("legs", Port(device="/dev/ttyX")).open()


def test_a_port_in_use(rig: Callable, opened: Callable) -> None:
    r = rig(**AX)
    first = opened(r)
    with pytest.raises(BusError, match="in use by another program"):
        opened(r)
    first.close()


def test_a_port_that_other_software_uses_without_a_lock(
    rig: Callable, opened: Callable, program: Callable[..., Any]
) -> None:
    """The SDK as it comes, in a process of its own: it locks nothing."""
    r = rig(**AX)
    device = r.plans[0].port.device
    script = (
        "import signal, dynamixel_sdk as sdk\n"
        f"port = sdk.PortHandler({device!r}); port.setBaudRate(1000000)\n"
        "print('open'); signal.pause()"
    )
    other = program("-c", script)
    other.wait_line("open")
    with pytest.raises(BusError, match=rf"in use by python\S* \(process {other.process.pid}\)"):
        opened(r)
    other.close()
    opened(r).close()


def test_an_open_port_is_closed_to_others(
    rig: Callable, opened: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    r = rig(**AX)
    monkeypatch.setattr("adaptive_contact.bridge.port.is_pseudo", lambda _: False)

    def closed_to_others() -> bool:
        try:
            other = os.open(r.port.path, os.O_RDWR | os.O_NOCTTY)
        except OSError as error:
            return error.errno == errno.EBUSY
        flag = bytearray(4)  # the superuser gets in
        fcntl.ioctl(other, 0x80045440, flag)  # TIOCGEXCL
        os.close(other)
        return flag[0] == 1

    bus = opened(r)
    assert closed_to_others()
    bus.close()
    assert not closed_to_others()


@pytest.mark.parametrize(("timer", "told"), [("16", True), ("1", False), ("?", False)])
def test_an_adapter_that_holds_bytes_back_is_told_of(
    tmp_path: Path, timer: str, told: bool
) -> None:
    (tmp_path / "ttyUSB7").mkdir()
    (tmp_path / "ttyUSB7" / "latency_timer").write_text(f"{timer}\n")
    (tmp_path / "by-id").symlink_to("/dev/ttyUSB7")
    advice = latency_advice(str(tmp_path / "by-id"), tmp_path)
    assert (advice is not None) is told
    if advice is not None:
        assert "latency timer is 16 ms, expected 1; run: echo 1 | sudo tee" in advice
        assert advice.endswith("ttyUSB7/latency_timer")
    assert latency_advice("/dev/ttyACM0", tmp_path) is None


def test_reading_sleeps_instead_of_spinning(rig: Callable, opened: Callable) -> None:
    r = rig(**AX)
    bus = opened(r)
    r.fault("silent:")
    model, bus.timeout_ms = r.plans[0].joints[0].model, r.plans[0].port.timeout_ms
    cpu, wall = time.thread_time(), time.monotonic()
    for _ in range(40):
        bus.read([1], model.goal_and_motion)
    cpu, wall = time.thread_time() - cpu, time.monotonic() - wall
    assert wall > 40 * 0.005
    assert cpu < 0.35 * wall
