"""Opens the Zenoh session.  Only this module and :mod:`.transport` import zenoh.

Delivery, as measured on 1.10.2: streams go with DROP and without express; contact events are
rare and must arrive, so they go express with BLOCK, ahead of the streams, and the last one is
kept for late joiners (an advanced publisher's cache for those who subscribe with history, a
queryable for those who ask with a plain ``get``).

Callbacks run on a thread of their subscription, behind a 256-deep queue; one that works holds up
the session's other subscriptions.  A sink only enqueues.
"""

from __future__ import annotations

import collections
import functools
import math
import threading
import time
from collections.abc import Callable
from typing import Any, Self

import zenoh
import zenoh.ext

from adaptive_contact.errors import ConfigurationError, LinkError
from adaptive_contact.service.settings import (
    DEFAULT_ENDPOINT,
    Finding,
    LinkSettings,
    NoRouterError,
    Reach,
    client_settings,
    endpoint,
    probe,
    router_settings,
)
from adaptive_contact.service.sockets import LinkSockets
from adaptive_contact.service.transport import (
    Facts,
    callback_faults,
    configure,
    first_line,
    router_failure,
)
from adaptive_contact.wire import MAX_PAYLOAD_BYTES, Message, encode
from adaptive_contact.wire.received import Received, Reply

__all__ = [
    "DEFAULT_ENDPOINT",
    "Declared",
    "Finding",
    "Link",
    "LinkSettings",
    "NoRouterError",
    "Publisher",
    "Reach",
    "Received",
    "Reply",
    "Request",
    "client_settings",
    "endpoint",
    "router_settings",
]


def check_key_expression(text: str) -> str:
    """Return a key expression that Zenoh will take.

    Raises:
        ConfigurationError: it will not.
    """
    try:
        return str(zenoh.KeyExpr(text))
    except zenoh.ZError as error:
        raise ConfigurationError(
            f"key expression '{text}' cannot be used; expected chunks between single slashes, "
            "'*' for any one, '**' for any number, '$*' inside one, such as 'robot/leg/*/servo'"
        ) from error


def listen(
    link: Link,
    key_expr: str,
    seconds: float,
    on_message: Callable[[Received], None],
    *,
    stop: threading.Event | None = None,
    on_poll: Callable[[], None] = lambda: None,
) -> float:
    """Process what arrives for a while, on the caller's thread.

    Args:
        link: open.
        key_expr: of what is taken.
        seconds: how long.
        on_message: called with each message; of a flood the oldest are dropped.
        stop: ends it earlier.
        on_poll: called twenty times a second.

    Returns:
        How long it has listened, s.
    """
    waiting: collections.deque[Received] = collections.deque(maxlen=50_000)
    stop, began = stop or threading.Event(), time.monotonic()
    declared = link.subscribe(key_expr, waiting.append)
    more = True
    while more:
        # A deque, which drops the oldest of a flood, cannot be waited for.
        more = time.monotonic() - began < seconds and not stop.wait(0.05)
        if not more:
            declared.close()
        for _ in range(len(waiting)):
            on_message(waiting.popleft())
        on_poll()
    return time.monotonic() - began


