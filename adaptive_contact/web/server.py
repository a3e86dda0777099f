"""Serves one page over HTTP: a fixed set of paths, one stream of events, and three things to do.

What is done needs POST with a header that no other site can send unasked.  Requests carry no body,
answers are bytes that are there already, and every connection but a stream
closes after its answer.  Each has a thread (``http.server``).  Who may ask for what, and why
streams share one history: decision 34.
"""

from __future__ import annotations

import contextlib
import errno
import hmac
import io
import ipaddress
import json
import secrets
import socket
import socketserver
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from importlib import resources
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs

from adaptive_contact.errors import ConfigurationError, reason_of
from adaptive_contact.service.settings import is_loopback_host
from adaptive_contact.wire import is_leg_id

# Browsers that look at once, and other connections: each is a thread while it hangs.
MOST_STREAMS: Final = 128
MOST_WAITING: Final = 256
_BUFFER_BYTES: Final = 128 * 1024
HUNG_AFTER_S: Final = 20.0
# A request of a browser is a kilobyte; cookies of other ports of this host come along.
_MOST_HEAD_BYTES: Final = 16 * 1024
HEAD_WITHIN_S: Final = 5.0
_TEXT: Final = "text/plain; charset=utf-8"
_SECURITY: Final = (
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'",
    ),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
)

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
ModelOf = Callable[[str], bytes | None]
# Asked to do one of :data:`ACTIONS`, with the parameters of the request: JSON; raises Refused.
Do = Callable[[str, Mapping[str, str]], bytes]


class Refused(Exception):  # noqa: N818 - an answer
    """Refuses a request with a status and one line."""

    def __init__(self, status: HTTPStatus, line: str, *headers: tuple[str, str]) -> None:
        super().__init__(line)
        self.status, self.line, self.headers = status, line, headers


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
        return is_loopback_host(self.host)


@dataclass
class History:
    """Holds the frames of the last minutes, shared by all streams; calls come from any thread."""

    # names this run of the server; numbers of another mean nothing
    session: str = field(default_factory=lambda: secrets.token_hex(4))
    _view: bytes = b""  # the last table of legs, as an event of a stream
    _views: int = 0  # how many there have been
    _farewell: bytes | None = None
    _frames: deque[bytes] = field(default_factory=deque)
    _bytes: int = 0
    _next: int = 0
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def push(self, frame: bytes, view: bytes | None) -> None:
        """Add a frame, and a table where that has changed; both are JSON on one line."""
        with self._changed:
            number = f"{self.session}.{self._next}".encode()
            event = b"id: " + number + b"\ndata: " + frame + b"\n\n"
            self._frames.append(event)
            self._bytes += len(event)
            self._next += 1
            # How far back a page can look that is opened now: five minutes of ten frames a second,
            # less where many legs or fast ones make frames large.
            while len(self._frames) > 3000 or self._bytes > (32 * 1024 * 1024):
                self._bytes -= len(self._frames.popleft())
            if view is not None:
                self._view = b"event: view\ndata: " + view + b"\n\n"
                self._views += 1
            self._changed.notify_all()

    def end(self, line: str | None = None) -> None:
        """Let every stream end once it has given all, with a line for the person who looks."""
        with self._changed:
            words = json.dumps(line).encode()
            self._farewell = b"" if line is None else b"event: end\ndata: " + words + b"\n\n"
            self._changed.notify_all()

    def resume(self, last: str) -> int:
        """Return the frame at which a stream continues; the oldest if it has had none."""
        session, _, number = last.partition(".")
        with self._changed:
            if session == self.session and number.isascii() and number.isdigit():
                return min(int(number[:15]) + 1, self._next)
            return self._next - len(self._frames)

    def pump(self, number: int, write: Callable[[bytes], object]) -> None:
        """Write the events of a stream, from a frame on, until the end."""
        shown = -1
        while True:
            some: list[bytes] = []
            with self._changed:
                while number == self._next and shown == self._views and self._farewell is None:
                    self._changed.wait()
                if shown != self._views:
                    shown = self._views
                    some.append(self._view)
                begin = self._next - len(self._frames)
                number, size = max(number, begin), 0
                while number < self._next and size < (64 * 1024):
                    some.append(self._frames[number - begin])
                    size += len(some[-1])
                    number += 1
                over = self._farewell if number == self._next else None
            write(b"".join([*some, over or b""]))
            if over is not None:
                return


