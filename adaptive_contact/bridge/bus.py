"""Reads and writes a bus of servos, with a result per servo.

A question is sent, and whatever comes is parsed until it is answered or time is up: an answer to
an earlier question is counted as late, and never taken.  AX servos and Feetech's SCS series know
no sync read: each is read by itself, and all are written with one sync write.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Final, Literal, NamedTuple

from adaptive_contact.bridge.packets import (
    BROADCAST_ID,
    Awaited,
    Codec,
    Instruction,
    Status,
    alarm_names,
    split_fast_sync,
    version_of,
)
from adaptive_contact.bridge.port import SerialPort
from adaptive_contact.bridge.tables import MODEL_NUMBERS, Block, Register
from adaptive_contact.robot import Port

# For what has to succeed, outside the cycle.
_TRIES: Final = 4
# Answers that came too late are waited for longer: twice as long each time, up to this.
MOST_PATIENT_MS: Final = 400.0
# Of so many reads, so many garbled ones are no accident.
_LOOKS, _GARBLED = 5, 3
# What an answer takes at the least, with some wire and a computer in between.
_ASK_S: Final = 0.0005

# Why a servo's reading is missing.
Fault = Literal["no_answer", "corrupt", "refused"]


class Reading(NamedTuple):
    """Holds the result of a read."""

    data: bytes | None  # the block's bytes, None with a fault
    alarms: tuple[str, ...] = ()  # names of the error bits
    fault: Fault | None = None  # what went wrong
    # at_s, till_s: monotonic times at which the servo was asked and had answered; the reading is of
    # a moment between the two
    at_s: float = 0.0
    till_s: float = 0.0


class Pong(NamedTuple):
    """Holds a servo's answer to a ping."""

    model_number: int | None  # None where neither a ping (of protocol 2.0) nor a read gives it
    doubled: bool = False  # several seem to answer
    reads: bool = True  # it answers reads; at a status return level of 0 it does not


