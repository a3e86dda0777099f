"""A leg whose commanded lifts and lowerings cannot be judged is not valid for long."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from adaptive_contact import ContactLearner, ServoSample
from adaptive_contact.model import Baseline, shipped_baseline
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact_sim import SimulationSettings, record_arrays, simulated_robot

from .conftest import TOML, FakeLeg, samples, trained

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
    settings = SimulationSettings.of(kind, "pose" if kind == "leg5" else "walk")
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


def test_copies_in_swings_only_are_not_valid(known: Known) -> None:
    learner, swings = known.learner(), 0
    if learner.leg.chain is None:
        pytest.skip("without lengths_m no lift is compared with the model")
    for a, b in itertools.pairwise(known.stream):
        event = learner.update(replace(b, measured=b.desired) if b.phase == "swing" else b)
        swings += (a.phase, b.phase) == ("swing", "stance")
        if swings >= 3:
            assert learner.report._status in ("ambiguous", "learning"), b.seq
            assert event is None or not event.contact


@pytest.mark.parametrize("phase", [True, False])
def test_a_leg_that_is_judged_is_never_accused(known: Known, *, phase: bool) -> None:
    learner = known.learner()
    if learner.leg.chain is None and not phase:
        pytest.skip("without phase and lengths_m nothing is judged")
    for sample in known.stream:
        learner.update(sample if phase else replace(sample, phase=None))
        assert learner.report.doubt != "unjudged", sample.seq
