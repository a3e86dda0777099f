"""Several legs in pose together: each as if alone, on a robot that keeps standing."""

from __future__ import annotations

import numpy as np
import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact_sim import ObstacleSettings, Simulation, SimulationSettings, record_arrays
from adaptive_contact_sim.elements import LEGS
from adaptive_contact_sim.legs import LegGeometry
from adaptive_contact_sim.pose import WORKSPACES, PoseSettings
from adaptive_contact_sim.pose_group import TRIPODS, PoseGroupSettings
from tests.sim.touches import touches_of

GEOMETRY = LegGeometry()


def swings_of(swing: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], swing.astype(int), [0]])))
    return list(zip(edges[::2], edges[1::2], strict=True))


def test_a_trial_is_the_papers() -> None:
    """10 steps up, 10 down, between the subspaces, straight in space, 3 ticks of hold."""
    leg = record_arrays(SimulationSettings(seed=1), 25.0).legs["rf"]
    lower, upper = WORKSPACES["paper"]
    feet = GEOMETRY.feet(leg.desired)
    swings = swings_of(leg.swing)[:-1]
    assert len(swings) > 40
    slack = 0.0015  # of the goal registers' steps
    for begin, end in swings:
        assert end - begin == 20
        assert not leg.swing[end : end + 3].any()
        assert np.array_equal(
            leg.desired[end : end + 3], np.repeat(leg.desired[end - 1 : end], 3, 0)
        )
        for point, space in ((feet[end - 1], lower), (feet[begin + 9], upper)):
            low, high = space.height_m
            assert low - slack < point[2] < high + slack
            assert space.reach_m[0] - slack < np.hypot(*point[:2]) < space.reach_m[1] + slack
        for part in (feet[begin : begin + 10], feet[begin + 9 : end]):
            steps = np.diff(part, axis=0)
            # Equal steps, all in one direction.
            assert np.abs(steps - steps.mean(axis=0)).max() < 2.5 * slack
    assert upper.height_m[0] - lower.height_m[1] == pytest.approx(0.05)
    assert np.ptp(lower.height_m) == pytest.approx(0.05)
    assert np.ptp(upper.height_m) == pytest.approx(0.05)


def test_free_air_is_free_and_the_body_stands() -> None:
    run = record_arrays(SimulationSettings(seed=2), 30.0)
    assert len(run.legs["rf"].onsets) == 1  # standing at the start
    assert not run.legs["rf"].contact[60:].any()
    assert run.position_m[:, 2].min() > 0.15
    assert np.degrees(np.arccos(run.rotation[:, 2, 2])).max() < 5.0
    for leg in set(LEGS) - {"rf"}:
        assert not run.legs[leg].swing.any()
        assert run.legs[leg].contact.mean() > 0.99


@pytest.mark.parametrize(
    "approach",
    [
        "descent",
        "slow",
        *(pytest.param(way, marks=pytest.mark.slow) for way in ("graze", "forward")),
    ],
)
def test_obstacles_are_met_on_descents(approach: str) -> None:
    motion = PoseSettings(approach=approach, obstacles=ObstacleSettings(probability=1.0))
    run = record_arrays(SimulationSettings(motion=motion, seed=3), 30.0)
    leg = run.legs["rf"]
    ticks, onsets = zip(*((k, o) for k, o in touches_of(run, "rf") if k > 60), strict=True)
    swings = swings_of(leg.swing)
    assert len(onsets) >= 0.4 * len(swings)
    late = 0
    for tick in ticks:
        inside = [b for b, e in swings if b <= tick < e + 3]
        assert inside  # never while the leg moves between turns
        late += tick - inside[0] >= 10
    assert late >= 0.95 * len(onsets)  # in the descent, not the ascent
    speeds = np.array([o.speed_m_s for o in onsets if o.speed_m_s is not None])
    if approach == "slow":
        assert np.median(speeds) < 0.1
    else:
        assert np.median(speeds) > 0.3
    if approach == "graze":
        assert np.mean([o.grazing for o in onsets]) > 0.6
    # The obstacle leaves with the foot: no contact outlives the next ascent.
    longest = max(end - begin for begin, end in swings_of(leg.contact[60:]))
    assert longest < (140 if approach == "slow" else 35)


def test_legs_take_turns_without_a_swing_between() -> None:
    motion = PoseSettings(legs=LEGS, trials_per_turn=3)
    run = record_arrays(SimulationSettings(motion=motion), 25.0)
    swings = np.array([run.legs[leg].swing for leg in LEGS])
    assert swings.sum(axis=0).max() == 1
    moving = swings.argmax(axis=0)[swings.any(axis=0)]
    assert moving[np.diff(moving, prepend=-1) != 0][:6].tolist() == list(range(6))
    for leg in LEGS:
        begin, end = swings_of(run.legs[leg].swing)[0]
        assert end - begin == 20
    steps = np.abs(np.diff(run.legs["lm"].desired, axis=0))
    assert steps.max() < 0.6  # no jump on changing turns


# -- Several legs in pose together: each as if alone, on a robot that keeps standing


@pytest.mark.parametrize("legs", TRIPODS)
def test_the_robot_stands_while_three_legs_meet_obstacles(legs: tuple[str, ...]) -> None:
    obstacles = ObstacleSettings(probability=1.0, where=(0.15, 0.4))
    poses = tuple(PoseSettings(legs=(leg,), obstacles=obstacles) for leg in legs)
    sim = Simulation(SimulationSettings(motion=PoseGroupSettings(poses), seed=11))
    touched = dict.fromkeys(LEGS, 0)
    swinging = dict.fromkeys(LEGS, 0)
    for _ in range(600):
        sim.advance()
        position, rotation = sim.plant.body_pose()
        assert position[2] > 0.14
        assert np.degrees(np.arccos(rotation[2, 2])) < 15.0
        for change in sim.changes:
            own = change.touch is not None and change.contact
            if own and sim.plant.model.geom(change.touch.other).name.startswith("obstacle_"):
                touched[LEGS[change.leg]] += 1
        for leg, phase in zip(LEGS, sim.phase, strict=True):
            swinging[leg] += phase == "swing"
    for leg in LEGS:
        assert (touched[leg] >= 10) == (leg in legs), touched
        assert (swinging[leg] > 400) == (leg in legs), swinging


@pytest.mark.parametrize(
    ("poses", "found"),
    [
        ([("lf",), ("lm",)], "'lf', 'lm'"),
        ([("lf",), ("lf",)], "none of them twice"),
        ([("lf", "rm")], "one leg each"),
        ([], "expected some of"),
    ],
)
def test_a_group_the_robot_cannot_stand_without_is_refused(
    poses: list[tuple[str, ...]], found: str
) -> None:
    with pytest.raises(ConfigurationError, match=found):
        PoseGroupSettings(tuple(PoseSettings(legs=legs) for legs in poses))
