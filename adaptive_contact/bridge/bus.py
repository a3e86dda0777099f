"""Reads and writes a Dynamixel bus over the DynamixelSDK, with a result per servo.

What the SDK's packet handlers get wrong (docs/bridge.md lists it) is worked around here: packets
are taken one by one, and the length that each gives is checked.  AX servos know no sync read: each
is read by itself, and all are written with one sync write.
"""

from __future__ import annotations

import enum
import math
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any, Final, NamedTuple, TypeVar

from dynamixel_sdk import COMM_SUCCESS, COMM_TX_FAIL, PacketHandler

from adaptive_contact.bridge.packets import (
    BROADCAST_ID,
    MAX_ID,
    Awaited,
    Codec,
    Instruction,
    alarm_names,
    split_fast_sync,
    unsent,
)
from adaptive_contact.bridge.port import SdkPort
from adaptive_contact.bridge.tables import Block, Register
from adaptive_contact.errors import BusError
from adaptive_contact.robot import Port

T = TypeVar("T")

_TIMEOUT: Final = -3001
# The same in every control table.
MODEL_NUMBER: Final = Block(0, 2)
# For what has to succeed, outside the cycle.
_TRIES: Final = 4
# Answers that came too late are waited for longer: twice as long each time, up to this.
MOST_PATIENT_MS: Final = 400.0
# Of so many reads, so many garbled ones are no accident.
_LOOKS, _GARBLED = 5, 3
# What an answer takes at the least, with some wire and a computer in between.
_ASK_S: Final = 0.0005
# Offsets in the SDK's list of a status packet's bytes, protocol 2.0: FF FF FD 00 id len len 55 err;
# of 1.0: FF FF id len err.
_ID2, _LENGTH2, _ERROR2, _DATA2 = 4, 5, 8, 9
_ID1, _LENGTH1, _ERROR1, _DATA1 = 2, 3, 4, 5


class Fault(enum.StrEnum):
    """Why a servo's reading is missing."""

    NO_ANSWER = "no_answer"
    CORRUPT = "corrupt"
    REFUSED = "refused"


class Reading(NamedTuple):
    """What came of a read."""

    data: bytes | None  # the block's bytes, None with a fault
    alarms: tuple[str, ...] = ()  # names of the error bits
    fault: Fault | None = None  # what went wrong
    # at_s, till_s: monotonic times at which the servo was asked and had answered; the reading is of
    # a moment between the two
    at_s: float = 0.0
    till_s: float = 0.0


class Pong(NamedTuple):
    """A servo that answered a ping."""

    model_number: int | None  # None where neither a ping (of protocol 2.0) nor a read gives it
    doubled: bool = False  # several seem to answer
    reads: bool = True  # it answers reads; at a status return level of 0 it does not
    brand: str | None = None  # what it is in words, where that is no Dynamixel


