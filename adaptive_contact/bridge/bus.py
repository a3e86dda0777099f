"""Reads and writes a bus of servos over their maker's SDK, with a result per servo.

What the SDKs' packet handlers get wrong (docs/bridge.md lists it) is worked around here: packets
are taken one by one, and the length that each gives is checked.  AX servos and Feetech's SCS series
know no sync read: each is read by itself, and all are written with one sync write.
"""

from __future__ import annotations

import math
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any, Final, Literal, NamedTuple, TypeVar

from adaptive_contact.bridge.packets import (
    BROADCAST_ID,
    MAX_ID,
    Awaited,
    Codec,
    Instruction,
    alarm_names,
    split_fast_sync,
    unsent,
    version_of,
)
from adaptive_contact.bridge.port import SdkPort
from adaptive_contact.bridge.tables import MODEL_NUMBERS, Block, Register, is_feetech
from adaptive_contact.errors import BusError, needs
from adaptive_contact.robot import Port
from adaptive_contact.robot.description import Protocol

T = TypeVar("T")

# Of both SDKs.
_SUCCESS: Final = 0
# For what has to succeed, outside the cycle.
_TRIES: Final = 4
# Answers that came too late are waited for longer: twice as long each time, up to this.
MOST_PATIENT_MS: Final = 400.0
# Of so many reads, so many garbled ones are no accident.
_LOOKS, _GARBLED = 5, 3
# What an answer takes at the least, with some wire and a computer in between.
_ASK_S: Final = 0.0005


class _Places(NamedTuple):
    """Holds offsets in the SDKs' lists of a status packet's bytes."""

    id: int
    length: int
    error: int
    data: int


