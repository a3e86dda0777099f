"""What passes over a link: plain values.  Imports no zenoh."""

from __future__ import annotations

from typing import NamedTuple


class Received(NamedTuple):
    """One sample, as it arrived.

    Attributes:
        key: concrete key, without the namespace.
        encoding: as the publisher declared it.
        arrival_ns: ``time.monotonic_ns()`` when Zenoh handed it over.
        published_ns: the publisher's wall clock, ns since 1970, None where it sent none.
        attachment: what the publisher attached, empty where it attached nothing.
    """

    key: str
    payload: bytes
    encoding: str
    arrival_ns: int
    published_ns: int | None
    attachment: bytes = b""


class Reply(NamedTuple):
    """One answer to a query; ``error`` is the replier's word where it refused."""

    key: str
    payload: bytes
    encoding: str
    error: str | None = None