class Request:
    """Holds a query to be answered, here or later on another thread; answer or close it once."""

    def __init__(self, query: zenoh.Query, encoding: str) -> None:
        self._query = query
        self._encoding = encoding
        self.key = str(query.key_expr)
        self.encoding = "" if query.encoding is None else str(query.encoding)

    @property
    def size(self) -> int:
        """Return the number of bytes that came with the query."""
        payload = self._query.payload
        return 0 if payload is None else len(payload)

    @property
    def payload(self) -> bytes:
        """Return what came with the query; a copy, as queries may wait in dozens."""
        payload = self._query.payload
        return b"" if payload is None else payload.to_bytes()

    def parameter(self, name: str) -> str | None:
        """Return a value that follows ``?`` in the selector."""
        return self._query.parameters.get(name)

    def covers(self, key: str) -> bool:
        """Return whether the query asks for ``key`` (it may hold wildcards)."""
        return bool(self._query.key_expr.intersects(zenoh.KeyExpr(key)))

    def reply(self, message: Message, key: str | None = None) -> None:
        """Answer; ``key`` is needed where the query holds wildcards."""
        self.reply_raw(encode(message, self._encoding), self._encoding, key)

    def reply_raw(self, payload: bytes, encoding: str, key: str | None = None) -> None:
        """Answer with bytes."""
        self._query.reply(key or self.key, payload, encoding=encoding)

    def refuse(self, reason: str) -> None:
        """Answer with an error and finish; ``reason`` is one line."""
        self._query.reply_err(reason, encoding="text/plain")
        self.close()

    def close(self) -> None:
        """End the query: until then the asker waits for more answers, up to its timeout."""
        self._query.drop()


class Declared:
    """Represents a subscription, queryable or token; in force until it or its link is closed."""

    def __init__(self, declared: Any, held: set[Declared]) -> None:
        self._declared = declared
        self._held = held  # tokens and queryables end with their last reference
        held.add(self)

    def close(self) -> None:
        """Withdraw it."""
        self._held.discard(self)
        self._declared.undeclare()


class Publisher:
    """Publishes messages of one key; made by :meth:`Link.publisher`."""

    def __init__(self, declared: Any, key: str, encoding: str, *, keep: bool) -> None:
        self._declared = declared
        self._put: Callable[..., Any] = declared.put
        self._last: tuple[bytes, str] | None = None
        self._keep = keep
        self.key = key
        self.encoding = encoding

    @property
    def matched(self) -> bool:
        """Return whether there is a subscriber; always True with history, where it is unknown."""
        return self._keep or bool(self._declared.matching_status.matching)

    def put(self, message: Message) -> None:
        """Publish; blocks only on a reliable publisher with a subscriber that hangs.

        Raises:
            LinkError: the link is closed.
        """
        self.put_raw(encode(message, self.encoding), self.encoding)

    def put_raw(self, payload: bytes, encoding: str, attachment: bytes | None = None) -> None:
        """Publish bytes as they are, with an attachment or none.

        Raises:
            LinkError: the link is closed.
        """
        if self._keep:
            self._last = (payload, encoding)
        try:
            self._put(payload, encoding=encoding, attachment=attachment)
        except zenoh.ZError as error:
            raise LinkError(f"{self.key} cannot be published: {first_line(error)}") from error

    def answer(self, query: zenoh.Query) -> None:
        """Answer a plain ``get`` with the last payload."""
        if self._last is not None:
            query.reply(self.key, self._last[0], encoding=self._last[1])


def _hand_over(sink: Callable[[Received], None], sample: zenoh.Sample) -> None:
    """Give a sink a sample's values; a deletion is passed over."""
    if sample.kind == zenoh.SampleKind.DELETE:
        return
    stamp, attached = sample.timestamp, sample.attachment
    sink(
        Received(
            str(sample.key_expr),
            sample.payload.to_bytes(),
            str(sample.encoding),
            time.monotonic_ns(),
            None if stamp is None else stamp.get_time_as_ntp64().as_nanos(),
            b"" if attached is None else attached.to_bytes(),
        )
    )