# FF FF id len err, and FF FF FD 00 id len len 55 err.
_PLACES: Final = {1: _Places(2, 3, 4, 5), 2: _Places(4, 5, 8, 9)}


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

    Raises:
        MissingExtraError: the maker's SDK is not installed.
    """

    def __init__(self, name: str, port: Port) -> None:
        self.name, self.device = name, port.device
        self.protocol = port.protocol
        self.model_number = MODEL_NUMBERS[port.protocol]
        self._fast = port.fast
        self.port = SdkPort(name, port)
        sdk = sdk_of(port.protocol)
        # Feetech's takes a byte order, on which nothing that is used here depends.
        self._packets: Any = sdk.PacketHandler(0 if is_feetech(port.protocol) else port.protocol)
        self._timeout: int = sdk.COMM_RX_TIMEOUT
        self._not_sent: int = sdk.COMM_TX_FAIL
        self._version = version_of(port.protocol)
        self._codec, self._at = Codec(self._version), _PLACES[self._version]
        # Before 3.8 the DynamixelSDK knows no fast sync read, and its calls take one argument less.
        self._knows_fast = "fast_option" in signature(self._packets.rxPacket).parameters
        self._slow = (False,) if self._knows_fast else ()
        self._awaited = Awaited()
        self.late = self._awaited.late
        self._late_known = 0

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
        self.port.open()

    def close(self) -> None:
        """Close the port; nothing is written."""
        self.port.close()

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
        here = self._guarded(lambda: [s for s in servos if self._ping_alone(s)[0] == _SUCCESS])
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

        def read_all() -> dict[int, Reading]:
            found: dict[int, Reading] = {}
            garbled = False
            if self.protocol in (2, "sts") and len(servos) > 1:
                found, garbled = self._sync_read(servos, wide)
            for servo in servos:
                first = found.get(servo)
                if first is None:
                    if time.monotonic() > end - _ASK_S:
                        if garbled:
                            found[servo] = Reading(None, (), "corrupt")
                        continue
                    # Missing in the common answer, or there is none: ask it alone.
                    first = found[servo] = self._read_one(servo, wide)
                    if garbled and first.fault is None:
                        # What came for all held more than was understood: this one's, it seems.
                        found[servo] = first._replace(fault="corrupt")
                        continue
                if first.fault == "corrupt" and time.monotonic() < until:
                    again = self._read_one(servo, wide)
                    if again.fault is None:
                        # The fault is reported, the reading is good.
                        found[servo] = again._replace(fault="corrupt")
            return {servo: _cut(reading, block, wide) for servo, reading in found.items()}

        self.port.latest_s = end
        try:
            return self._guarded(read_all)
        finally:
            self.port.latest_s = math.inf

    def is_clear(self, servo: int, block: Block) -> bool:
        """Return whether a servo can be understood; False where several of one id talk at once.

        It is asked again on a quiet line before it is denied.

        Servos that are alike answer to a ping bit for bit the same, at the same moment; what they
        measure differs, and on the wire their answers then garble each other, again and again.
        """
        for _ in range(2):
            faults = [self._read_alone(servo, block).fault for _ in range(_LOOKS)]
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

        def drain() -> None:
            # What arrives is waited out for so long at the most, before something is asked again.
            end = time.monotonic() + 0.5
            while time.monotonic() < end:
                self.port.setPacketTimeoutMillis(quiet_ms)
                if not self.port.readPort(256):
                    return
                self._count_late()

        self._guarded(drain)
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
            once, twice = (self._read_alone(servo, block).data for _ in range(2))
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
            if (data := self._read_alone(servo, register.block).data) is not None:
                return register.value(data)
        return None

    def write_register(self, servo: int, register: Register, value: int) -> bool:
        """Write one register; True if the servo holds the value afterwards.

        A confirmation says little: a locked EEPROM may have one, an alarm sets its error bits.
        """
        data = list(register.data(value))
        for _ in range(_TRIES):
            self._guarded(
                lambda: self._exchange(servo, Instruction.WRITE, 0, [register.address], data)
            )
            now = self._read_alone(servo, register.block).data
            if now is not None and register.value(now) == value:
                return True
            self.settle()
        return False

    def sync_write(self, register: Register, values: Mapping[int, int]) -> bool:
        """Write one register of several servos with one sync write, which has no answer."""
        if not values:
            return True
        parameters: list[int] = []
        for servo, value in values.items():
            parameters.append(servo)
            parameters += register.data(value)
        result = self._guarded(
            lambda: self._packets.syncWriteTxOnly(
                self.port, register.address, register.size, parameters, len(parameters)
            )
        )
        return bool(result == _SUCCESS)

    def _guarded(self, work: Callable[[], T]) -> T:
        """Run a transaction; an error of the device closes the port.

        ``is_using`` is cleared before: a transaction that raised would otherwise block all others.
        """
        if not self.port.is_open:
            raise self.port.lost(OSError("closed"))
        self.port.is_using = False
        try:
            return work()
        except BlockingIOError:
            # What is written is not taken: the other end stands still, as good as gone.
            raise self.port.lost(OSError("nothing can be written")) from None
        except (OSError, termios.error, ValueError, TypeError) as error:
            # pyserial raises TypeError where a port was closed under it.
            raise self.port.lost(error) from error

    def _read_alone(self, servo: int, block: Block) -> Reading:
        """Read registers of one servo, in a transaction of its own."""
        wide = self._apart([servo], block)
        return self._guarded(lambda: _cut(self._read_one(servo, wide), block, wide))

    def _apart(self, servos: Sequence[int], block: Block) -> Block:
        """Widen a read until no answer still to come has as many bytes."""
        more = self._awaited.unlike(servos, block.size, time.monotonic()) - block.size
        before = min(more, block.address)  # some tables end with a register that is read
        return Block(block.address - before, block.size + more)

    def _ping(self, servo: int) -> Pong | None:
        result, number = self._ping_alone(servo)
        if result not in (_SUCCESS, self._timeout, self._not_sent):
            # Two servos that talk at once garble each other; once may be noise.
            result, number = self._ping_alone(servo)
            if result not in (_SUCCESS, self._timeout):
                return Pong(None, doubled=True, reads=False)
        if result != _SUCCESS:
            return None
        # Bytes that follow an answer are of another servo of the same id, a little slower.
        self.port.setPacketTimeout(0)
        doubled = len(self.port.readPort(1)) > 0
        for _ in range(_TRIES):
            data = self._read_alone(servo, self.model_number.block).data
            if data is not None:
                return Pong(self.model_number.value(data), doubled)
        return Pong(number, doubled, reads=False)

    def _drain(self) -> None:
        """Discard what arrived too late, and count whose it was."""
        self.port.clearPort()
        self._count_late()

    def _count_late(self, asked: int | None = None) -> None:
        """Count answers to earlier questions among what has arrived, but for those of ``asked``."""
        # The beginning of a packet stays until the rest of it has come.
        for frame in self._codec.parse(self.port.arrived):
            if frame.id != asked and (self._version == 1 or frame.code == Instruction.STATUS):
                size = len(frame.parameters) + 1 - self._version
                self._awaited.strike(frame.id, size, late=True)

    def _ping_alone(self, servo: int) -> tuple[int, int | None]:
        """Ping and nothing else: the SDK's own reads the model too, and hides what failed.

        Returns:
            The SDK's result, and the model number where the answer holds it (protocol 2.0).
        """
        # Data of an answer to a ping, by version.
        answer, result = self._exchange(servo, Instruction.PING, {1: 0, 2: 3}[self._version])
        payload = self._data(answer) if result == _SUCCESS else ()
        number = payload[0] + (payload[1] << 8) if len(payload) >= 2 else None
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
        packet = unsent(self._version, servo, instruction, words, data)
        self._awaited.record_request(servo, size, time.monotonic())
        answer, result, _ = self._packets.txRxPacket(self.port, packet)
        while result == _SUCCESS and self._is_late(servo, answer, size):
            answer, result = self._packets.rxPacket(self.port, *self._slow)
        self._count_late(servo)
        return answer, result

    def _read_one(self, servo: int, block: Block) -> Reading:
        at_s = time.monotonic()
        answer, result = self._exchange(servo, Instruction.READ, block.size, block)
        if result != _SUCCESS:
            return Reading(None, (), "no_answer" if result == self._timeout else "corrupt")
        return self._reading(self._data(answer), answer[self._at.error], block, at_s)

    def _is_late(self, servo: int, packet: Sequence[int], wanted: int) -> bool:
        """Return whether a packet is another servo's, or answers an earlier question."""
        if packet[self._at.id] != servo:
            return True
        size = len(self._data(packet))
        if not self._awaited.strike(servo, size, late=size != wanted):
            if not size:  # it refuses
                self._awaited.strike(servo, wanted)
            return False
        return size != wanted

    def _data(self, packet: Sequence[int]) -> Sequence[int]:
        """Return a status packet's data, cut to size: unstuffing leaves spare bytes at the end."""
        at = self._at
        size = packet[at.length] - 2
        if self._version == 2:
            size += (packet[at.length + 1] << 8) - 2
        return packet[at.data : at.data + size]

    def _reading(self, data: Sequence[int], error: int, block: Block, at_s: float) -> Reading:
        alarms = alarm_names(self.protocol, error)
        if len(data) != block.size:
            if data or not error:
                # No answer to this: another master's packet, in which protocol 1.0's instruction
                # stands where an answer has its error bits, or what it was answered.
                return Reading(None, (), "corrupt")
            return Reading(None, alarms, "refused")
        return Reading(bytes(data), alarms, None, at_s, time.monotonic())

    def _sync_read(self, servos: Sequence[int], block: Block) -> tuple[dict[int, Reading], bool]:
        """Ask all servos in one packet.

        Returns:
            What was understood, and whether more came than that: the SDK drops packets with a
            wrong checksum, or a broken header, without a word.
        """
        found: dict[int, Reading] = {}
        self._drain()
        at_s = time.monotonic()
        fast = (True,) if self._fast else self._slow
        result = self._packets.syncReadTx(self.port, *block, list(servos), len(servos), *fast)
        for servo in servos:
            self._awaited.record_request(servo, block.size, at_s)
        if result != _SUCCESS:
            return found, False
        before, understood = self.port.received, 0
        if self._fast:
            self.port.is_using = True
            packet, result = self._packets.rxPacket(self.port, True)
            if result == _SUCCESS and packet[self._at.id] == BROADCAST_ID:
                answers = split_fast_sync(bytes(packet[self._at.error : -2]), block.size)
                # One that was cut short would put all after it off their places.
                if [answer.id for answer in answers] == list(servos):
                    understood += len(packet)
                    for answer in answers:
                        self._awaited.strike(answer.id, block.size)
                        found[answer.id] = self._reading(answer.data, answer.error, block, at_s)
            return found, self.port.received - before > understood
        while len(found) < len(servos):
            packet, result = self._packets.rxPacket(self.port, *self._slow)
            if result == self._timeout:
                break
            if result != _SUCCESS:
                continue
            understood += len(packet)
            servo = packet[self._at.id]
            answers_it = self._version == 1 or packet[7] == Instruction.STATUS
            if servo not in servos or servo > MAX_ID or not answers_it:
                continue
            if not self._is_late(servo, packet, block.size):
                error = packet[self._at.error]
                found[servo] = self._reading(self._data(packet), error, block, at_s)
        return found, self.port.received - before > understood


def sdk_of(protocol: Protocol) -> Any:
    """Import the SDK of a protocol's maker.

    Raises:
        MissingExtraError: it is not installed, or is not what the extra brings.
    """
    # Both import pyserial, which :mod:`.port` uses.
    if is_feetech(protocol):
        with needs("a Feetech bus", "feetech"):
            import scservo_sdk as sdk

            if not hasattr(sdk, "PacketHandler"):
                raise ImportError("another package has its name, such as ftservo-python-sdk")
    else:
        with needs("a Dynamixel bus (Feetech: 'feetech')", "dynamixel"):
            import dynamixel_sdk as sdk
    return sdk


def _cut(reading: Reading, block: Block, wide: Block) -> Reading:
    """Cut a reading of registers out of one of more."""
    at = block.address - wide.address
    data = reading.data
    return reading._replace(data=None if data is None else data[at : at + block.size])
