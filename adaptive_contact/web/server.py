"""Serves one page over HTTP: a fixed set of paths, one stream of events, and three things to do.

What is done needs POST with a header that no other site can send unasked.  Requests carry no body,
answers are bytes that are there already, and every connection but a stream
closes after its answer.  Who may ask for what, why streams share one history, and why Python's own
``asyncio`` is enough: decision 34.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import json
import os
import secrets
import socket
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from typing import Final

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.web.http import (
    MOST_HEAD_BYTES,
    Refused,
    Request,
    get_only,
    read_request,
    write_answer,
)
from adaptive_contact.wire import is_leg_id

# Browsers that look at once, connections that have shown the token, and those that have not yet:
# each takes up to half a megabyte while it hangs.
MOST_STREAMS: Final = 128
_MOST_WAITING: Final = 256
_BUFFER_BYTES: Final = 128 * 1024
_HUNG_AFTER_S: Final = 20.0

_PAGES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/uPlot.css": ("uPlot.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
    **{
        f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8")
        for name in (
            *("page", "above", "charts", "data", "dom", "look", "marks", "panel", "plots"),
            *("recording", "stream", "table", "theme", "uPlot"),
        )
    },
}


# What can be done by POST, with a header: a form or an image of another site cannot send one, and a
# script of another site would have to ask first (OPTIONS, which is refused).
ACTIONS: Final = frozenset({"/record/start", "/record/stop", "/mark"})
_HEADER: Final = "x-adaptive-contact"

# Asked for a leg's model: JSON, or None where there is none.
ModelOf = Callable[[str], Awaitable[bytes | None]]
# Asked to do one of :data:`ACTIONS`, with the parameters of the request: JSON; raises Refused.
Do = Callable[[str, Mapping[str, str]], Awaitable[bytes]]


@dataclass(frozen=True)
class WebSettings:
    """Describes where the page is served."""

    host: str = "127.0.0.1"  # address to listen on, or a name of this computer
    port: int = 0  # 0 takes a free one
    # that a browser must show; made beyond loopback, and where files may be written
    token: str | None = None
    record_to: Path | None = None  # folder of recordings that the page may make

    def __post_init__(self) -> None:
        if self.token is None and not (self.loopback and self.record_to is None):
            object.__setattr__(self, "token", secrets.token_urlsafe(24))

    @property
    def loopback(self) -> bool:
        """Return whether only this computer can reach the page."""
        if self.host == "localhost":
            return True
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.host).is_loopback
        return False


@dataclass
class History:
    """Holds the frames of the last minutes, shared by all streams."""

    # names this run of the server; numbers of another mean nothing
    session: str = field(default_factory=lambda: secrets.token_hex(4))
    view: bytes = b""  # the last table of legs, as an event of a stream
    views: int = 0  # how many there have been
    farewell: bytes | None = None
    _frames: deque[bytes] = field(default_factory=deque)
    _bytes: int = 0
    _next: int = 0
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    def push(self, frame: bytes, view: bytes | None) -> None:
        """Add a frame, and a table where that has changed; both are JSON on one line."""
        number = f"{self.session}.{self._next}".encode()
        event = b"id: " + number + b"\ndata: " + frame + b"\n\n"
        self._frames.append(event)
        self._bytes += len(event)
        self._next += 1
        # How far back a page can look that is opened now: five minutes of ten frames a second, less
        # where many legs or fast ones make frames large.
        while len(self._frames) > 3000 or self._bytes > (32 * 1024 * 1024):
            self._bytes -= len(self._frames.popleft())
        if view is not None:
            self.view = b"event: view\ndata: " + view + b"\n\n"
            self.views += 1
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    def end(self, line: str) -> None:
        """Let every stream end, once it has given all, with a line for the person who looks."""
        self.farewell = b"event: end\ndata: " + json.dumps(line).encode() + b"\n\n"
        self._changed.set()

    @property
    def begin(self) -> int:
        """Return the number of the oldest frame."""
        return self._next - len(self._frames)

    def after(self, number: int) -> tuple[bytes, int]:
        """Return some frames from a number on, and the number of the next."""
        at = max(number, self.begin)
        taken: list[bytes] = []
        size = 0
        while at < self._next and size < (64 * 1024):
            frame = self._frames[at - self.begin]
            taken.append(frame)
            size += len(frame)
            at += 1
        return b"".join(taken), at

    def resume(self, last: str) -> int:
        """Return the frame at which a stream continues; the oldest if it has had none."""
        session, _, number = last.partition(".")
        if session == self.session and number.isascii() and number.isdigit() and len(number) < 16:
            return min(int(number) + 1, self._next)
        return self.begin

    async def changed(self) -> None:
        """Wait for the next frame."""
        await self._changed.wait()


class Site:
    """Serves the page; everything but :meth:`bind` runs in one event loop.

    Attributes:
        history: what the streams give out.
        streams: browsers that look at the moment.
    """

    def __init__(self, settings: WebSettings, model_of: ModelOf, do: Do) -> None:
        self._settings = settings
        self._model_of = model_of
        self._do = do
        self._socket: socket.socket | None = None
        self._connections: set[asyncio.Task[None]] = set()
        # Those that have shown the token, where one is asked for; others with their address, the
        # oldest first.
        self._admitted: set[asyncio.Task[None]] = set()
        self._waiting: dict[asyncio.Task[None], str] = {}
        self._files = {
            path: (resources.files(__package__).joinpath("static", name).read_bytes(), kind)
            for path, (name, kind) in _PAGES.items()
        }
        self.history = History()
        self.streams = 0

    def bind(self) -> None:
        """Take the port.

        Raises:
            ConfigurationError: it is in use, or the address is none of this computer's.
        """
        host, port = self._settings.host, self._settings.port
        try:
            family, *_, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            self._socket = socket.create_server(address[:2], family=family, backlog=128)
        except socket.gaierror as error:
            raise ConfigurationError(
                f"--host {host}: no such address or name; give one of this computer's"
            ) from error
        except PermissionError as error:
            raise ConfigurationError(
                f"port {port} may not be taken by this user; give --port 1024 or higher"
            ) from error
        except OSError as error:
            # create_server puts its own words behind the system's.
            if error.errno is not None and "in use" in str(error):
                raise ConfigurationError(
                    f"port {port} of {host} is in use; give another --port, or none to take a free "
                    "one"
                ) from error
            raise ConfigurationError(
                f"--host {host}: cannot listen there ({os.strerror(error.errno or 0)}); give an "
                "address of this computer"
            ) from error

    @property
    def port(self) -> int:
        """Return the port that was taken."""
        assert self._socket is not None
        port: int = self._socket.getsockname()[1]
        return port

    @property
    def url(self) -> str:
        """Return the address for a browser; it has the token."""
        host = self._settings.host
        if host in ("0.0.0.0", "::"):
            host = _own_address()
        if ":" in host:
            host = f"[{host}]"
        token = "" if self._settings.token is None else f"?token={self._settings.token}"
        return f"http://{host}:{self.port}/{token}"

    async def serve(self, stop: asyncio.Event) -> None:
        """Serve until ``stop`` is set."""
        server = await asyncio.start_server(
            self._connected, sock=self._socket, limit=MOST_HEAD_BYTES
        )
        try:
            await stop.wait()
        finally:
            server.close()
            for task in list(self._connections):
                task.cancel()
            await asyncio.gather(*self._connections, return_exceptions=True)

    # -- one connection ------------------------------------------------------------------------

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._connections.add(task)
        address, *_ = writer.get_extra_info("peername") or ("",)
        self._waiting[task] = address
        if len(self._waiting) > _MOST_WAITING:
            self._end_a_stranger()
        try:
            writer.transport.set_write_buffer_limits(high=_BUFFER_BYTES)
            await self._converse(reader, writer)
            await _drain(writer)
        except (OSError, TimeoutError, asyncio.CancelledError):
            writer.transport.abort()
        finally:
            writer.close()
            self._connections.discard(task)
            self._admitted.discard(task)
            self._waiting.pop(task, None)

    def _end_a_stranger(self) -> None:
        """End the oldest connection of the address that has most: nobody keeps others out."""
        ((most, _),) = Counter(self._waiting.values()).most_common(1)
        oldest = next(task for task, address in self._waiting.items() if address == most)
        del self._waiting[oldest]
        oldest.cancel()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self._answer(await read_request(reader), reader, writer)
        except Refused as refused:
            body = f"{refused.line}\n".encode()
            kind = "text/plain; charset=utf-8"
            write_answer(writer, refused.status, kind, body, refused.headers)
            if writer.can_write_eof():  # what a stranger still sends is not reset before it is read
                writer.write_eof()

    async def _answer(
        self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self._check_origin(request)
        self._check_token(request)
        self._admit()
        if request.method == "POST":
            if request.path not in ACTIONS:
                raise get_only()
            if _HEADER not in request.headers:
                raise Refused(HTTPStatus.FORBIDDEN, f"a request without {_HEADER} does nothing")
            body, kind = await self._do(request.path, request.query), "application/json"
        elif request.path in ACTIONS:
            raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, "POST only", ("Allow", "POST"))
        elif request.path in self._files:
            body, kind = self._files[request.path]
        elif request.path == "/model":
            body, kind = await self._model(request.query.get("leg", "")), "application/json"
        elif request.path == "/stream":
            await self._stream(request, reader, writer)
            return
        else:
            raise Refused(HTTPStatus.NOT_FOUND, "no such page; there is /")
        write_answer(writer, HTTPStatus.OK, kind, body)

    def _admit(self) -> None:
        """Count a connection among those that have shown the token."""
        task = asyncio.current_task()
        assert task is not None
        if len(self._admitted) >= 256:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections; try again")
        self._waiting.pop(task, None)
        self._admitted.add(task)

    def _check_origin(self, request: Request) -> None:
        """Refuse what a page of another site asks, under whatever name it reached this server."""
        host = request.headers.get("host", "")
        if host.lower() not in self._own_hosts() and not self._is_address(host):
            raise Refused(
                HTTPStatus.MISDIRECTED_REQUEST,
                "this name is not an address of this page; use the link that `watch` printed",
            )
        origin = request.headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host}".lower():
            raise Refused(HTTPStatus.FORBIDDEN, "requests of other sites are refused")
        site = request.headers.get("sec-fetch-site", "none")
        # A link elsewhere may lead here; nothing else may.
        follows_link = request.path == "/" and request.headers.get("sec-fetch-mode") == "navigate"
        if site not in ("same-origin", "none") and not follows_link:
            raise Refused(HTTPStatus.FORBIDDEN, "requests of other sites are refused")

    def _own_hosts(self) -> set[str]:
        if self._settings.loopback:
            names = {"127.0.0.1", "localhost", "[::1]", self._settings.host}
        else:
            own = socket.gethostname().lower()
            names = {"localhost", self._settings.host.lower(), own, f"{own}.local"}
        return {f"{name}:{self.port}" for name in names} | (names if self.port == 80 else set())

    def _is_address(self, host: str) -> bool:
        """Return whether a host is a bare address: no foreign name server can point it elsewhere.

        On loopback only its own are let in; beyond, packets have come to one of this computer's.
        """
        if self._settings.loopback:
            return False
        name, _, port = host.rpartition(":")
        if port != str(self.port):
            return False
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
            return True
        return False

    def _check_token(self, request: Request) -> None:
        token = self._settings.token
        if token is None:
            return
        cookie = f"adaptive_contact_{self.port}"  # cookies of all ports of a host are one jar
        given = request.query.get("token")
        if request.path == "/" and given is not None and _same(given, token):
            raise Refused(
                HTTPStatus.SEE_OTHER,
                "the token is kept in a cookie",
                ("Location", "/"),
                # Lax: a link in a mail or chat leads here, and is followed by a redirection.
                ("Set-Cookie", f"{cookie}={token}; HttpOnly; SameSite=Lax; Path=/"),
            )
        pairs = (
            part.strip().partition("=") for part in request.headers.get("cookie", "").split(";")
        )
        if not any(name == cookie and _same(value, token) for name, _, value in pairs):
            raise Refused(
                HTTPStatus.FORBIDDEN, "a token is needed; use the link that `watch` printed"
            )

    async def _model(self, leg: str) -> bytes:
        if not is_leg_id(leg):
            raise Refused(HTTPStatus.BAD_REQUEST, "no leg's id; expected /model?leg=rf")
        model = await self._model_of(leg)
        if model is None:
            raise Refused(HTTPStatus.NOT_FOUND, "no model of this leg")
        return model

    async def _stream(
        self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        if self.streams >= MOST_STREAMS:
            raise Refused(
                HTTPStatus.SERVICE_UNAVAILABLE,
                f"{self.streams} browsers look already, as many as may; close one",
            )
        own = writer.get_extra_info("socket")
        if own is not None:  # or the kernel alone keeps megabytes for each that hangs
            own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
        self.streams += 1
        try:
            write_answer(writer, HTTPStatus.OK, "text/event-stream", None)
            last = request.headers.get("last-event-id", request.query.get("after", ""))
            pump = asyncio.ensure_future(self._pump(self.history.resume(last), writer))
            gone = asyncio.ensure_future(reader.read(1))  # a browser that looks says nothing more
            try:
                await asyncio.wait((pump, gone), return_when=asyncio.FIRST_COMPLETED)
            finally:
                pump.cancel()
                gone.cancel()
                await asyncio.gather(pump, gone, return_exceptions=True)
            if pump.done() and not pump.cancelled():
                pump.result()
        finally:
            self.streams -= 1

    async def _pump(self, number: int, writer: asyncio.StreamWriter) -> None:
        history, shown = self.history, -1
        writer.write(b"retry: 1000\n\n")
        while not writer.is_closing():
            if shown != history.views:
                shown = history.views
                writer.write(history.view)
            some, number = history.after(number)
            if some:
                writer.write(some)
                await _drain(writer)
            elif history.farewell is not None:
                writer.write(history.farewell)
                return
            else:
                await history.changed()


def _own_address() -> str:
    """Return this computer's address on its network (phones know no names), else its name."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; of documentation (RFC 5737)
        address: str = probe.getsockname()[0]
        return address
    return socket.gethostname()


async def _drain(writer: asyncio.StreamWriter) -> None:
    """Wait until a browser has taken most of what it was sent.

    Not by ``wait_for``, which may swallow a cancellation in Python 3.11.

    Raises:
        TimeoutError: it hangs.
    """
    async with asyncio.timeout(_HUNG_AFTER_S):
        await writer.drain()


def _same(given: str, token: str) -> bool:
    """Compare in a time that says nothing of where they differ."""
    return hmac.compare_digest(given.encode(), token.encode())
