"""A pseudo-terminal with servos behind it: packets in, answers out, each at its time.

A port's path is a symbolic link, so that it stays the same when a hang-up gives it another
pseudo-terminal.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import pty
import termios
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from adaptive_contact.bridge.packets import (
    BROADCAST_ID,
    Codec,
    Frame,
    Instruction,
    Status,
    fast_sync_status,
    version_of,
)
from adaptive_contact.robot.description import Protocol
from adaptive_contact_sim.virtual.faults import FaultSchedule
from adaptive_contact_sim.virtual.servo import BAUDS, Refusal, VirtualServo

_INSTRUCTION_ERROR: Final[dict[Protocol, int]] = {1: 0x40, 2: 0x02}
# Terminals' constants of rates.
_SPEEDS: Final = {
    baud: s for baud in BAUDS if (s := getattr(termios, f"B{baud}", None)) is not None
}


class _Answer(NamedTuple):
    """A packet on its way: when it is through, and when it would have been without faults."""

    packet: bytes
    due_s: float
    free_s: float


class VirtualPort:
    """One bus: a pseudo-terminal and its servos.

    Args:
        name: as in ``robot.toml``.
        path: of the link that masters open.
        servos: on this bus; two of the same id answer both, at once: the wire shows 0 where one of
            them does.
        faults: what goes wrong.
        baud: of the wire, for the time that packets take.
        wire_time: let answers take as long as on a wire of this baud rate.
    """

    def __init__(
        self,
        name: str,
        path: Path,
        servos: Sequence[VirtualServo],
        faults: FaultSchedule,
        *,
        baud: int = 1_000_000,
        wire_time: bool = False,
    ) -> None:
        self.name = name
        self.path = path
        self.servos = tuple(servos)
        self.faults = faults
        self.requests = 0
        self.master = -1
        self._slave = -1
        self._byte_s = 10 / baud if wire_time else 0.0
        self._wire_time = wire_time
        self._listening = self.servos
        self._protocol = servos[0].model.protocol if servos else 1
        self._codec = Codec(version_of(self._protocol))
        self._buffer = bytearray()
        self._replies: list[tuple[float, int, bytes]] = []
        self._sent = 0

    @property
    def is_up(self) -> bool:
        """Whether there is a terminal to open."""
        return self.master >= 0

    def open(self) -> None:
        """Make the pseudo-terminal and its link."""
        self.master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        part = self.path.with_name(self.path.name + ".part")
        with contextlib.suppress(FileNotFoundError):
            part.unlink()
        part.symlink_to(os.ttyname(self._slave))
        part.replace(self.path)
        self._buffer.clear()
        self._replies.clear()

    def close(self) -> None:
        """Hang up: the link is gone, and who has the terminal open sees the end of it."""
        with contextlib.suppress(OSError):
            if self.path.readlink() == Path(os.ttyname(self._slave)):  # no other port's by now
                self.path.unlink()
        for descriptor in (self.master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self.master = self._slave = -1

    def receive(self, now_s: float, elapsed_s: float) -> None:
        """Take what has come and answer it."""
        try:
            data = os.read(self.master, 4096)
        except (BlockingIOError, InterruptedError):
            return
        speed = termios.tcgetattr(self._slave)[4]
        # At another baud rate, packets are noise.
        self._listening = tuple(servo for servo in self.servos if _SPEEDS.get(servo.baud) == speed)
        if not self._listening:
            return
        self._buffer += data
        for frame in self._codec.parse(self._buffer):
            self.requests += 1
            arrival_s = len(data) * self._byte_s
            self._answer(frame, now_s + arrival_s, elapsed_s)

    def flush(self, now_s: float) -> float:
        """Send replies that are due.

        Returns:
            When the next is due, infinity without any.
        """
        while self._replies and self._replies[0][0] <= now_s:
            packet = heapq.heappop(self._replies)[2]
            with contextlib.suppress(BlockingIOError):  # no reader: as on a wire, it is lost
                os.write(self.master, packet)
        return self._replies[0][0] if self._replies else float("inf")

    # -- private -------------------------------------------------------------------------------

    def _answer(self, frame: Frame, now_s: float, elapsed_s: float) -> None:
        fast = self._protocol == 2 and frame.code == Instruction.FAST_SYNC_READ
        if fast or (self._protocol in (2, "sts") and frame.code == Instruction.SYNC_READ):
            self._read_many(frame, now_s, elapsed_s)
            return
        if frame.code == Instruction.SYNC_WRITE:
            self._sync_write(frame)
            return
        everyone = frame.id == BROADCAST_ID
        answers = []
        for servo in self._listening:
            if not everyone and servo.id != frame.id:
                address = _number(frame.parameters[:2])
                if frame.code == Instruction.WRITE and servo.follows(frame.id, address):
                    servo.write(address, frame.parameters[2:])
                continue
            # It answers as it was when asked: a new id or baud rate counts from then on.
            replies = servo.answers == 2 or frame.code == Instruction.PING
            replies |= servo.answers == 1 and frame.code == Instruction.READ
            status = self._execute(servo, frame, elapsed_s)
            if everyone:
                replies = self._protocol in (2, "sts") and frame.code == Instruction.PING
            if status is None or not replies:
                continue
            if self.faults.strike("silent", status.id, elapsed_s) is not None:
                continue
            answers.append(self._answer_of(servo, status, now_s, elapsed_s))
            if everyone:  # one after the other
                now_s = self._send_all([answers.pop()])
        self._send_all(answers)

    def _execute(self, servo: VirtualServo, frame: Frame, elapsed_s: float) -> Status | None:
        """Carry out an instruction; None for those without an answer."""
        version, p = self._codec.version, frame.parameters
        width = version  # bytes of an address and of a length
        if frame.code == Instruction.PING:
            if version == 1:
                return Status(servo.id, 0, b"")
            about = servo.model.number.to_bytes(2, "little") + bytes((servo.value("firmware"),))
            return Status(servo.id, 0, about)
        if frame.code == Instruction.READ and len(p) == 2 * width:
            return self._read_out(servo, _number(p[:width]), _number(p[width:]), elapsed_s)
        if frame.code == Instruction.WRITE and len(p) > width:
            own = servo.id  # a new one counts from the next packet on
            refusal = servo.write(_number(p[:width]), p[width:])
            return Status(own, 0 if refusal is None else refusal.error, b"")
        if frame.code == Instruction.REBOOT and version == 2:
            servo.reboot()
            return Status(servo.id, 0, b"")
        return Status(servo.id, _INSTRUCTION_ERROR.get(self._protocol, 0), b"")

    def _sync_write(self, frame: Frame) -> None:
        p, width = frame.parameters, self._codec.version
        address, size = _number(p[:width]), _number(p[width : 2 * width])
        rows = p[2 * width :]
        for at in range(0, len(rows) - size, size + 1):
            for servo in self._listening:
                if servo.id == rows[at] or servo.follows(rows[at], address):
                    servo.write(address, rows[at + 1 : at + 1 + size])

    def _read_many(self, frame: Frame, now_s: float, elapsed_s: float) -> None:
        """Sync and fast sync read: servos answer one after the other."""
        p, width = frame.parameters, self._codec.version
        address, size = _number(p[:width]), _number(p[width : 2 * width])
        joint: list[tuple[VirtualServo, Status]] = []
        for wanted in p[2 * width :]:
            group = [servo for servo in self._listening if servo.id == wanted and servo.answers]
            if not group or self.faults.strike("silent", wanted, elapsed_s) is not None:
                # Each waits for the one before it: those after a mute one stay mute.
                return
            statuses = [(s, self._read_out(s, address, size, elapsed_s)) for s in group]
            if frame.code == Instruction.FAST_SYNC_READ:  # the first of one id is heard
                servo, status = statuses[0]
                joint.append((servo, self._troubled(servo, status, elapsed_s)))
            else:
                answers = [self._answer_of(s, status, now_s, elapsed_s) for s, status in statuses]
                now_s = self._send_all(answers)
        if joint:
            packet = fast_sync_status([status for _, status in joint])
            due_s = now_s + self._spent(joint[0][0], packet)
            ids = [servo.id for servo, _ in joint]
            self._send(*self._spoiled(ids, packet, due_s, elapsed_s))

    def _read_out(self, servo: VirtualServo, address: int, size: int, elapsed_s: float) -> Status:
        """What a servo answers to a read."""
        old, data = servo.last, servo.read(address, size)
        if isinstance(data, Refusal):
            return Status(servo.id, data.error, b"")
        if self.faults.strike("stale", servo.id, elapsed_s):
            servo.last, data = old, old[address : address + size]
        return Status(servo.id, 0, data)

    def _spoiled(
        self, ids: Sequence[int], packet: bytes, due_s: float, elapsed_s: float
    ) -> tuple[bytes, float]:
        """A packet of these servos as it comes, and when: flipped, late."""
        if any(self.faults.strike("flip", servo, elapsed_s) for servo in ids):
            packet = self.faults.flip(packet)
        late = [self.faults.strike("late", servo, elapsed_s) for servo in ids]
        return packet, due_s + max((x.ms for x in late if x is not None), default=0.0) / 1000.0

    def _troubled(self, servo: VirtualServo, status: Status, elapsed_s: float) -> Status:
        """A status as faults make it: with error bits."""
        spec = self.faults.strike("error", servo.id, elapsed_s)
        alert = servo.set_errors(0 if spec is None else spec.error(servo.model))
        if servo.model.protocol == 2:
            alert = 0x80 if alert else 0
        return status._replace(error=status.error | alert)

    def _answer_of(
        self, servo: VirtualServo, status: Status, now_s: float, elapsed_s: float
    ) -> _Answer:
        status = self._troubled(servo, status, elapsed_s)
        packet = self._codec.status(status.id, status.error, status.data)
        free_s = now_s + self._spent(servo, packet)
        packet, due_s = self._spoiled([servo.id], packet, free_s, elapsed_s)
        return _Answer(packet, due_s, free_s)

    def _send_all(self, answers: Sequence[_Answer]) -> float:
        """Queue what servos say at once; returns when the bus is free again."""
        merged: list[_Answer] = []
        for answer in sorted(answers, key=lambda a: a.due_s):
            begins_s = answer.due_s - len(answer.packet) * self._byte_s
            if merged and begins_s <= merged[-1].due_s:
                before = merged.pop()
                answer = answer._replace(packet=_overlap(before.packet, answer.packet))
            merged.append(answer)
        for answer in merged:
            self._send(answer.packet, answer.due_s)
        return max((answer.free_s for answer in merged), default=0.0)

    def _spent(self, servo: VirtualServo, packet: bytes) -> float:
        if not self._wire_time:
            return 0.0
        return servo.value("return_delay") * 2e-6 + len(packet) * self._byte_s

    def _send(self, packet: bytes, due_s: float) -> None:
        self._sent += 1
        heapq.heappush(self._replies, (due_s, self._sent, packet))


def _overlap(one: bytes, other: bytes) -> bytes:
    """Two packets on the wire at once: a 0 of either pulls it to 0."""
    short, long = sorted((one, other), key=len)
    return bytes(a & b for a, b in zip(short, long, strict=False)) + long[len(short) :]


def _number(data: bytes) -> int:
    return int.from_bytes(data, "little")
