"""Sources whose samples say nothing of the leg.

Readings of another leg or none, swings that cannot be judged.  Golden recordings and
``tests/field`` have copied commands, swapped phases and two publishers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from adaptive_contact import ContactLearner, LearnerBank, ServoSample
from adaptive_contact.core.learn.mode import WhenAmbiguous
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.robot import Robot, parse_robot, shipped_robot
from adaptive_contact.wire import ContactEvent, Doubt
from adaptive_contact_sim import SimulationSettings, WalkSettings, record_arrays, simulated_robot

from .conftest import TOML, FakeLeg, outcomes, play, samples, trained

PERIOD = 28  # ticks from one swing of the fake leg to the next


def learner_of(
    robot: Robot, baseline: Baseline, conduct: WhenAmbiguous = WhenAmbiguous.WITHHOLD
) -> ContactLearner:
    return ContactLearner(robot, "rf", baseline, when_ambiguous=conduct)


# -- what is reported of an ambiguous leg ----------------------------------------------------------


def touching(count: int, touches: range) -> list[ServoSample]:
    return FakeLeg(seed=5).stream(count, touch=lambda n: 17 if n in touches else None)


def ambiguous_from(
    learner: ContactLearner,
    stream: list[ServoSample],
    begin: int,
    end: int,
    doubt: Doubt = "descents",
) -> list[ContactEvent]:
    """Play, with the leg ambiguous from one tick to another."""
    events = play(learner, stream[:begin])
    adapter = learner.lifecycle.adapter
    for sample in stream[begin:end]:
        if doubt == "descents":
            adapter.early.reported = True
        else:
            adapter.monitor.status = "ambiguous"
        learner.report.publish_withholding()  # what an assessed swing does
        event = learner.update(sample)
        events += [] if event is None else [event]
    adapter.early.forget()
    adapter.monitor.status = "valid"
    learner.report.publish_withholding()
    return events + play(learner, stream[end:])


@pytest.mark.parametrize(
    ("conduct", "doubt", "withheld"),
    [
        (WhenAmbiguous.PUBLISH, "descents", False),
        (WhenAmbiguous.PUBLISH, "unsettled", False),
        (WhenAmbiguous.WITHHOLD, "unsettled", False),
        (WhenAmbiguous.WITHHOLD, "descents", True),
        (WhenAmbiguous.STRICT, "unsettled", True),
    ],
)
def test_whoever_runs_the_service_says_what_is_withheld(
    robot: Robot, baseline: Baseline, conduct: WhenAmbiguous, doubt: Doubt, withheld: bool
) -> None:
    """A leg that only fits badly is where that is asked; all is published where that is."""
    stream = touching(40, range(20, 40))
    learner = learner_of(robot, baseline, conduct)
    events = ambiguous_from(learner, stream, 25 * PERIOD, 30 * PERIOD, doubt)
    within = [e for e in events if 25 * PERIOD < e.seq < 30 * PERIOD and e.score > 1.0]
    assert {(e.doubt, e.contact, e.withheld) for e in within} == {(doubt, not withheld, withheld)}
    told = play(learner_of(robot, baseline), stream)
    assert withheld or [(e.seq, e.contact) for e in events] == [(e.seq, e.contact) for e in told]


def test_turned_readings_are_a_foot_that_does_not_rise(robot: Robot, baseline: Baseline) -> None:
    stream = FakeLeg(seed=5).stream(40)
    middle = np.median([s.measured for s in stream], axis=0)
    made = [
        s if k < 30 * PERIOD else msgspec.structs.replace(
            s, measured=(2 * middle - np.array(s.measured)).tolist()
        )
        for k, s in enumerate(stream)
    ]  # fmt: skip
    learner = learner_of(robot, baseline)
    play(learner, made[: 34 * PERIOD])
    assert learner.status.status == "ambiguous"
    assert learner.status.doubt in ("held", "far")


def test_a_leg_that_sends_another_legs_readings_is_named_and_the_other_goes_on() -> None:
    """One variable for two publishers, for some strides."""
    robot = shipped_robot()
    settings = SimulationSettings(motion=WalkSettings(), seed=3)
    run = record_arrays(settings, 22.0)
    legs = {name: samples(of.measured, of.desired, of.swing) for name, of in run.legs.items()}
    bank = LearnerBank(robot, shipped_baseline(robot.name))
    begin, end, within = 400, 800, list[str | None]()
    for k in range(1100):
        tick = {name: stream[k] for name, stream in legs.items() if name in ("lf", "lm", "rr")}
        if begin <= k < end:
            tick["lf"] = msgspec.structs.replace(tick["lf"], measured=tick["rr"].measured)
        bank.update(tick)
        learner, owner = bank.learner("lf"), bank.learner("rr")
        assert owner.report.doubt != "stale"
        if begin + 300 <= k < end:
            within.append(learner.report.doubt)
            assert "measured is that of leg 'rr'" in (learner.status.note or "")
    assert set(within) == {"stale"}
    assert learner.report.source.cause is None


# -- Angles a turn off

SWINGS = 160
STOPS = [16 if n % 2 else None for n in range(SWINGS)]
TURN = 2.0 * math.pi


@pytest.fixture(scope="module")
def walk() -> list[ServoSample]:
    return FakeLeg(seed=31).stream(SWINGS, touch=lambda n: STOPS[n])


@pytest.fixture(scope="module")
def clean(robot: Robot, baseline: Baseline, walk: list[ServoSample]) -> list[str]:
    """What is found of the walk as it is; a foot that is stopped dead is refused nothing."""
    learner = ContactLearner(robot, "rf", baseline)
    found = told(learner, walk)
    assert found.count("hit") > 70
    assert not learner.status.rejects
    return found


def told(learner: ContactLearner, stream: list[ServoSample]) -> list[str]:
    return outcomes(play(learner, stream), range(SWINGS), STOPS)


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_seam_in_the_travel_is_no_movement(
    robot: Robot, baseline: Baseline, walk: list[ServoSample], clean: list[str], joint: int
) -> None:
    """Readings and commands come in one turn that begins in the middle of the joint's travel."""
    middle = float(np.median([s.measured[joint] for s in walk]))

    def wrapped(angles: list[float]) -> list[float]:
        turned = list(angles)
        turned[joint] = middle + (angles[joint] - middle + walk_turn) % TURN - walk_turn
        return turned

    # The turn that holds the first command as the description counts it.
    walk_turn = 0.0 if walk[0].desired[joint] >= middle else TURN
    stream = [
        msgspec.structs.replace(s, measured=wrapped(s.measured), desired=wrapped(s.desired))
        for s in walk
    ]
    jumps = np.abs(np.diff([s.measured[joint] for s in stream])) > math.pi
    assert jumps.sum() > 50
    learner = ContactLearner(robot, "rf", baseline)
    assert told(learner, stream) == clean
    assert not learner.status.rejects


