"""Parses what the page needs of HTTP: the head of a request, and one answer.

What a stranger sends can only fail to be one of a few exact requests; every answer carries the
headers that keep other sites out.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from http import HTTPStatus
from typing import Final, NamedTuple
from urllib.parse import parse_qs

# A request of a browser is a kilobyte; cookies of other ports of this host come along.
MOST_HEAD_BYTES: Final = 16 * 1024
_MOST_HEADERS: Final = 64
HEAD_WITHIN_S: Final = 5.0
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


class Refused(Exception):  # noqa: N818 - an answer
    """Refuses a request with a status and one line."""

    def __init__(self, status: HTTPStatus, line: str, *headers: tuple[str, str]) -> None:
        super().__init__(line)
        self.status, self.line, self.headers = status, line, headers


def get_only() -> Refused:
    """Return the refusal of another method."""
    return Refused(HTTPStatus.METHOD_NOT_ALLOWED, "GET only", ("Allow", "GET"))


class Request(NamedTuple):
    """Holds the head of a request; names of headers in small letters."""

    method: str
    path: str
    query: Mapping[str, str]
    headers: Mapping[str, str]


async def read_request(reader: asyncio.StreamReader) -> Request:
    """Read the head of a request.

    Raises:
        Refused: it is none that the page answers.
        ConnectionResetError: the browser went without one.
    """
    try:
        async with asyncio.timeout(HEAD_WITHIN_S):
            head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        line = f"more than {MOST_HEAD_BYTES} bytes of headers"
        raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, line) from None
    except TimeoutError:
        line = f"no whole request within {HEAD_WITHIN_S:g} s"
        raise Refused(HTTPStatus.REQUEST_TIMEOUT, line) from None
    except asyncio.IncompleteReadError as short:
        if not short.partial:
            raise ConnectionResetError from None
        raise Refused(HTTPStatus.BAD_REQUEST, "half a request") from None
    first, *lines = head[:-4].decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or words[2] not in ("HTTP/1.1", "HTTP/1.0"):
        raise Refused(HTTPStatus.BAD_REQUEST, "no request of HTTP/1.1")
    method, target, _ = words
    if method not in ("GET", "POST"):
        raise get_only()
    headers = _headers(lines)
    if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
        raise Refused(HTTPStatus(413), "a request with a body")
    path, _, query = target.partition("?")
    try:
        pairs = parse_qs(query, max_num_fields=8, strict_parsing=False)
    except ValueError:
        raise Refused(HTTPStatus.BAD_REQUEST, "too many parameters") from None
    return Request(method, path, {name: values[0] for name, values in pairs.items()}, headers)


def _headers(lines: list[str]) -> dict[str, str]:
    if len(lines) > _MOST_HEADERS:
        line = f"{len(lines)} headers; at most {_MOST_HEADERS}"
        raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, line)
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name = name.lower()
        if not colon or not name or not name.isascii() or name != name.strip() or "\n" in line:
            raise Refused(HTTPStatus.BAD_REQUEST, "a header that is none")
        if name in headers and name in ("host", "origin", "sec-fetch-site"):
            raise Refused(HTTPStatus.BAD_REQUEST, f"two headers {name}")
        headers[name] = value.strip()
    return headers


def write_answer(
    writer: asyncio.StreamWriter,
    status: HTTPStatus,
    kind: str,
    body: bytes | None,
    headers: tuple[tuple[str, str], ...] = (),
) -> None:
    """Write an answer; without a body what follows is a stream."""
    lines = [f"HTTP/1.1 {status.value} {status.phrase}", f"Content-Type: {kind}"]
    if body is not None:
        lines.append(f"Content-Length: {len(body)}")
    lines += [f"{name}: {value}" for name, value in (*_SECURITY, *headers)]
    lines += ["Connection: close", "", ""]
    writer.write("\r\n".join(lines).encode("latin-1"))
    if body is not None:
        writer.write(body)
