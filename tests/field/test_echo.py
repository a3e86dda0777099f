"""A source that echoes its commands, and one with swapped phases, through a real service."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.service.interfaces import Received
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import ALL_CONTACT, ALL_LEARNER, ContactEvent, LearnerStatus, decode

from . import mistakes as m

pytestmark = pytest.mark.e2e

COMMAND = (sys.executable, "-m", "adaptive_contact")
SECONDS = 26
BEGIN_S, END_S = 9.0, 17.0
S = 1_000_000_000
# Two legs have one fault each, the others none.
ECHOES, SWAPS = "rf", "lm"
# A swing and the stance after it, at most: what may pass until a fault is told, or is over.
CYCLE_S = 1.6
# Copies are found in three of them.
FOUND_S = {ECHOES: 3 * CYCLE_S, SWAPS: CYCLE_S}


class Inbox:
    """Events and statuses, in the order in which they came."""

    def __init__(self) -> None:
        self.events: list[ContactEvent] = []
        self.statuses: list[LearnerStatus] = []
        self._changed = threading.Condition()

    def __call__(self, received: Received) -> None:
        contact = received.key.endswith("/contact")
        kind = ContactEvent if contact else LearnerStatus
        message = decode(received.payload, kind, received.encoding)
        with self._changed:
            if isinstance(message, ContactEvent):
                self.events.append(message)
            elif isinstance(message, LearnerStatus):
                self.statuses.append(message)
            self._changed.notify_all()

    def wait_until(self, t_ns: int, timeout_s: float = 120.0) -> None:
        """Wait until every leg's status is of this time or later."""

        def there() -> bool:
            newest = {status.leg: status.t_ns for status in self.statuses}
            return len(newest) == 6 and min(newest.values()) >= t_ns

        with self._changed:
            assert self._changed.wait_for(there, timeout_s), self.statuses[-6:]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk in which two legs' samples are wrong for some seconds."""
    folder = tmp_path_factory.mktemp("echo")
    walk = folder / "walk.mcap"
    run = ["sim", "walk", "--seconds", str(SECONDS), "--seed", "12", "--offline", "--record"]
    subprocess.run([*COMMAND, *run, str(walk)], check=True, capture_output=True, timeout=600)
    messages = m.read(walk)
    copies = m.echoed(1)(messages, np.random.default_rng(1))
    other = {"swing": "stance", "stance": "swing"}
    made = []
    for sent, copy in zip(messages, copies, strict=True):
        wrong = sent.is_sample and BEGIN_S <= sent.body["t_ns"] / S < END_S
        if wrong and sent.leg == ECHOES:
            made.append(copy)
        elif wrong and sent.leg == SWAPS:
            made.append(sent.but(phase=other[sent.body["phase"]]))
        else:
            made.append(sent)
    return m.write(folder / "source.mcap", made)


@pytest.fixture(scope="module")
def heard(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Inbox]:
    """What a subscriber of a real service gets of it."""
    log = tmp_path_factory.mktemp("service") / "log"
    with log.open("w") as errors:
        service = subprocess.Popen(
            [*COMMAND, "serve", "--no-state", "--listen", "127.0.0.1:0"],
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
    try:
        assert service.stdout is not None
        ready = service.stdout.readline()
        assert "listening on " in ready, log.read_text()
        endpoint = ready.split("listening on ")[1].split(";")[0]
        got = Inbox()
        with Link.open(client_settings([endpoint], wait=False)) as link:
            link.subscribe(ALL_CONTACT, got, history=True)
            link.subscribe(ALL_LEARNER, got)
            replay = ["replay", str(source), "--speed", "3", "--connect", endpoint]
            subprocess.run([*COMMAND, *replay], check=True, capture_output=True, timeout=600)
            got.wait_until((SECONDS - 1) * S)
            yield got
    finally:
        service.terminate()
        service.communicate(timeout=600)


@pytest.mark.parametrize(("leg", "doubt"), [(ECHOES, "echo"), (SWAPS, "phase")])
def test_a_leg_whose_source_is_wrong_is_ambiguous_and_says_why(
    heard: Inbox, leg: str, doubt: str
) -> None:
    of_leg = [status for status in heard.statuses if status.leg == leg]
    within = [s for s in of_leg if BEGIN_S + FOUND_S[leg] <= s.t_ns / S < END_S]
    assert within
    assert {(s.status, s.doubt) for s in within} == {("ambiguous", doubt)}
    assert all(s.note and "no contacts are reported" in s.note for s in within)
    assert not any(s.contact for s in within)
    # Nothing is learned of it, and the leg is right again afterwards.
    assert len({(s.model_version, s.drift.level, s.buffer.swings) for s in within}) == 1
    last = [status for status in of_leg if status.status != "silent"][-1]  # the recording ends
    assert last.status == "valid", last.note
    assert last.doubt is None


@pytest.mark.parametrize("leg", [ECHOES, SWAPS])
def test_no_contact_stands_while_its_source_is_wrong(heard: Inbox, leg: str) -> None:
    events = [event for event in heard.events if event.leg == leg]
    within = [e for e in events if BEGIN_S + FOUND_S[leg] <= e.t_ns / S < END_S]
    assert not any(event.contact for event in within)
    until = [e for e in events if e.t_ns / S < END_S]
    assert not until[-1].contact
    after = [e for e in events if e.contact and e.t_ns / S >= END_S + 2 * CYCLE_S]
    assert len(after) >= 2
    assert {(e.status, e.withheld, e.doubt) for e in after} == {("valid", False, None)}


def test_the_other_legs_go_on(heard: Inbox) -> None:
    for leg in {event.leg for event in heard.events} - {ECHOES, SWAPS}:
        told = [e for e in heard.events if e.leg == leg and e.contact and not e.withheld]
        assert sum(BEGIN_S <= e.t_ns / S < END_S for e in told) >= 4, leg
        assert {s.status for s in heard.statuses if s.leg == leg} <= {"valid", "silent"}, leg
