"""The books of a soak: each sample, event, state and cut link is counted, whoever was killed."""

from __future__ import annotations

import math
from typing import Any

import pytest

from adaptive_contact.service.state.keeper import StateFacts
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

pytest.importorskip("mujoco")

from . import accounts
from .conduct import Broken, Heard
from .made import ROBOT, S, event, take

SENT = {seq * 20_000_000: seq for seq in range(1, 1001)}


def status(seq: int, ticks: int, missed: int, **fields: object) -> LearnerStatus:
    return LearnerStatus(
        leg="rf",
        t_ns=seq * 20_000_000,
        status=fields.get("word", "valid"),  # type: ignore[arg-type]
        model_version=1,
        residual_rms=[],
        noise_floor=[],
        ticks=ticks,
        missed=missed,
    )


def heard(*statuses: LearnerStatus) -> Heard:
    return Heard(statuses=[(at, one) for at, one in enumerate(statuses)])


def test_every_sample_is_accounted_for() -> None:
    whole = heard(status(10, 4, 0), status(60, 50, 4), status(200, 94, 100))
    assert accounts.uncounted("rf", SENT, take(whole)) == 0
    # A crash: ticks go back to the last save, what came since counts as missed.
    crashed = heard(status(100, 100, 0), status(200, 150, 50), status(0, 120, 0))
    assert accounts.uncounted("rf", SENT, take(crashed)) == 0


def test_a_loss_that_nobody_counted_is_found() -> None:
    lost = heard(status(10, 10, 0), status(60, 55, 2), status(100, 97, 3))
    assert accounts.uncounted("rf", SENT, take(lost)) == 3
    twice = heard(status(10, 10, 0), status(60, 60, 5))
    assert accounts.uncounted("rf", SENT, take(twice)) == 5


def test_events_must_rest_on_samples_and_come_once() -> None:
    good = Heard(events=[(0, event(10)), (1, event(30))])
    assert accounts.inconsistent(take(good), {"rf": SENT}) == 0
    bad = [event(10), event(10), event(11, t_ns=5), event(12, onset_ns=S), event(5000)]
    wrong = Heard(events=[(n, one) for n, one in enumerate(bad)])
    assert accounts.inconsistent(take(wrong), {"rf": SENT}) == 4


def service(instance: str, *, cut_off: int = 0, **state: Any) -> ServiceStatus:
    facts = {"restored": [], "refused": [], "saved": 0, "failed": 0, "error": None, **state}
    return ServiceStatus(
        version="0",
        robot="r",
        period_s=0.02,
        baseline=None,
        legs={},
        uptime_s=1.0,
        instance=instance,
        cut_off=cut_off,
        state=StateFacts(folder="f", **facts),
    )


def test_a_subscriber_cut_off_counts_unless_a_fault_did_it() -> None:
    broken = (Broken("router", 10 * S, 12 * S),)

    def counted(*told: tuple[int, int]) -> int:
        services = [(at * S, service("a", cut_off=count)) for at, count in told]
        return accounts.cut_off(take(Heard(services=services), broken))

    assert counted((1, 0), (2, 0), (9, 0)) == 0
    assert counted((9, 0), (13, 1), (14, 1), (20, 1)) == 0
    assert counted((1, 0), (2, 1), (9, 1), (13, 1)) == 1
    assert counted((15, 0), (16, 2)) == 2
    assert counted((1, 1)) == 1


def test_state_is_counted_over_all_lives() -> None:
    """A life that was killed cannot hide what it failed to save."""
    lives = accounts.last_words(
        [
            service("a", saved=3),
            service("a", saved=5, failed=1),
            service("b", saved=2, restored=["rf"], refused=["lf: torn"]),
        ]
    )
    assert accounts.state_of(lives) == {
        "saved": 7,
        "failed": 1,
        "restored": ["rf"],
        "refused": ["lf: torn"],
    }
    assert accounts.state_of([]) == {}


def test_what_a_kill_cost_is_told_from_the_counts() -> None:
    kill = Broken("service", 500 * S, 501 * S)

    def cost(*told: tuple[int, LearnerStatus]) -> float:
        statuses = [(at * S, one) for at, one in told]
        return accounts.forgotten_s("rf", SENT, take(Heard(statuses=statuses)), kill, ROBOT)

    before, silent = (499, status(600, 600, 0)), (502, status(0, 300, 0))
    assert cost(before, silent, (503, status(700, 320, 380))) == pytest.approx(5.6)
    assert cost(before, (503, status(700, 640, 60))) < 0.0
    assert cost(before) == math.inf
    # None of it is uncounted.
    whole = heard(before[1], status(700, 320, 380))
    assert accounts.uncounted("rf", SENT, take(whole)) == 0