# -- A leg whose commanded lifts and lowerings cannot be judged is not valid for long

# What no swing can be judged of.
FAULTS: dict[str, Callable[[ServoSample], ServoSample]] = {
    "a tenth slower": lambda s: replace(s, t_ns=round(1.1 * s.t_ns)),
    "faster": lambda s: replace(s, t_ns=round(0.85 * s.t_ns)),
    "always stance": lambda s: replace(s, phase="stance"),
}


class Known(NamedTuple):
    """A leg that is known, and what its source sends."""

    robot: Robot
    leg: str
    baseline: Baseline | None
    stream: list[ServoSample]

    def learner(self) -> ContactLearner:
        return ContactLearner(self.robot, self.leg, self.baseline)


@pytest.fixture(scope="module", params=["fake", "bare", "hexapod", "quadruped12", "leg5"])
def known(request: pytest.FixtureRequest) -> Known:
    kind: str = request.param
    if kind == "fake":
        robot, baseline = (request.getfixturevalue(name) for name in ("robot", "baseline"))
        return Known(robot, "rf", baseline, FakeLeg(seed=2).stream(6))
    if kind == "bare":  # without geometry the joints show it
        robot = parse_robot(TOML.replace("lengths_m", "# "), source="bare")
        baseline = trained(robot, FakeLeg(seed=1).run(320))
        return Known(robot, "rf", baseline, FakeLeg(seed=2).stream(6))
    robot = simulated_robot(kind).description
    settings = SimulationSettings.from_robot(kind, "pose" if kind == "leg5" else "walk")
    leg, period_ns = robot.leg_ids[0], round(robot.period_s * 1e9)
    arrays = record_arrays(settings, 4.0).legs[leg]
    stream = samples(arrays.measured, arrays.desired, arrays.swing)
    stream = [replace(s, t_ns=s.seq * period_ns) for s in stream]
    return Known(robot, leg, shipped_baseline(robot.name), stream)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_leg_of_which_nothing_is_judged_is_not_valid(known: Known, fault: str) -> None:
    learner, stream = known.learner(), known.stream
    ends = [
        a.seq for a, b in itertools.pairwise(stream) if (a.phase, b.phase) == ("swing", "stance")
    ]
    for sample in stream:
        learner.update(FAULTS[fault](sample))
        if sample.seq > ends[2]:  # of the first the beginning may be missing
            assert learner.report._status == "ambiguous", sample.seq
    status = learner.status
    assert status.doubt == "unjudged"
    assert status.note is not None
    assert not status.contact
    # Once the source is right, it ends with the first swing that is judged.
    for sample in stream:
        learner.update(replace(sample, t_ns=2 * stream[-1].t_ns + sample.t_ns, run=1))
    assert learner.status.doubt is None


@pytest.mark.parametrize("phase", [True, False])
def test_a_leg_that_is_judged_is_never_accused(known: Known, *, phase: bool) -> None:
    learner = known.learner()
    if learner.leg.chain is None and not phase:
        pytest.skip("without phase and lengths_m nothing is judged")
    for sample in known.stream:
        learner.update(sample if phase else replace(sample, phase=None))
        assert learner.report.doubt != "unjudged", sample.seq
