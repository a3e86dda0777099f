"""Shows a running robot in Foxglove: a channel per key, over Foxglove's own websocket protocol.

Topics, schemas and bytes are those of a recording.  One kind of channel is added: a
leg's ``trace`` has a message per tick, with the prediction and the test ratio.  The service is
asked for them only while a client shows one.

The contact of a leg that is not known any more is withdrawn, by an event that is made here where
the service cannot send one.

Everything goes out and nothing comes in: clients can neither publish nor set anything.  A client
that is too slow loses its oldest messages (foxglove-sdk keeps 1024 for each).

Only this module imports foxglove (the extra ``foxglove``).

Reference: https://github.com/foxglove/ws-protocol, docs/spec.md; subprotocol ``foxglove.sdk.v1``.
"""

from __future__ import annotations

import contextlib
import importlib
import queue
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Final, Self

from adaptive_contact.errors import ConfigurationError, LinkError, needs
from adaptive_contact.service.known_contacts import KnownContacts
from adaptive_contact.service.link import Link, Received
from adaptive_contact.service.recording.schemas import kind_of_key, protobuf_class, schema_name
from adaptive_contact.service.trace import TraceReader
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ALL_SERVO,
    ALL_TRUTH,
    HEARTBEAT,
    MAX_PAYLOAD_BYTES,
    ContactEvent,
    Heartbeat,
    LegTrace,
    Message,
    Reject,
    Rejected,
    ServoSample,
    bridge_status_key,
    command_key,
    contact_key,
    decode,
    leg_of_key,
    trace_key,
)

if TYPE_CHECKING:
    from foxglove import Channel

# Where Foxglove looks first.
DEFAULT_PORT: Final = 8765
# Messages that wait to be encoded: at 64 legs and 200 Hz more than a second.
_MOST_WAITING: Final = 20_000
_STREAMS: Final = (
    HEARTBEAT, ALL_SERVO, ALL_LEARNER, ALL_TRUTH, command_key("*"), bridge_status_key("*"),
)  # fmt: skip


class JudgedTick(Message, frozen=True, kw_only=True):
    """Holds a tick of a leg as its learner judged it; one entry of a LegTrace."""

    # t_ns, seq: of the sample
    t_ns: int
    seq: int
    swing: bool | None  # whether the sample says so, or else its commands; None where nothing does
    # desired, measured: (J,) rad, in the source's angles
    desired: list[float]
    measured: list[float]
    # (J,) rad, what ``measured`` was expected to be; None where it was not judged
    predicted: list[float] | None
    test_ratio: float | None  # statistic over threshold, above 1 for a contact; None likewise