class Bus:
    """One port of ``robot.toml`` and the servos on it.  Not for several threads at once.

    Attributes:
        late: answers that came after they were waited for, by servo.
    """

    def __init__(self, name: str, port: Port) -> None:
        self.name, self.device = name, port.device
        self.protocol = port.protocol
        self._fast = port.fast
        self._port = SdkPort(name, port)
        self._packets: Any = PacketHandler(float(port.protocol))
        self._codec = Codec(port.protocol)
        # Before 3.8 the SDK knows no fast sync read, and its calls take one argument less.
        self._knows_fast = "fast_option" in signature(self._packets.rxPacket).parameters
        self._slow = (False,) if self._knows_fast else ()
        self._awaited = Awaited()
        self.late = self._awaited.late
        self._late_known = 0

    @property
    def timeout_ms(self) -> float:
        """How long an answer may take beyond its bytes."""
        return self._port.timeout_ms

    @timeout_ms.setter
    def timeout_ms(self, value: float) -> None:
        self._port.timeout_ms = value

    def open(self) -> None:
        """Open the port.

        Raises:
            BusError: it cannot be opened; one line, with what to do.
        """
        if self._fast and not self._knows_fast:
            raise BusError(
                f"port {self.name}: fast needs dynamixel-sdk 3.8 or newer; update it, or "
                f"remove fast from [port.{self.name}]"
            )
        self._port.open()

    def close(self) -> None:
        """Close the port; nothing is written."""
        self._port.close()

    def ping(self, servo: int) -> Pong | None:
        """Ask a servo who it is; None without an answer.

        Raises:
            PortLostError: the port is gone.
        """
        return self._guarded(lambda: self._ping(servo))

    def answering(self, servos: Sequence[int], quiet_ms: float) -> list[int]:
        """Return which servos answer a ping, in time or by ``quiet_ms`` after the last question.

        Raises:
            PortLostError: the port is gone.
        """
        here = self._guarded(lambda: [s for s in servos if self._ping_alone(s)[0] == COMM_SUCCESS])
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

        def work() -> dict[int, Reading]:
            found: dict[int, Reading] = {}
            garbled = False
            if self.protocol == 2 and len(servos) > 1:
                found, garbled = self._sync_read(servos, wide)
            for servo in servos:
                first = found.get(servo)
                if first is None:
                    if time.monotonic() > end - _ASK_S:
                        if garbled:
                            found[servo] = Reading(None, (), Fault.CORRUPT)
                        continue
                    # Missing in the common answer, or protocol 1: ask it alone.
                    first = found[servo] = self._read_one(servo, wide)
                    if garbled and first.fault is None:
                        # What came for all held more than was understood: this one's, it seems.
                        found[servo] = first._replace(fault=Fault.CORRUPT)
                        continue
                if first.fault is Fault.CORRUPT and time.monotonic() < until:
                    again = self._read_one(servo, wide)
                    if again.fault is None:
                        # The fault is reported, the reading is good.
                        found[servo] = again._replace(fault=Fault.CORRUPT)
            return {servo: _cut(reading, block, wide) for servo, reading in found.items()}

        self._port.latest_s = end
        try:
            return self._guarded(work)
        finally:
            self._port.latest_s = math.inf

    def is_clear(self, servo: int, block: Block) -> bool:
        """Whether a servo can be understood; not where several of one id talk at once.

        It is asked again on a quiet line before it is denied.

        Servos that are alike answer to a ping bit for bit the same, at the same moment; what they
        measure differs, and on the wire their answers then garble each other, again and again.
        """
        for _ in range(2):
            faults = [answer.fault for answer in self.ask_often(servo, block)]
            if faults.count(Fault.CORRUPT) < _GARBLED:
                return True
            self.settle()
        return False

    def ask_often(self, servo: int, block: Block) -> list[Reading]:
        """Ask a servo for registers some times in a row."""
        return [self._ask(servo, block) for _ in range(_LOOKS)]

    def settle(self, quiet_ms: float = 100.0) -> None:
        """Wait until nothing arrives any more, outside the cycle.

        Where answers have come too late since the last time, it waits longer for all from now on.

        Args:
            quiet_ms: how long nothing has to arrive.

        Raises:
            PortLostError: the port is gone.
        """

        def work() -> None:
            # What arrives is waited out for so long at the most, before something is asked again.
            end = time.monotonic() + 0.5
            while time.monotonic() < end:
                self._port.setPacketTimeoutMillis(quiet_ms)
                if not self._port.readPort(256):
                    return
                self._count_late()

        self._guarded(work)
        late, self._late_known = self._late_known, self.late.total()
        if self._late_known > late:
            self.timeout_ms = max(self.timeout_ms, min(2.0 * self.timeout_ms, MOST_PATIENT_MS))

    def confirmed(self, servo: int, block: Block) -> bytes | None:
        """Bytes of registers that stay as they are: two answers in a row agree on them.

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
        """How long a servo's answer to a read takes, about, in a common one or alone."""
        # Bytes of a status packet around its data, protocol 2.0's; 1.0 has fewer.
        return _ASK_S + (block.size + 11) * self._port.byte_s

    def get(self, servo: int, register: Register) -> int | None:
        """One register's value, None if the servo does not send it within some tries."""
        for _ in range(_TRIES):
            if (data := self._ask(servo, register.block).data) is not None:
                return register.value(data)
        return None

    def put(self, servo: int, register: Register, value: int) -> bool:
        """Write one register; True when the servo holds the value after.

        A confirmation says little: a locked EEPROM may have one, an alarm sets its error bits.
        """
        data = list(value.to_bytes(register.size, "little", signed=register.signed))
        for _ in range(_TRIES):
            self._guarded(
                lambda: self._exchange(servo, Instruction.WRITE, 0, [register.address], data)
            )
            now = self._ask(servo, register.block).data
            if now is not None and register.value(now) == value:
                return True
            self.settle()
        return False

    def put_all(self, register: Register, values: Mapping[int, int]) -> bool:
        """Write one register of several servos with one sync write, which has no answer."""
        if not values:
            return True
        parameters: list[int] = []
        for servo, value in values.items():
            parameters.append(servo)
            parameters += value.to_bytes(register.size, "little", signed=register.signed)
        result = self._guarded(
            lambda: self._packets.syncWriteTxOnly(
                self._port, register.address, register.size, parameters, len(parameters)
            )
        )
        return bool(result == COMM_SUCCESS)

    def _guarded(self, work: Callable[[], T]) -> T:
        """Run a transaction; an error of the device closes the port.

        ``is_using`` is cleared before: a transaction that raised would otherwise block all others.
        """
        if not self._port.is_open:
            raise self._port.lost(OSError("closed"))
        self._port.is_using = False
        try:
            return work()
        except BlockingIOError:
            # What is written is not taken: the other end stands still, as good as gone.
            raise self._port.lost(OSError("nothing can be written")) from None
        except (OSError, termios.error, ValueError, TypeError) as error:
            # pyserial raises TypeError where a port was closed under it.
            raise self._port.lost(error) from error

    def _ask(self, servo: int, block: Block) -> Reading:
        """Ask one servo for registers, in a transaction of its own."""
        wide = self._apart([servo], block)
        return self._guarded(lambda: _cut(self._read_one(servo, wide), block, wide))

    def _apart(self, servos: Sequence[int], block: Block) -> Block:
        """The registers, and as many more that no answer still to come has so many bytes."""
        more = self._awaited.unlike(servos, block.size, time.monotonic()) - block.size
        before = min(more, block.address)  # some tables end with a register that is read
        return Block(block.address - before, block.size + more)

    def _ping(self, servo: int) -> Pong | None:
        result, number = self._ping_alone(servo)
        if result not in (COMM_SUCCESS, _TIMEOUT, COMM_TX_FAIL):
            # Two servos that talk at once garble each other; once may be noise.
            result, number = self._ping_alone(servo)
            if result not in (COMM_SUCCESS, _TIMEOUT):
                return Pong(None, doubled=True, reads=False)
        if result != COMM_SUCCESS:
            return None
        # Bytes that follow an answer are of another servo of the same id, a little slower.
        self._port.setPacketTimeout(0)
        doubled = len(self._port.readPort(1)) > 0
        for _ in range(_TRIES):
            data = self._ask(servo, MODEL_NUMBER).data
            if data is not None:
                return Pong(int.from_bytes(data, "little"), doubled)
        return Pong(number, doubled, reads=False)

    def _drain(self) -> None:
        """Throw away what arrived too late, and count whose it was."""
        self._port.clearPort()
        self._count_late()

    def _count_late(self, asked: int | None = None) -> None:
        """Count answers to earlier questions among what has arrived, but for those of ``asked``."""
        # The beginning of a packet stays until the rest of it has come.
        for frame in self._codec.parse(self._port.arrived)[0]:
            if frame.id != asked and (self.protocol == 1 or frame.code == Instruction.STATUS):
                size = len(frame.parameters) + 1 - self.protocol
                self._awaited.strike(frame.id, size, late=True)

    def _ping_alone(self, servo: int) -> tuple[int, int | None]:
        """Ping and nothing else: the SDK's own reads the model too, and hides what failed.

        Returns:
            The SDK's result, and the model number where the answer holds it (protocol 2.0).
        """
        # Data of an answer to a ping, by protocol.
        answer, result = self._exchange(servo, Instruction.PING, {1: 0, 2: 3}[self.protocol])
        payload = self._data(answer) if result == COMM_SUCCESS else ()
        number = payload[0] + (payload[1] << 8) if len(payload) >= MODEL_NUMBER.size else None
        return int(result), number

    def _exchange(
        self,
        servo: int,
        instruction: Instruction,
        size: int,
        words: Sequence[int] = (),
        data: Sequence[int] = (),
    ) -> tuple[Sequence[int], int]:
        """Send an instruction, and wait for the answer to it, which has so many bytes of data.

        Returns:
            The status packet, and the SDK's result.
        """
        self._drain()
        packet = unsent(self.protocol, servo, instruction, words, data)
        self._awaited.ask(servo, size, time.monotonic())
        answer, result, _ = self._packets.txRxPacket(self._port, packet)
        while result == COMM_SUCCESS and self._is_late(servo, answer, size):
            answer, result = self._packets.rxPacket(self._port, *self._slow)
        self._count_late(servo)
        return answer, result

    def _read_one(self, servo: int, block: Block) -> Reading:
        at_s = time.monotonic()
        answer, result = self._exchange(servo, Instruction.READ, block.size, block)
        if result != COMM_SUCCESS:
            return Reading(None, (), Fault.NO_ANSWER if result == _TIMEOUT else Fault.CORRUPT)
        error = answer[_ERROR1 if self.protocol == 1 else _ERROR2]
        return self._reading(self._data(answer), error, block, at_s)

    def _is_late(self, servo: int, packet: Sequence[int], wanted: int) -> bool:
        """Whether a packet is another servo's, or answers an earlier question than the last."""
        if packet[_ID1 if self.protocol == 1 else _ID2] != servo:
            return True
        size = len(self._data(packet))
        if not self._awaited.strike(servo, size, late=size != wanted):
            if not size:  # it refuses
                self._awaited.strike(servo, wanted)
            return False
        return size != wanted

    def _data(self, packet: Sequence[int]) -> Sequence[int]:
        """A status packet's data.  Unstuffing leaves its spare bytes at the end: cut to size."""
        if self.protocol == 1:
            return packet[_DATA1 : _DATA1 + packet[_LENGTH1] - 2]
        size = packet[_LENGTH2] + (packet[_LENGTH2 + 1] << 8) - 4
        return packet[_DATA2 : _DATA2 + size]

    def _reading(self, data: Sequence[int], error: int, block: Block, at_s: float) -> Reading:
        alarms = alarm_names(self.protocol, error)
        if len(data) != block.size:
            if data or not error:
                # No answer to this: another master's packet, in which protocol 1.0's instruction
                # stands where an answer has its error bits, or what it was answered.
                return Reading(None, (), Fault.CORRUPT)
            return Reading(None, alarms, Fault.REFUSED)
        return Reading(bytes(data), alarms, None, at_s, time.monotonic())

    def _sync_read(self, servos: Sequence[int], block: Block) -> tuple[dict[int, Reading], bool]:
        """One question to all.

        Returns:
            What was understood, and whether more came than that: the SDK drops packets with a
            wrong checksum, or a broken header, without a word.
        """
        found: dict[int, Reading] = {}
        self._drain()
        at_s = time.monotonic()
        fast = (True,) if self._fast else self._slow
        result = self._packets.syncReadTx(self._port, *block, list(servos), len(servos), *fast)
        for servo in servos:
            self._awaited.ask(servo, block.size, at_s)
        if result != COMM_SUCCESS:
            return found, False
        before, understood = self._port.received, 0
        if self._fast:
            self._port.is_using = True
            packet, result = self._packets.rxPacket(self._port, True)
            if result == COMM_SUCCESS and packet[_ID2] == BROADCAST_ID:
                answers = split_fast_sync(bytes(packet[_ERROR2:-2]), block.size)
                # One that was cut short would put all after it off their places.
                if [answer.id for answer in answers] == list(servos):
                    understood += len(packet)
                    for answer in answers:
                        self._awaited.strike(answer.id, block.size)
                        found[answer.id] = self._reading(answer.data, answer.error, block, at_s)
            return found, self._port.received - before > understood
        while len(found) < len(servos):
            packet, result = self._packets.rxPacket(self._port, *self._slow)
            if result == _TIMEOUT:
                break
            if result != COMM_SUCCESS:
                continue
            understood += len(packet)
            servo = packet[_ID2]
            if servo not in servos or servo > MAX_ID or packet[7] != Instruction.STATUS:
                continue
            if not self._is_late(servo, packet, block.size):
                found[servo] = self._reading(self._data(packet), packet[_ERROR2], block, at_s)
        return found, self._port.received - before > understood


def _cut(reading: Reading, block: Block, wide: Block) -> Reading:
    """A reading of registers, out of one of more."""
    at = block.address - wide.address
    data = reading.data
    return reading._replace(data=None if data is None else data[at : at + block.size])
