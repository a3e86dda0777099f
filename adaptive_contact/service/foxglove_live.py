"""Shows a running robot in Foxglove: a channel per key, over Foxglove's own websocket protocol.

Topics, schemas and bytes are those of a recording.

The contact of a leg that is not known any more is withdrawn, by an event that is made here where
the service cannot send one.

Everything goes out and nothing comes in: clients can neither publish nor set anything.  A client
that is too slow loses its oldest messages (foxglove-sdk keeps 1024 for each).

Only this module imports foxglove (the extra ``foxglove``), and raises MissingExtraError without it.

Reference: https://github.com/foxglove/ws-protocol, docs/spec.md; subprotocol ``foxglove.sdk.v1``.
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import Counter
from typing import Final, Self

from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact.service.known_contacts import KnownContacts
from adaptive_contact.service.link import Link, Received
from adaptive_contact.service.recording.schemas import kind_of_key, protobuf_class, schema_name
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    ALL_SERVO,
    ALL_STATE,
    ALL_TRUTH,
    HEARTBEAT,
    MAX_PAYLOAD_BYTES,
    ContactEvent,
    Heartbeat,
    Message,
    Reject,
    Rejected,
    bridge_status_key,
    command_key,
    contact_key,
    decode,
)

with needs("Foxglove", "foxglove"):
    import foxglove

# Where Foxglove looks first.
DEFAULT_PORT: Final = 8765


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
        ConfigurationError: it cannot listen there.
    """

    def __init__(self, link: Link, host: str = "127.0.0.1", port: int = DEFAULT_PORT) -> None:
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
        self._channels: dict[str, foxglove.Channel] = {}
        # At 64 legs and 200 Hz more than a second.
        self._waiting: queue.Queue[Received] = queue.Queue(20_000)
        self._known = KnownContacts()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server; calling it twice is safe."""
        self._server.stop()

    def run(self, stop: threading.Event) -> None:
        """Serve until ``stop`` is set."""
        for key in (ALL_CONTACT, SERVICE_STATUS):
            self._link.subscribe(key, self._enqueue, history=True)
        streams = (HEARTBEAT, ALL_SERVO, ALL_STATE, ALL_LEARNER, ALL_TRUTH)
        for key in (*streams, command_key("*"), bridge_status_key("*")):
            self._link.subscribe(key, self._enqueue)
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                self._show_received(self._waiting.get(timeout=0.1))
            for event in self._known.poll_events(time.monotonic_ns()):
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
        if isinstance(message, Heartbeat):
            self._known.heartbeat(message, received.arrival_ns)
        elif isinstance(message, ContactEvent):
            for event in self._known.event(message, time.monotonic_ns()):
                self._show(received.key, event, arrived_ns)
            return
        self._show(received.key, message, arrived_ns)

    def _channel(self, key: str, kind: type[Message]) -> foxglove.Channel | None:
        """Return the channel of a key; None where there are too many."""
        channel = self._channels.get(key)
        # A key is a channel; a robot of 64 legs has 300 of them, and a stranger may make more.
        if channel is None and len(self._channels) < 1024:
            schema = foxglove.Schema(
                name=schema_name(kind), encoding="protobuf", data=protobuf_class(kind)[0]
            )
            channel = self._channels[key] = foxglove.Channel(
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