class FoxgloveServer:
    """Serves what is on a link; a context manager.

    Args:
        link: open; closed by its owner, after this.
        host: address to listen on.
        port: 0 takes a free one.

    Attributes:
        port: that was taken.
        app_url: opens it in Foxglove's web application.
        shown: messages given to clients.
        left_out: messages that could not be shown, by key and why.

    Raises:
        MissingExtraError: foxglove-sdk is not installed.
        ConfigurationError: it cannot listen there.
    """

    def __init__(self, link: Link, host: str = "127.0.0.1", port: int = DEFAULT_PORT) -> None:
        check_installed()
        import foxglove

        self._foxglove = foxglove
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="adaptive-contact", host=host, port=port, context=self._context
            )
        except RuntimeError as error:
            raise ConfigurationError(
                f"{host}:{port}: cannot listen there ({str(error).partition(': ')[2] or error}); "
                "give another --port or --host"
            ) from error
        self.port = self._server.port
        self.app_url = self._server.app_url() or ""
        self.shown = 0
        self.left_out: Counter[tuple[str, str]] = Counter()
        self._link = link
        self._channels: dict[str, Channel] = {}
        self._waiting: queue.Queue[Received] = queue.Queue(_MOST_WAITING)
        self._known = KnownContacts()
        self._offsets_ns: dict[str, int] = {}
        self._stop = threading.Event()
        self._asker = threading.Thread(target=self._ask, name="foxglove-ticks", daemon=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server; calling it twice is safe."""
        self._stop.set()
        if self._asker.is_alive():
            self._asker.join(2.0)
        self._server.stop()

    def run(self, stop: threading.Event) -> None:
        """Serve until ``stop`` is set."""
        for key in (ALL_CONTACT, SERVICE_STATUS):
            self._link.subscribe(key, self._enqueue, history=True)
        for key in _STREAMS:
            self._link.subscribe(key, self._enqueue)
        self._asker.start()
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                self._show_received(self._waiting.get(timeout=0.1))
            for event in self._known.look(time.monotonic_ns()):
                self._show(contact_key(event.leg), event, time.time_ns())

    def _enqueue(self, received: Received) -> None:
        """Queue what arrives; called on Zenoh's threads."""
        try:
            self._waiting.put_nowait(received)
        except queue.Full:
            self.left_out[received.key, "more than can be shown"] += 1

    # -- messages ----------------------------------------------------------------------------------

    def _show_received(self, received: Received) -> None:
        kind = kind_of_key(received.key)
        if kind is None or len(received.payload) > MAX_PAYLOAD_BYTES:
            return
        arrived_ns = time.time_ns() - (time.monotonic_ns() - received.arrival_ns)
        message = decode(received.payload, kind, received.encoding)
        if isinstance(message, Rejected):
            self.left_out[received.key, message.reason.value] += 1
            return
        leg = leg_of_key(received.key)
        if isinstance(message, ServoSample) and leg is not None:
            # Its ticks are put on the same clock, so that both lie on each other in a plot.
            self._offsets_ns[leg] = arrived_ns - message.t_ns
            self._channel(trace_key(leg), JudgedTick)
        elif isinstance(message, Heartbeat):
            self._known.heartbeat(message, received.arrival_ns)
        elif isinstance(message, ContactEvent):
            for event in self._known.event(message, time.monotonic_ns()):
                self._show(received.key, event, arrived_ns)
            return
        self._show(received.key, message, arrived_ns)

    def _channel(self, key: str, kind: type[Message]) -> Channel | None:
        """Return the channel of a key; None where there are too many."""
        channel = self._channels.get(key)
        # A key is a channel; a robot of 64 legs has 300 of them, and a stranger may make more.
        if channel is None and len(self._channels) < 1024:
            schema = self._foxglove.Schema(
                name=schema_name(kind), encoding="protobuf", data=protobuf_class(kind)[0]
            )
            channel = self._channels[key] = self._foxglove.Channel(
                key, schema=schema, message_encoding="protobuf", context=self._context
            )
        return channel

    def _show(self, key: str, message: Message, time_ns: int) -> None:
        channel = self._channel(key, type(message))
        if channel is None or not channel.has_sinks():
            return
        try:
            channel.log(protobuf_class(type(message))[1](message), log_time=time_ns)
        except (ValueError, OverflowError):  # an integer of more than 64 bits, a time before 1970
            self.left_out[key, Reject.OUT_OF_RANGE.value] += 1
            return
        self.shown += 1

    # -- ticks -------------------------------------------------------------------------------------

    def _ask(self) -> None:
        reader = TraceReader(self._link)
        while not self._stop.wait(0.1):
            wanted = {
                leg
                for leg in list(self._offsets_ns)
                if (channel := self._channels.get(trace_key(leg))) and channel.has_sinks()
            }
            if not wanted:
                continue
            try:
                traces = reader.ask()
            except LinkError:
                continue
            for trace in traces:
                if trace.leg in wanted:
                    self._show_ticks(trace)

    def _show_ticks(self, trace: LegTrace) -> None:
        offset_ns = self._offsets_ns[trace.leg]
        now_ns = time.time_ns()
        names = JudgedTick.__struct_fields__  # as the trace has them, one list each
        for values in zip(*(getattr(trace, name) for name in names), strict=False):
            tick = JudgedTick(**dict(zip(names, values, strict=True)))
            # A tick placed further from now was taken before its source's clock jumped.
            if abs(tick.t_ns + offset_ns - now_ns) <= 60_000_000_000:
                self._show(trace_key(trace.leg), tick, tick.t_ns + offset_ns)


def check_installed() -> None:
    """Make sure that the extra is there.

    Raises:
        MissingExtraError: it is not.
    """
    with needs("Foxglove", "foxglove"):
        importlib.import_module("foxglove")
