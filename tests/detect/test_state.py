"""The state in every tick, against the simulator's truth."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from adaptive_contact import ContactLearner
from adaptive_contact.compiled import records
from adaptive_contact.core.bank import LegGroup
from adaptive_contact.core.detect.layout import new_legs, scalars_of
from adaptive_contact.core.detect.state import hangs, update_load
from adaptive_contact.core.detect.touch_point import locate
from adaptive_contact.model import shipped_baseline
from adaptive_contact.robot import DetectorSettings, Robot, inverse
from adaptive_contact.wire import ContactEvent, LegState
from adaptive_contact_sim import (
    PoseSettings,
    SimulationSettings,
    WalkSettings,
    record_arrays,
    simulated_robot,
)
from adaptive_contact_sim.arrays import Run
from adaptive_contact_studies.evaluate import samples_of

HEXAPOD = simulated_robot("hexapod").description
Walked = tuple[Run, dict[str, list[LegState]], dict[str, list[ContactEvent]]]


def played(
    robot: Robot, run: Run, legs: list[str]
) -> tuple[dict[str, list[LegState]], dict[str, list[ContactEvent]]]:
    learners = [ContactLearner(robot, leg, shipped_baseline(robot.name)) for leg in legs]
    group = LegGroup(learners)
    states: dict[str, list[LegState]] = {leg: [] for leg in legs}
    events: dict[str, list[ContactEvent]] = {leg: [] for leg in legs}
    for samples in zip(*(samples_of(run, leg) for leg in legs), strict=True):
        for leg, learner, event in zip(legs, learners, group.advance(samples), strict=True):
            states[leg].append(learner.state)
            if event is not None:
                events[leg].append(event)
    return states, events


@pytest.fixture(scope="module")
def walk() -> Walked:
    """A walk whose commands know nothing of the ground."""
    settings = SimulationSettings.from_robot("hexapod", "walk")
    motion = WalkSettings(stop_on="never", phase="planned")
    run = record_arrays(dataclasses.replace(settings, motion=motion, seed=77), 25.0)
    return (run, *played(HEXAPOD, run, ["lf", "rm"]))


def test_it_is_right_in_stance_and_swing_where_the_gait_s_phase_is_not(walk: Walked) -> None:
    run, states, _ = walk
    for leg, own in states.items():
        known = np.array([state.known for state in own])
        said = np.array([state.contact for state in own])
        truth, phase = run.legs[leg].contact, ~run.legs[leg].swing
        assert known[len(known) // 2 :].all()
        right = (said == truth)[known].mean()
        assert right >= 0.9
        assert right > (phase == truth)[known].mean()
        p = np.array([state.p for state in own if state.p is not None])
        assert np.square(p - truth[known]).mean() < 0.08


def test_the_owner_s_settings_reach_every_tick(walk: Walked) -> None:
    run, _, _ = walk
    detector = DetectorSettings(touches_above=0.95, touches_below=0.9, strike_loss=0.7)
    states, _ = played(msgspec.structs.replace(HEXAPOD, detector=detector), run, ["lf", "rm"])
    for own in states.values():
        told = [state.p for state in own if state.contact]
        assert len(told) > 100
        assert min(told) > 0.9
    legs = new_legs(2, detector)
    assert legs["strike_loss"].tolist() == [0.7, 0.7]
    assert legs["lasting_ns"].tolist() == [60_000_000] * 2


def test_a_foot_that_is_lifted_is_released_within_three_ticks(walk: Walked) -> None:
    run, states, _ = walk
    late = []
    for leg, own in states.items():
        truth = run.legs[leg].contact
        for k in np.flatnonzero(truth[:-1] & ~truth[1:]) + 1:
            if own[k - 1].contact and not truth[k : k + 5].any():
                late.append(next(n for n in range(50) if not own[k + n].contact))
    assert len(late) >= 10
    assert np.median(late) <= 3


def test_an_event_says_where_the_foot_is_as_sure_as_it_is(walk: Walked) -> None:
    run, _, events = walk
    errors = []
    for leg, own in events.items():
        chain = HEXAPOD.leg(leg).chain
        for event in own:
            if not event.contact:
                assert event.foot_m is event.foot_sd_m is event.push is event.push_up is None
                continue
            off = np.subtract(event.foot_m, chain.foot(run.legs[leg].angle[event.seq]))
            errors.append(off / event.foot_sd_m)
    assert len(errors) >= 15
    assert 0.5 < np.sqrt(np.square(errors).mean()) < 1.5


def test_a_push_is_along_the_way_that_the_foot_was_moved() -> None:
    chain = HEXAPOD.leg("lf").chain
    q = [0.2, 0.4, -0.9]
    foot = np.array(chain.point(q))
    for moved in (np.array([0.0, 0.0, 1.0]), np.array([-0.6, 0.8, 0.0])):
        off = inverse(foot + 1e-6 * moved, [o[0] for o in chain.origins_m])
        off -= inverse(foot, [o[0] for o in chain.origins_m])
        point = locate(chain, q, off.tolist(), [0.001, 0.0, 0.0])
        np.testing.assert_allclose(point.foot_m, foot)
        np.testing.assert_allclose(point.push, moved, atol=1e-4)
        assert point.push_up == pytest.approx(moved[2], abs=1e-4)
        # The first joint turns about the upright: it moves the foot aside, and not up.
        reach = np.hypot(*foot[:2])
        assert np.linalg.norm(point.foot_sd_m) == pytest.approx(0.001 * reach, rel=1e-4)
        assert point.foot_sd_m[2] == pytest.approx(0.0, abs=1e-9)
    assert locate(chain, q, [0.0] * 3, [0.001] * 3).push is None


def test_a_leg_that_hangs_has_no_state() -> None:
    robot = simulated_robot("leg5").description
    settings = SimulationSettings.from_robot("leg5", "pose")
    assert isinstance(settings.motion, PoseSettings)
    run = record_arrays(dataclasses.replace(settings, seed=3), 30.0)
    states, _ = played(robot, run, ["leg"])
    assert not run.legs["leg"].contact.any()
    assert {(state.known, state.contact, state.p) for state in states["leg"]} == {
        (False, False, None)
    }


class Loaded:
    """A leg from a prior, by the scalars of its state."""

    def __init__(self) -> None:
        legs = new_legs(1)
        self.of, self.record = scalars_of(legs, 0), records(legs)[0]
        self.of.has_lengths = self.of.from_prior = True
        self.of.period_ns, self.of.variance_scale, self.of.stance_n = 20_000_000, 1.0, -1

    def carries(self, pushes: list[float], sums: list[float] | None = None) -> bool:
        """Whether it carries after stances with such pushes, whose sums grow to these."""
        for push, total in zip(pushes, sums or [0.0] * len(pushes), strict=True):
            self.of.ticks = 1
            update_load(self.record)
            self.of.ticks, self.of.push_sum = 0, push
            for k in range(12):
                self.of.push = total * k / 11
                update_load(self.record)
        self.of.ticks = 1
        update_load(self.record)
        return bool(self.of.carried)


def test_a_leg_is_lifted_where_its_load_falls_and_not_where_it_is_small() -> None:
    """Pushes of a stiff drive hardly reach the level of a leg that carries."""
    leg = Loaded()
    assert leg.carries([4.0] * 8)
    leg.of.idle_n = 500
    assert leg.carries([2.5] * 20)  # below the level
    assert leg.of.idle_n == 0
    assert leg.carries([2.5, 0.2] * 4)  # every other step into a hole
    assert not leg.carries([0.5] * 12)
    assert hangs(leg.record)
    leg.of.stands = 1  # all legs of the robot have the last word
    assert not hangs(leg.record)
    assert leg.carries([4.0] * 20)
    leg.of.stands = -1
    assert hangs(leg.record)


@pytest.mark.parametrize(
    ("sums", "carries"),
    [([25.0] * 9, True), ([25.0] * 4 + [9.0] + [25.0] * 4, False), ([9.0] * 30, False)],
)
def test_a_stiff_drive_carries_where_each_stance_goes_on_pushing(
    sums: list[float], carries: bool
) -> None:
    """Its push of one tick is that of a leg in the air whose model errs."""
    leg = Loaded()
    assert leg.carries([2.0] * len(sums), sums) is carries
    assert bool(leg.of.slight) is carries
