"""What the service makes of refused samples, of two publishers, and of both over a restart.

The service in this process with a fake learner behind the real checks of a stream; a restart is a
second service on the folder of the first.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from structlog.testing import capture_logs

from adaptive_contact.robot import Robot
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.service.state import StateStore
from adaptive_contact.service.state.keeper import StateKeeper
from adaptive_contact.wire import (
    ServoSample,
)

S = 1_000_000_000
TICK = 20_000_000
Sample = Callable[..., ServoSample]


Live = Callable[[], Any]


@pytest.fixture
def live(lockstep: Callable[..., Any], robot: Robot, tmp_path: Path) -> Live:
    """Lives of one robot's service, one after the other; each has its own router."""

    @contextlib.contextmanager
    def begin() -> Iterator[Any]:
        store = StateStore.open(tmp_path / "kept", robot.name)
        with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
            life = lockstep(link, keeper=StateKeeper(store, robot.name, lambda _: "s"))
            yield life
            stop = threading.Event()
            stop.set()
            life.service.run(stop)  # as a service ends that is asked to: everything is saved

    return begin


def test_losses_over_a_restart_count_from_the_last_sample_that_was_used(
    live: Live, inbox: Any, sample: Sample
) -> None:
    with live() as first:
        first.deliver(*(sample(seq) for seq in range(1, 1001)), sample(3))
        assert first.bank.learner("rf").rejects == {"time_backwards": 1}
    with live() as second:
        got = second.statuses(inbox)
        second.deliver(*(sample(seq) for seq in range(1011, 1015)))
        second.idle(60)
        assert got.wait(1)[-1].missed == 10


def test_a_status_after_a_restart_has_the_gap_or_says_that_it_lacks_it(
    live: Live, inbox: Any, sample: Sample
) -> None:
    with live() as first:
        first.deliver(*(sample(seq) for seq in range(1, 11)))
    with live() as second:
        got = second.statuses(inbox)
        second.idle(60)
        assert "`missed` lacks" in got.wait(1)[-1].note
        second.deliver(sample(211), sample(212))  # one sample could be another writer's
        second.now_ns += S
        second.deliver(sample(213), sample(214))
        found = got.wait(lambda items: items[-1].status == "valid")
        assert [status.missed for status in found if status.status == "valid"] == [200]


@pytest.fixture
def followed(live: Live, inbox: Any, sample: Sample) -> Iterator[tuple[Any, Any, Any]]:
    """A service that has heard ten samples, the leg's tokens, and its statuses."""
    with live() as life:
        tokens, got = inbox(), life.statuses(inbox)
        life.client.watch_tokens("robot/leg/*", tokens)
        life.deliver(*(sample(seq) for seq in range(1, 11)))
        tokens.wait(1)
        yield life, tokens, got


def test_a_leg_whose_servos_do_not_answer_is_silent(
    followed: tuple[Any, Any, Any], sample: Sample
) -> None:
    """Its samples go on, as a bridge sends them that has lost the bus."""
    life, tokens, got = followed
    mute = [False] * 3
    life.deliver(*(sample(seq, valid=mute) for seq in range(11, 240)))
    found = got.wait(lambda items: " for 4." in str(items[-1].note))[-1]
    assert found.status == "silent"
    assert re.fullmatch(r"no servo has answered for 4\.\d s", found.note)
    tokens.wait(2)
    life.idle(100)  # nothing comes at all: another fault, another word
    found = got.wait(lambda items: str(items[-1].note).startswith("no sample for 6."))[-1]
    assert found.status == "silent"
    life.deliver(*(sample(seq, valid=[True, False, True]) for seq in range(240, 340)))
    found = got.wait(lambda items: items[-1].status == "valid" and " 7." in items[-1].note)[-1]
    told = r"joint 2 has not answered for 7\.\d s: judged by the others"
    assert re.fullmatch(told, found.note)
    life.deliver(*(sample(seq) for seq in range(340, 400)))
    assert got.wait(lambda items: items[-1].note is None)[-1].status == "valid"
    tokens.wait(3)


def test_a_leg_whose_samples_are_all_refused_is_silent(
    followed: tuple[Any, Any, Any], sample: Sample
) -> None:
    life, tokens, got = followed
    life.deliver(*(sample(seq, measured=[math.nan, 0.0, 0.0]) for seq in range(11, 240)))
    found = got.wait(lambda items: " for 4." in str(items[-1].note))[-1]
    assert found.status == "silent"
    assert re.fullmatch(r"no usable sample for 4\.\d s: not_finite", found.note)
    tokens.wait(2)
    life.deliver(*(sample(seq) for seq in range(400, 410)))
    found = got.wait(lambda items: items[-1].status == "valid")[-1]
    assert found.note is None
    changes = tokens.wait(3)
    assert changes[:3] == [("robot/leg/rf", alive) for alive in (True, False, True)]


def test_a_leg_that_never_sent_a_usable_sample_says_why(
    live: Live, inbox: Any, sample: Sample
) -> None:
    with live() as life:
        got = life.statuses(inbox)
        life.deliver(*(sample(seq, measured=[0.1]) for seq in range(110)))
        found = got.wait(lambda items: " after 2." in str(items[-1].note))[-1]
        assert found.status == "silent"
        assert re.fullmatch(r"no usable sample yet, after 2\.\d s: wrong_joints", found.note)
        assert "robot/leg/rf" not in life.client.alive("robot/leg/*")


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("not_finite", {"measured": [math.nan, 0.0, 0.0]}),
        ("wrong_joints", {"desired": [0.1]}),
        ("out_of_range", {"measured": [1e9, 0.0, 0.0]}),
        ("time_backwards", {"t_ns": TICK}),
        ("duplicate_seq", {"seq": 2}),
        ("other_publisher", {"run": 1}),
    ],
)
def test_every_refusal_of_a_stream_is_logged_once_in_ten_seconds(
    live: Live, sample: Sample, reason: str, change: dict[str, Any]
) -> None:
    with live() as life, capture_logs() as logs:
        life.deliver(sample(1, run=1), *(sample(seq, run=2) for seq in range(2, 5)))
        for seq in range(5, 5 + 600):  # 24 s, a good sample after each bad one
            good = sample(seq, run=2)
            life.deliver(msgspec.structs.replace(good, **change), good)
        assert life.bank.learner("rf").rejects == {reason: 600}
        lines = [line for line in logs if line["log_level"] == "warning"]
    assert [line["leg"] for line in logs if line["event"] == "source restarted"] == ["rf"]
    assert [(line["event"], line["leg"], line["reason"], line["times"]) for line in lines] == [
        ("payload refused", "rf", reason, times) for times in (1, 250, 250)
    ]


def test_a_leg_that_cannot_say_how_it_is_begins_anew_and_says_that(
    live: Live, inbox: Any, sample: Sample
) -> None:
    """A fault outside of its ticks, too, is that leg's own; the log has its stack."""
    with live() as life, capture_logs() as logs:
        got = life.statuses(inbox)
        life.bank.learner("rf").fault = ZeroDivisionError("in its status")
        life.deliver(*(sample(seq) for seq in range(1, 100)))
        found = got.wait(lambda items: items[-1].status == "valid")[-1]
        assert found.note == "begun anew: in its status"
    (line,) = [line for line in logs if line["event"].startswith("fault in learning")]
    assert (line["leg"], str(line["exc_info"])) == ("rf", "in its status")