class Site(socketserver.ThreadingTCPServer):
    """Serves the page by :meth:`serve_forever`; the port is taken at once.

    Attributes:
        history: what the streams give out.
        streams: browsers that look at the moment.

    Raises:
        ConfigurationError: the port is in use, or the address is none of this computer's.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, settings: WebSettings, model_of: ModelOf, do: Do) -> None:
        self.settings = settings
        self.model_of = model_of
        self.do = do
        self.files = {
            path: (resources.files(__package__).joinpath("static", name).read_bytes(), kind)
            for path, (name, kind) in _PAGES.items()
        }
        self.history = History()
        self.streams = 0
        # Held while connections are counted; woken when a browser has gone.
        self.lock = threading.Condition()
        # Connections that are no streams, with their address, the oldest first.
        self.waiting: dict[socket.socket, str] = {}
        host, port = settings.host, settings.port
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
            self.address_family = found[0][0]
            super().__init__((str(found[0][4][0]), port), _Connection)
        except socket.gaierror as error:
            raise ConfigurationError(
                f"--host {host}: no such address or name; give one of this computer's"
            ) from error
        except PermissionError as error:
            raise ConfigurationError(
                f"port {port} may not be taken by this user; give --port 1024 or higher"
            ) from error
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise ConfigurationError(
                    f"port {port} of {host} is in use; give another --port, or none to take a free "
                    "one"
                ) from error
            raise ConfigurationError(
                f"--host {host}: cannot listen there ({reason_of(error)}); give an address of this "
                "computer"
            ) from error
        self.port: int = self.socket.getsockname()[1]

    @property
    def url(self) -> str:
        """Return the address for a browser; it has the token."""
        host = self.settings.host
        if host in ("0.0.0.0", "::"):
            host = _own_address()
        if ":" in host:
            host = f"[{host}]"
        token = "" if self.settings.token is None else f"?token={self.settings.token}"
        return f"http://{host}:{self.port}/{token}"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin a connection's thread; of too many, end one."""
        with self.lock:
            self.waiting[request] = client_address[0]
            if len(self.waiting) > MOST_WAITING:
                # The oldest connection of the address that has most: nobody keeps others out.
                ((most, _),) = Counter(self.waiting.values()).most_common(1)
                oldest = next(one for one, address in self.waiting.items() if address == most)
                del self.waiting[oldest]
                with contextlib.suppress(OSError):
                    oldest.shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """End a connection."""
        with self.lock:
            self.waiting.pop(request, None)
        super().shutdown_request(request)

    def is_own(self, host: str) -> bool:
        """Return whether a browser that asks this host asks this page.

        A bare address is one beyond loopback: no foreign name server can point it elsewhere, and
        packets have come to one of this computer's.  On loopback only its own are let in.
        """
        if self.settings.loopback:
            names = {"127.0.0.1", "localhost", "[::1]", self.settings.host}
        else:
            own = socket.gethostname().lower()
            names = {"localhost", self.settings.host.lower(), own, f"{own}.local"}
        if self.port == 80 and host in names:
            return True
        name, _, port = host.rpartition(":")
        if port != str(self.port) or name in names:
            return port == str(self.port)
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
            return not self.settings.loopback
        return False


