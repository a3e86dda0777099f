"""Defines the values that pass over a link.  Imports no zenoh."""

from __future__ import annotations

from typing import NamedTuple


class Received(NamedTuple):
    """Holds one sample as it arrived."""

    key: str  # concrete key, without the namespace
    payload: bytes
    encoding: str  # as the publisher declared it
    arrival_ns: int  # `time.monotonic_ns()` when Zenoh handed it over
    published_ns: int | None  # the publisher's wall clock, ns since 1970, None where it sent none
    attachment: bytes = b""  # what the publisher attached, empty where it attached nothing


class Reply(NamedTuple):
    """Holds one answer to a query; ``error`` is the replier's word where it refused."""

    key: str
    payload: bytes
    encoding: str
    error: str | None = None
