"""The soak's own arithmetic: a verdict that cannot be wrong by accident."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.wire import ContactEvent, LearnerStatus

pytest.importorskip("mujoco")

from adaptive_contact_sim.drift_spec import parse_drift
from adaptive_contact_sim.soak import verdict
from adaptive_contact_sim.soak.conduct import Broken, Heard, Resident, Take
from adaptive_contact_sim.soak.plan import SoakPlan

S = 1_000_000_000
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


def event(seq: int, *, t_ns: int | None = None, onset_ns: int = 0) -> ContactEvent:
    return ContactEvent(
        leg="rf",
        t_ns=seq * 20_000_000 if t_ns is None else t_ns,
        seq=seq,
        onset_ns=onset_ns,
        contact=True,
        status="valid",
        score=2.0,
        residual=[],
        model_version=1,
    )


def take(heard: Heard, broken: tuple[Broken, ...] = ()) -> Take:
    return Take(Path("none"), heard, broken, (), "")


def heard(*statuses: LearnerStatus) -> Heard:
    return Heard(statuses=[(at, one) for at, one in enumerate(statuses)])


def test_every_sample_is_accounted_for() -> None:
    whole = heard(status(10, 4, 0), status(60, 50, 4), status(200, 94, 100))
    assert verdict._uncounted("rf", SENT, take(whole)) == 0
    # A crash: ticks go back to the last save, what came since counts as missed.
    crashed = heard(status(100, 100, 0), status(200, 150, 50), status(0, 120, 0))
    assert verdict._uncounted("rf", SENT, take(crashed)) == 0


def test_a_loss_that_nobody_counted_is_found() -> None:
    lost = heard(status(10, 10, 0), status(60, 55, 2), status(100, 97, 3))
    assert verdict._uncounted("rf", SENT, take(lost)) == 3
    twice = heard(status(10, 10, 0), status(60, 60, 5))
    assert verdict._uncounted("rf", SENT, take(twice)) == 5


def test_events_must_rest_on_samples_and_come_once() -> None:
    good = Heard(events=[(0, event(10)), (1, event(30))])
    assert verdict._inconsistent(take(good), {"rf": SENT}) == 0
    bad = [event(10), event(10), event(11, t_ns=5), event(12, onset_ns=S), event(5000)]
    wrong = Heard(events=[(n, one) for n, one in enumerate(bad)])
    assert verdict._inconsistent(take(wrong), {"rf": SENT}) == 4


def test_windows_last_until_two_seconds_after_the_cause() -> None:
    plan = SoakPlan(minutes=10.0)
    windows = verdict._windows(
        take(Heard(), (Broken("router", 5 * S, 7 * S),)), plan, epoch_ns=1000 * S
    )
    assert windows[0] == (5 * S, 9 * S)
    assert len(windows) == 1 + len(plan.drifts)
    times = np.array([4 * S, 6 * S, 9 * S, 9 * S + 1])
    assert verdict._outside(times, windows[:1]).tolist() == [True, False, False, True]


def test_memory_is_judged_per_life_after_the_warm_up() -> None:
    rows = [Resident(0, float(s), 100.0 + (20.0 if s > 60 else s / 3)) for s in range(0, 600, 2)]
    rows += [Resident(1, float(s), 100.0 + s / 60) for s in range(0, 600, 2)]
    rows.append(Resident(1, 601.0, float("nan")))
    flat, growing = verdict._memory(tuple(rows), warm_up_s=60.0)
    assert flat[0] == 0.0
    assert 6.0 < growing[0] < 9.0


def test_the_plan_is_one_that_the_simulator_takes() -> None:
    for minutes in (1.0, 30.0, 600.0):
        plan = SoakPlan(minutes=minutes)
        kinds = [fault.kind for fault in plan.faults]
        assert sorted(kinds) == ["router", "router", "service"]
        for drift in plan.drifts:
            assert parse_drift(drift.option).at_s == pytest.approx(drift.at_s)
            assert drift.at_s + drift.duration_s < plan.seconds
    with pytest.raises(ConfigurationError, match="expected 1 to 1440 min"):
        SoakPlan(minutes=0.5)