class Link:
    """Wraps a Zenoh session; made by :meth:`open`, closed by :meth:`close` or after ``with``."""

    def __init__(self, session: zenoh.Session, settings: LinkSettings, facts: Facts) -> None:
        self._session = session
        self._faults_before = callback_faults()
        self._held: set[Declared] = set()
        self.sockets = LinkSockets()
        self.sockets.start()
        self.settings = settings
        self.endpoints = facts.listen  # where it listens
        # routers that it joins; a client is let in by one of them, a router need not be
        self.joins = facts.connect
        self.max_sessions = facts.max_sessions  # that it takes at once

    @classmethod
    def open(
        cls,
        settings: LinkSettings,
        *,
        on_wait: Callable[[Finding], None] | None = None,
        stop: threading.Event | None = None,
        patience_s: float = math.inf,
    ) -> Self:
        """Join the network.

        A client with ``settings.wait`` tries until its router lets it in; afterwards Zenoh
        reconnects by itself, for as long as the link is open.

        Args:
            settings: how.
            on_wait: called with what stands in the way, at first and whenever it changes.
            stop: ends the waiting when set.
            patience_s: so does this time.

        Raises:
            NoRouterError: the router is unreachable or refuses, and ``wait`` is False,
                ``stop`` was set or ``patience_s`` is over.
            LinkError: an address cannot be listened on, or be one of a router to join.
            ConfigurationError: the Zenoh configuration file cannot be used.
        """
        stop, until_s = stop or threading.Event(), time.monotonic() + patience_s
        reported: Finding | None = None
        while True:
            config, facts = configure(settings)
            finding = probe(facts.connect) if settings.mode == "client" else Finding("unknown", "")
            try:
                if not finding.certain:
                    return cls(zenoh.open(config), settings, facts)
            except zenoh.ZError as error:
                if settings.mode == "router":
                    raise LinkError(router_failure(facts, error)) from error
            if not settings.wait:
                raise NoRouterError(finding)
            if finding != reported:
                reported = finding
                if on_wait is not None:
                    on_wait(finding)
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                raise NoRouterError(finding, f"no router within {patience_s:g} s: ")
            if stop.wait(min(0.25, left_s)):
                raise NoRouterError(finding, "stopped while waiting for a router; ")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> bool:
        """End the session; everything declared on it ends with it.

        Returns:
            False where Zenoh did not finish within a second (a subscriber hangs).
        """
        closer = threading.Thread(target=self._close, name="zenoh-close", daemon=True)
        closer.start()
        closer.join(1.0)
        return not closer.is_alive()

    def _close(self) -> None:
        self._session.close()
        self.sockets.close()  # last: sockets that close with a linger would hold up the session

    def publisher(self, key: str, *, reliable: bool = False, history: int = 0) -> Publisher:
        """Declare a publisher.

        Args:
            key: without wildcards.
            reliable: express and BLOCK, for rare messages that must arrive; otherwise DROP.
            history: how many samples late joiners get: those who subscribe with ``history``
                from a cache, those who ask with a plain ``get`` the last one.
        """
        quality: dict[str, Any] = {"encoding": self.settings.encoding}
        if reliable:
            quality |= {
                "congestion_control": zenoh.CongestionControl.BLOCK,
                "express": True,
                "priority": zenoh.Priority.INTERACTIVE_HIGH,
            }
        if history == 0:
            plain = self._session.declare_publisher(key, **quality)
            return Publisher(plain, key, self.settings.encoding, keep=False)
        publisher = self._kept(key, history, None, **quality)
        # Zenoh's thread answers; the reply is made of bytes that are there already.
        Declared(self._session.declare_queryable(key, publisher.answer), self._held)
        return publisher

    def latched(self, key: str) -> Publisher:
        """Declare a publisher as rmw_zenoh does for topics that are reliable and transient local.

        Late joiners get the last message, and who lost one fetches it.  A put never blocks.

        Args:
            key: without wildcards.
        """
        drop = zenoh.CongestionControl.DROP
        # As rmw_zenoh's publishers have it: after a message, not all the time.
        return self._kept(key, 1, 0.5, congestion_control=drop, express=True)

    def _kept(self, key: str, cache: int, heartbeat_s: float | None, **quality: Any) -> Publisher:
        """Declare a publisher with a cache for late joiners."""
        declared = zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            cache=zenoh.ext.CacheConfig(cache),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(
                heartbeat=None, sporadic_heartbeat=heartbeat_s
            ),
            publisher_detection=True,
            **quality,
        )
        return Publisher(declared, key, self.settings.encoding, keep=True)

    def subscribe(
        self,
        key_expr: str,
        sink: Callable[[Received], None],
        *,
        history: bool = False,
    ) -> Declared:
        """Call a sink with every sample that matches.

        Args:
            key_expr: may hold wildcards.
            sink: called on a thread of the subscription's own; it must only enqueue.
            history: ask publishers with a history for it, those that come later too.
        """
        handler = zenoh.handlers.Callback(functools.partial(_hand_over, sink))
        if history:
            return Declared(
                zenoh.ext.declare_advanced_subscriber(
                    self._session,
                    key_expr,
                    handler,
                    history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
                ),
                self._held,
            )
        return Declared(self._session.declare_subscriber(key_expr, handler), self._held)

    def queryable(self, key_expr: str, sink: Callable[[Request], None]) -> Declared:
        """Call a sink with every query that matches.

        Args:
            key_expr: may hold wildcards.
            sink: called on Zenoh's thread; answers at once, or enqueues the request for a
                thread that will.  A sink that raises makes the asker see no answer at all.
                What is larger than any message is refused before.
        """
        encoding = self.settings.encoding

        def answer(query: zenoh.Query) -> None:
            request = Request(query, encoding)
            if request.size > MAX_PAYLOAD_BYTES:  # it may be megabytes, and dozens may wait
                request.refuse(f"{request.size} bytes, at most {MAX_PAYLOAD_BYTES}")
            else:
                sink(request)

        return Declared(self._session.declare_queryable(key_expr, answer), self._held)

    def query(
        self, selector: str, message: Message | None = None, *, timeout_s: float = 1.0
    ) -> list[Reply]:
        """Ask, and wait for the answers.

        Returns:
            All answers within ``timeout_s``; empty where there is no process to answer.

        Raises:
            LinkError: the link is closed.
        """
        given: dict[str, Any] = {}
        if message is not None:
            encoding = self.settings.encoding
            given = {"payload": encode(message, encoding), "encoding": encoding}
        try:
            found = list(self._session.get(selector, timeout=timeout_s, **given))
        except zenoh.ZError as error:
            raise LinkError(f"{selector} cannot be asked for: {first_line(error)}") from error
        replies = []
        for reply in found:
            if reply.ok is not None:
                key, payload = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
                replies.append(Reply(key, payload, str(reply.ok.encoding)))
            elif reply.err is not None:
                text, coded = reply.err.payload.to_bytes(), str(reply.err.encoding)
                replies.append(Reply(selector, text, coded, text.decode(errors="replace")))
        return replies

    def token(self, key: str) -> Declared:
        """Declare a liveliness token: others see it for as long as this link is up."""
        return Declared(self._session.liveliness().declare_token(key), self._held)

    def alive(self, key_expr: str) -> set[str]:
        """Return the liveliness tokens that exist now; it takes a second at the most."""
        replies = self._session.liveliness().get(key_expr, timeout=1.0)
        return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

    def watch_tokens(self, key_expr: str, sink: Callable[[str, bool], None]) -> Declared:
        """Call a sink with (key, alive) at each change, and at once for those alive already."""
        declared = self._session.liveliness().declare_subscriber(
            key_expr,
            lambda sample: sink(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT),
            history=True,
        )
        return Declared(declared, self._held)

    def sessions(self) -> int:
        """Count the other sessions that are connected to this one."""
        return len(list(self._session.info.transports()))

    @property
    def id(self) -> str:
        """Return Zenoh's id of this session."""
        return str(self._session.info.zid())

    def is_connected(self) -> bool:
        """Return whether a router is joined; always for one that joins no other."""
        alone = self.settings.mode == "router" and not self.joins
        return alone or bool(list(self._session.info.routers_zid()))

    def diagnose(self) -> Finding:
        """Find out what stands between this session and its router, at this moment."""
        if self.is_connected():
            return Finding("connected", "connected")
        return probe(self.joins)

    @property
    def callback_faults(self) -> int:
        """Count exceptions in callbacks since this link was opened (by any link here)."""
        return callback_faults() - self._faults_before
