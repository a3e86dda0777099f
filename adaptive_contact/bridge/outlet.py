"""Where a bridge's samples go, and where its commands come from: the edges to the network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from adaptive_contact.bridge.status import BridgeStatus
from adaptive_contact.wire import Command, Rejected, ServoSample, decode

__all__ = ["Mailbox", "Outlet", "Post"]


class Outlet(Protocol):
    """What a bridge publishes; Zenoh in the product, a list in tests."""

    def samples(self, samples: Mapping[str, ServoSample]) -> None:
        """One control tick's samples, by leg."""

    def status(self, status: BridgeStatus) -> None:
        """How the port is."""

    def say(self, line: str) -> None:
        """One line for a person: something happened."""


class Post(NamedTuple):
    """A command as it came: its bytes, encoding, and monotonic time of arrival."""

    payload: bytes
    encoding: str
    arrival_ns: int


class Mailbox:
    """The newest command of every leg.

    Written on a thread of the network, read by the cycle: each is one dictionary operation, so
    that neither waits for the other.
    """

    def __init__(self) -> None:
        self._newest: dict[str, Post] = {}
        self.rejected = 0
        self.last_reject: str | None = None

    def put(self, leg: str, payload: bytes, encoding: str, arrival_ns: int) -> None:
        """Keep a command until :meth:`take`, or until a newer one comes."""
        self._newest[leg] = Post(payload, encoding, arrival_ns)

    def take(self, leg: str) -> tuple[Command, int] | None:
        """The newest command since the last call and its time of arrival, or None."""
        post = self._newest.pop(leg, None)
        if post is None:
            return None
        command = decode(post.payload, Command, post.encoding)
        if isinstance(command, Rejected):
            self.refuse(f"leg '{leg}': {command.detail}")
            return None
        return command, post.arrival_ns

    def refuse(self, why: str) -> None:
        """Count a command that cannot be used."""
        self.rejected += 1
        self.last_reject = why
