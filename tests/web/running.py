"""A page's server on a thread of its own, and requests to it byte by byte."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Mapping
from typing import Any

from adaptive_contact.web import WebSettings
from adaptive_contact.web.server import Site

FRAME = b'{"t":1}'


class Running:
    """A site on a thread; it pushes a frame when it is told to."""

    def __init__(self, settings_: WebSettings) -> None:
        self.site = Site(settings_, self._model, self._do)
        self.asked: list[str] = []
        self.done: list[tuple[str, dict[str, str]]] = []
        self.faults: list[object] = []
        self.site.handle_error = lambda *_: self.faults.append(sys.exception())
        self.thread = threading.Thread(target=self.site.serve_forever, args=(0.02,), daemon=True)
        self.thread.start()
        self.port = self.site.port
        self.host = f"127.0.0.1:{self.port}"

    def _model(self, leg: str) -> bytes | None:
        self.asked.append(leg)
        return b'{"leg":"rf"}' if leg == "rf" else None

    def _do(self, path: str, query: Mapping[str, str]) -> bytes:
        self.done.append((path, dict(query)))
        return b"{}"

    def push(self, frame: bytes = FRAME, view: bytes | None = None) -> None:
        self.site.history.push(frame, view)

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), 20)

    def send(self, request: bytes) -> tuple[int, dict[str, str], bytes]:
        """Send bytes; the answer, once the server has closed."""
        with self.connect() as one:
            one.sendall(request)
            return answer_of(everything(one))

    def get(
        self, path: str, *headers: str, method: str = "GET"
    ) -> tuple[int, dict[str, str], bytes]:
        lines = [f"{method} {path} HTTP/1.1", f"Host: {self.host}", *headers, "", ""]
        return self.send("\r\n".join(lines).encode())

    def stream(self, after: str = "") -> socket.socket:
        one = self.connect()
        one.sendall(f"GET /stream?after={after} HTTP/1.1\r\nHost: {self.host}\r\n\r\n".encode())
        return one

    def close(self) -> None:
        self.site.history.end()
        self.site.shutdown()
        self.site.server_close()
        self.thread.join(10)
        assert not self.thread.is_alive()
        assert not self.faults


def everything(one: socket.socket) -> bytes:
    return one.makefile("rb").read()


def answer_of(data: bytes) -> tuple[int, dict[str, str], bytes]:
    head, _, body = data.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    pairs = (line.split(": ", 1) for line in lines)
    return int(first.split()[1]), dict(pairs), body


def read_until(one: socket.socket, what: bytes) -> bytes:
    data = b""
    while what not in data:
        part = one.recv(65536)
        assert part, f"closed before {what!r}: {data[-200:]!r}"
        data += part
    return data


def events(url: str, enough: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """What a stream gives: the first piece that is enough."""
    until = time.monotonic() + 30
    with urllib.request.urlopen(f"{url}stream", timeout=20) as answer:
        for line in answer:
            assert time.monotonic() < until
            if line.startswith(b"data: {"):
                found: dict[str, Any] = json.loads(line[6:])
                if enough(found):
                    return found
    raise AssertionError("the stream has ended")