class _Connection(BaseHTTPRequestHandler):
    """Answers one request."""

    protocol_version = default_request_version = request_version = "HTTP/1.1"
    server: Site

    def handle(self) -> None:
        try:
            try:
                self.rfile = io.BytesIO(self._head())
                self.raw_requestline = self.rfile.readline()
                if self.raw_requestline and self.parse_request():
                    self._answer()
            except Refused as refused:
                body = f"{refused.line}\n".encode()
                self._send(refused.status, _TEXT, body, *refused.headers)
        except OSError:  # it hangs, or is gone
            return

    def log_message(self, *_: object) -> None:
        """Log nothing: strangers would fill the disk."""

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer what is no request of HTTP."""
        raise Refused(HTTPStatus(code), "no request of HTTP/1.1")

    def _head(self) -> bytes:
        """Read the head of a request; empty where none came."""
        head = b""
        until_s = time.monotonic() + HEAD_WITHIN_S
        while b"\r\n\r\n" not in head:
            self.connection.settimeout(max(until_s - time.monotonic(), 1e-3))
            try:
                part = self.connection.recv(65536)
            except TimeoutError:
                line = f"no whole request within {HEAD_WITHIN_S:g} s"
                raise Refused(HTTPStatus.REQUEST_TIMEOUT, line) from None
            head += part
            if len(head) > _MOST_HEAD_BYTES:
                line = f"more than {_MOST_HEAD_BYTES} bytes of headers"
                raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, line)
            if not part:
                break
        self.connection.settimeout(HUNG_AFTER_S)
        if head and b"\r\n\r\n" not in head:
            raise Refused(HTTPStatus.BAD_REQUEST, "half a request")
        return head

    def _send(
        self, status: HTTPStatus, kind: str, body: bytes | None, *headers: tuple[str, str]
    ) -> None:
        """Write an answer; without a body what follows is a stream."""
        self.send_response_only(status)
        self.send_header("Content-Type", kind)
        if body is not None:
            self.send_header("Content-Length", str(len(body)))
        for name, value in (*_SECURITY, *headers, ("Connection", "close")):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body or b"")

    def _answer(self) -> None:
        site, path = self.server, self.path.partition("?")[0]
        self._check_form()
        self._check_origin(path)
        try:
            pairs = parse_qs(self.path.partition("?")[2], max_num_fields=8)
        except ValueError:
            raise Refused(HTTPStatus.BAD_REQUEST, "too many parameters") from None
        query = {name: values[0] for name, values in pairs.items()}
        self._check_token(path, query)
        kind = "application/json"
        if self.command == "POST":
            if _HEADER not in self.headers:
                raise Refused(HTTPStatus.FORBIDDEN, f"a request without {_HEADER} does nothing")
            body = site.do(path, query)
        elif path in site.files:
            body, kind = site.files[path]
        elif path == "/model":
            body = self._model(query.get("leg", ""))
        elif path == "/stream":
            self._stream(self.headers.get("last-event-id", query.get("after", "")))
            return
        else:
            raise Refused(HTTPStatus.NOT_FOUND, "no such page; there is /")
        self._send(HTTPStatus.OK, kind, body)

    def _check_form(self) -> None:
        """Refuse requests that no browser makes of the page."""
        headers = self.headers
        path = self.path.partition("?")[0]
        method = "POST" if path in ACTIONS else "GET"
        if self.command != method:
            allow = ("Allow", method)
            raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, f"{method} only", allow)
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            raise Refused(HTTPStatus(413), "a request with a body")
        twice = any(len(headers.get_all(n, ())) > 1 for n in ("host", "origin", "sec-fetch-site"))
        if headers.defects or twice:
            raise Refused(HTTPStatus.BAD_REQUEST, "a header that is none, or is there twice")

    def _check_origin(self, path: str) -> None:
        """Refuse what a page of another site asks, under whatever name it reached this server."""
        host = self.headers.get("host", "").lower()
        if not self.server.is_own(host):
            raise Refused(
                HTTPStatus.MISDIRECTED_REQUEST,
                "this name is not an address of this page; use the link that `watch` printed",
            )
        origin = self.headers.get("origin", f"http://{host}")
        site = self.headers.get("sec-fetch-site", "none")
        # A link elsewhere may lead here; nothing else may.
        follows_link = path == "/" and self.headers.get("sec-fetch-mode") == "navigate"
        foreign = site not in ("same-origin", "none") and not follows_link
        if foreign or origin.lower() != f"http://{host}":
            raise Refused(HTTPStatus.FORBIDDEN, "requests of other sites are refused")

    def _check_token(self, path: str, query: Mapping[str, str]) -> None:
        token = self.server.settings.token
        if token is None:
            return
        # Cookies of all ports of a host are one jar.
        cookie = f"adaptive_contact_{self.server.port}"
        if path == "/" and _same(query.get("token", ""), token):
            raise Refused(
                HTTPStatus.SEE_OTHER,
                "the token is kept in a cookie",
                ("Location", "/"),
                # Lax: a link in a mail or chat leads here, and is followed by a redirection.
                ("Set-Cookie", f"{cookie}={token}; HttpOnly; SameSite=Lax; Path=/"),
            )
        pairs = (part.strip().partition("=") for part in self.headers.get("cookie", "").split(";"))
        if not any(name == cookie and _same(value, token) for name, _, value in pairs):
            raise Refused(
                HTTPStatus.FORBIDDEN, "a token is needed; use the link that `watch` printed"
            )

    def _model(self, leg: str) -> bytes:
        if not is_leg_id(leg):
            raise Refused(HTTPStatus.BAD_REQUEST, "no leg's id; expected /model?leg=rf")
        model = self.server.model_of(leg)
        if model is None:
            raise Refused(HTTPStatus.NOT_FOUND, "no model of this leg")
        return model

    def _stream(self, last: str) -> None:
        site = self.server
        with site.lock:
            if site.streams >= MOST_STREAMS:
                line = f"{site.streams} browsers look already, as many as may; close one"
                raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, line)
            site.streams += 1
            site.waiting.pop(self.connection, None)
        try:
            # Or the kernel alone keeps megabytes for each that hangs.
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            self._send(HTTPStatus.OK, "text/event-stream", None)
            self.wfile.write(b"retry: 1000\n\n")
            site.history.pump(site.history.resume(last), self.wfile.write)
        finally:
            with site.lock:
                site.streams -= 1
                site.lock.notify_all()


def _own_address() -> str:
    """Return this computer's address on its network (phones know no names), else its name."""
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing; of documentation (RFC 5737)
        address: str = probe.getsockname()[0]
        return address
    return socket.gethostname()


def _same(given: str, token: str) -> bool:
    """Compare in a time that says nothing of where they differ."""
    return hmac.compare_digest(given.encode(), token.encode())
