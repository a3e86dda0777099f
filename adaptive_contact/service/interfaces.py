"""What the service asks of learners and queries, and what passes over a link: plain values.

These are the edges that tests can stand in for.  Imports no zenoh.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from adaptive_contact.wire import (
    ContactEvent,
    LearnerStatus,
    Message,
    ModelReport,
    Reject,
    ServoSample,
)


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


class Learner(Protocol):
    """One leg's learner, as :class:`adaptive_contact.leg_learner.ContactLearner` is."""

    @property
    def status(self) -> LearnerStatus:
        """How the learner is, now."""

    @property
    def model_report(self) -> ModelReport | None:
        """The model in force, None before there is one."""

    def count(self, reason: Reject, times: int = 1) -> None:
        """Count payloads that were refused before they became samples."""

    def reset_after_fault(self, fault: Exception) -> None:
        """Go on after a fault from what was last saved, or from nothing; the status says so."""

    def request_release(self) -> None:
        """Say with the next sample that the leg is free: a service before may have said else."""


class Bank(Protocol):
    """All legs at once, as :class:`adaptive_contact.bank.LearnerBank` is."""

    def judge(self, samples: Mapping[str, ServoSample]) -> list[ContactEvent]:
        """Take at most one sample per leg; bad ones are refused by value and counted."""

    def finish(self) -> None:
        """Do what the events of the samples taken did not need to wait for."""

    def learner(self, leg: str, joints: int | None = None) -> Learner | None:
        """The leg's learner, made if need be; None where the bank is full.

        ``joints`` is how many its samples have, for a leg that robot.toml lacks.
        """


class Question(Protocol):
    """A query that waits for an answer, as :class:`adaptive_contact.service.link.Request` is."""

    key: str

    def parameter(self, name: str) -> str | None:
        """A value behind ``?`` in its selector."""

    def covers(self, key: str) -> bool:
        """Return whether the query asks for ``key``."""

    def reply(self, message: Message, key: str | None = None) -> None:
        """Answer for one key."""

    def refuse(self, reason: str) -> None:
        """Answer that it cannot be answered, and finish."""

    def close(self) -> None:
        """Finish."""