class Bus:
    """Talks to one port of ``robot.toml`` and the servos on it.  Not for several threads at once.

    Attributes:
        port: how it is opened, and how long an answer may take.
        late: answers that came after they were waited for, by servo.
        model_number: where servos of its protocol have it.
    """

    def __init__(self, name: str, port: Port) -> None:
        self.name, self.device = name, port.device
        self.protocol = port.protocol
        self.model_number = MODEL_NUMBERS[port.protocol]
        self._common = Instruction.FAST_SYNC_READ if port.fast else Instruction.SYNC_READ
        self.port = SerialPort(name, port)
        self._codec = Codec(version_of(port.protocol))
        self._arrived = bytearray()
        self._end_s = math.inf
        self._awaited = Awaited()
        self.late = self._awaited.late
        self._late_known = 0

    def open(self) -> None:
        """Open the port.

        Raises:
            BusError: it cannot be opened; one line, with what to do.
            MissingExtraError: pyserial is not installed.
        """
        self.port.open()

    def close(self) -> None:
        """Close the port; nothing is written."""
        self.port.close()

    def ping(self, servo: int) -> Pong | None:
        """Ask a servo who it is; None without an answer.

        Raises:
            PortLostError: the port is gone.
        """
        answer, garbled = self._ping(servo)
        if answer is None and garbled:
            # Two servos that talk at once garble each other; once may be noise.
            answer, garbled = self._ping(servo)
            if answer is None and garbled:
                return Pong(None, doubled=True, reads=False)
        if answer is None:
            return None
        # Bytes that follow an answer are of another servo of the same id, a little slower.
        doubled = bool(self._arrived) or self._receive(time.monotonic() + self._patience_s)
        number = self.get(servo, self.model_number)
        if number is not None:
            return Pong(number, doubled)
        # An answer to a ping of protocol 2.0 holds it, too.
        told = int.from_bytes(answer[:2], "little") if answer else None
        return Pong(told, doubled, reads=False)

    def answering(self, servos: Sequence[int], quiet_ms: float) -> list[int]:
        """Return which servos answer a ping, in time or by ``quiet_ms`` after the last question.

        Raises:
            PortLostError: the port is gone.
        """
        here = [servo for servo in servos if self._ping(servo)[0] is not None]
        self.settle(quiet_ms)
        return [servo for servo in servos if servo in here or self.late[servo]]

    def read(
        self, servos: Sequence[int], block: Block, until: float = math.inf, end: float = math.inf
    ) -> dict[int, Reading]:
        """Read the same registers of several servos.

        Args:
            servos: ids.
            block: the registers.
            until: monotonic seconds after which nothing is tried a second time.
            end: monotonic seconds at which the wait for answers ends.

        Returns:
            A reading for every id that there was time to ask.

        Raises:
            PortLostError: the port is gone.
        """
        wide = self._apart(servos, block)
        self._end_s = end
        try:
            found = self._read_all(servos, wide, until)
        finally:
            self._end_s = math.inf
        return {servo: _cut(reading, block, wide) for servo, reading in found.items()}

    def is_clear(self, servo: int, block: Block) -> bool:
        """Return whether a servo can be understood; False where several of one id talk at once.

        It is asked again on a quiet line before it is denied.

        Servos that are alike answer to a ping bit for bit the same, at the same moment; what they
        measure differs, and on the wire their answers then garble each other, again and again.
        """
        for _ in range(2):
            faults = [self._ask(servo, block).fault for _ in range(_LOOKS)]
            if faults.count("corrupt") < _GARBLED:
                return True
            self.settle()
        return False

    def settle(self, quiet_ms: float = 100.0) -> None:
        """Wait until nothing arrives any more, outside the cycle.

        Where answers have come too late since the last time, it waits longer for all from now on.

        Args:
            quiet_ms: how long nothing has to arrive.

        Raises:
            PortLostError: the port is gone.
        """
        # What arrives is waited out for so long at the most, before something is asked again.
        end = time.monotonic() + 0.5
        while (now := time.monotonic()) < end and self._receive(now + quiet_ms / 1000.0):
            self._count_late()
        late, self._late_known = self._late_known, self.late.total()
        if self._late_known > late:
            now_ms = self.port.timeout_ms
            self.port.timeout_ms = max(now_ms, min(2.0 * now_ms, MOST_PATIENT_MS))

    def confirmed(self, servo: int, block: Block) -> bytes | None:
        """Read bytes of registers that stay as they are, until two answers in a row agree.

        Nothing is to be said against a servo for one answer.

        Returns:
            The bytes, or None where no two answers in some tries agree.
        """
        for _ in range(_TRIES):
            once, twice = (self._ask(servo, block).data for _ in range(2))
            if once is not None and twice == once:
                return once
            self.settle()
        return None

    def cost_s(self, block: Block) -> float:
        """Estimate how long a servo's answer to a read takes, s, in a common read or alone."""
        # Bytes of a status packet around its data, protocol 2.0's; 1.0 has fewer.
        return _ASK_S + (block.size + 11) * self.port.byte_s

    def get(self, servo: int, register: Register) -> int | None:
        """Read one register's value; None if the servo does not send it within some tries."""
        for _ in range(_TRIES):
            if (data := self._ask(servo, register.block).data) is not None:
                return register.value(data)
        return None

    def put(self, servo: int, register: Register, value: int) -> bool:
        """Write one register; True when the servo holds the value after.

        A confirmation says little: a locked EEPROM may have one, an alarm sets its error bits.
        """
        parameters = self._codec.words(register.address) + register.data(value)
        for _ in range(_TRIES):
            self._exchange([servo], Instruction.WRITE, 0, parameters)
            now = self._ask(servo, register.block).data
            if now is not None and register.value(now) == value:
                return True
            self.settle()
        return False

    def put_all(self, register: Register, values: Mapping[int, int]) -> None:
        """Write one register of several servos with one sync write, which has no answer."""
        if values:
            self._drain()
            rows = (bytes((servo,)) + register.data(value) for servo, value in values.items())
            parameters = self._codec.words(*register.block) + b"".join(rows)
            self.port.write(
                self._codec.instruction(BROADCAST_ID, Instruction.SYNC_WRITE, parameters)
            )

    @property
    def _patience_s(self) -> float:
        return self.port.timeout_ms / 1000.0

    def _ask(self, servo: int, block: Block) -> Reading:
        """Ask one servo for registers, in a transaction of its own."""
        wide = self._apart([servo], block)
        return _cut(self._read_one(servo, wide), block, wide)

    def _apart(self, servos: Sequence[int], block: Block) -> Block:
        """Widen a read until no answer still to come has as many bytes."""
        more = self._awaited.unlike(servos, block.size, time.monotonic()) - block.size
        before = min(more, block.address)  # some tables end with a register that is read
        return Block(block.address - before, block.size + more)

    def _ping(self, servo: int) -> tuple[bytes | None, bool]:
        """Ping a servo: the data of its answer, and whether what came was no answer."""
        # Of protocol 2.0: model number and firmware.
        size = 3 if self._codec.version == 2 else 0
        found, garbled = self._exchange([servo], Instruction.PING, size)
        answer = found.get(servo)
        return (None, garbled) if answer is None else (answer.data or b"", garbled)

    def _read_all(self, servos: Sequence[int], block: Block, until: float) -> dict[int, Reading]:
        found: dict[int, Reading] = {}
        garbled = False
        if self.protocol in (2, "sts") and len(servos) > 1:
            parameters = self._codec.words(*block) + bytes(servos)
            found, garbled = self._exchange(servos, self._common, block.size, parameters)
        for servo in servos:
            first = found.get(servo)
            if first is None:
                if time.monotonic() > self._end_s - _ASK_S:
                    if garbled:
                        found[servo] = Reading(None, (), "corrupt")
                    continue
                # Missing in the common answer, or there is none: ask it alone.
                first = found[servo] = self._read_one(servo, block)
                if garbled and first.fault is None:
                    # What came for all held more than was understood: this one's, it seems.
                    found[servo] = first._replace(fault="corrupt")
                    continue
            if first.fault == "corrupt" and time.monotonic() < until:
                again = self._read_one(servo, block)
                if again.fault is None:
                    # The fault is reported, the reading is good.
                    found[servo] = again._replace(fault="corrupt")
        return found

    def _read_one(self, servo: int, block: Block) -> Reading:
        parameters = self._codec.words(*block)
        found, garbled = self._exchange([servo], Instruction.READ, block.size, parameters)
        return found.get(servo, Reading(None, (), "corrupt" if garbled else "no_answer"))

    def _exchange(
        self, servos: Sequence[int], instruction: Instruction, size: int, parameters: bytes = b""
    ) -> tuple[dict[int, Reading], bool]:
        """Send an instruction to servos, and wait for their answers, of so many bytes of data.

        Returns:
            What was understood, by servo, and whether more came than that.
        """
        self._drain()
        codec, thrown = self._codec, self._codec.thrown
        common = instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ)
        packet = codec.instruction(BROADCAST_ID if common else servos[0], instruction, parameters)
        answer_bytes = codec.around + size
        at_s = time.monotonic()
        for servo in servos:
            self._awaited.ask(servo, size, at_s)
        self.port.write(packet)
        wire_s = (len(packet) + len(servos) * answer_bytes) * self.port.byte_s
        until_s = min(at_s + wire_s + self._patience_s, self._end_s)
        joint = servos if instruction == Instruction.FAST_SYNC_READ else ()
        found: dict[int, Reading] = {}
        while True:
            for status in self._statuses(joint, size):
                if self._answers(status, servos, size):
                    found[status.id] = self._reading(status, size, at_s)
                    if len(found) == len(servos):
                        return found, codec.thrown > thrown
            unclear = codec.thrown - thrown + len(self._arrived)
            # As many bytes as are missing have come, and are no answer: none is waited for.
            came = unclear >= (len(servos) - len(found)) * answer_bytes
            if came or not self._receive(until_s):
                return found, unclear > 0

    def _statuses(self, joint: Sequence[int] = (), size: int = 0) -> Iterator[Status]:
        """Take the servos' answers out of what has arrived.

        Args:
            joint: servos that answer a fast sync read together.
            size: bytes of data of each of these.
        """
        for frame in self._codec.parse(self._arrived):
            if self._codec.version == 1:
                yield Status(*frame)
            elif frame.code == Instruction.STATUS and frame.id == BROADCAST_ID:
                answers = split_fast_sync(frame.parameters, size)
                # One that was cut short would put all after it off their places.
                if [answer.id for answer in answers] == list(joint):
                    yield from answers
            elif frame.code == Instruction.STATUS and frame.parameters:
                yield Status(frame.id, frame.parameters[0], frame.parameters[1:])

    def _answers(self, status: Status, servos: Sequence[int], size: int) -> bool:
        """Return whether a status answers the question to these servos, and no earlier one."""
        asked, got = status.id in servos, len(status.data)
        if self._awaited.strike(status.id, got, late=not asked or got != size):
            return asked and got == size
        if asked and not got:  # it refuses
            self._awaited.strike(status.id, size)
        return asked

    def _receive(self, until_s: float) -> bool:
        """Wait until something has come, or time is up."""
        data = self.port.read(until_s)
        self._arrived += data
        return bool(data)

    def _drain(self) -> None:
        """Discard what arrived too late, and count whose it was."""
        self._arrived += self.port.drain()
        self._count_late()
        self._arrived.clear()

    def _count_late(self) -> None:
        for status in self._statuses():
            self._answers(status, (), 0)

    def _reading(self, status: Status, size: int, at_s: float) -> Reading:
        alarms = alarm_names(self.protocol, status.error)
        if len(status.data) == size:
            return Reading(status.data, alarms, None, at_s, time.monotonic())
        if status.data or not status.error:
            # No answer to this: another master's packet, in which protocol 1.0's instruction
            # stands where an answer has its error bits, or what it was answered.
            return Reading(None, (), "corrupt")
        return Reading(None, alarms, "refused")


def _cut(reading: Reading, block: Block, wide: Block) -> Reading:
    """Cut a reading of registers out of one of more."""
    at = block.address - wide.address
    data = reading.data
    return reading._replace(data=None if data is None else data[at : at + block.size])
