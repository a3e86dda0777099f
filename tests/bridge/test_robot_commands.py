"""``robot init | check | learn`` and the survey behind them, on virtual servos."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from described import AX

from adaptive_contact.bridge.discovery import find_servos
from adaptive_contact.bridge.training import (
    HELD_SWINGS,
    HELD_TICKS,
    REST_TICKS,
    free_swings,
)
from adaptive_contact.cli._robot_learning import pose_of
from adaptive_contact.cli._robot_picture import draw
from adaptive_contact.errors import AdaptiveContactError, BusError, ConfigurationError
from adaptive_contact.robot import Leg, Limits, foot, shipped_robot
from adaptive_contact.robot.gait_phase import infer_phase
from adaptive_contact.robot.write import write_robot
from programs import invoke, tried


def test_nobody_answers(rig: Callable, tmp_path: Path) -> None:
    r = rig(**AX)
    r.fault("silent:")
    with pytest.raises(BusError, match="no servo answers"):
        find_servos("p0", str(tmp_path / "p0"), bauds=(1_000_000,))


def test_learn_needs_lengths_and_asks_before_it_moves(rig: Callable, tmp_path: Path) -> None:
    r = rig(**AX)
    path = tmp_path / "robot.toml"
    path.write_text(write_robot(r.robot))
    with pytest.raises(ConfigurationError, match="has no lengths_m"):
        invoke("robot", "learn", "--config", str(path), "--drive", "--yes")
    with pytest.raises(ConfigurationError, match="expected 3 angles in rad"):
        pose_of("0,x", r.robot, r.plans)
    assert pose_of("0,0.5,-1", r.robot, r.plans) == [0.0, 0.5, -1.0]
    with pytest.raises(ConfigurationError, match=r"joint 'j1' of leg 'l0' may go from -1.00 to 1"):
        pose_of("0,1.5,-1", r.robot, r.plans)
    legs = tuple(msgspec.structs.replace(x, lengths_m=(0.05, 0.06, 0.1)) for x in r.robot.legs)
    path.write_text(write_robot(msgspec.structs.replace(r.robot, legs=legs)))
    words = ("--config", path, "--drive", "--pose", "0,0.5,-1", "--out", tmp_path / "b.json")
    result = tried("robot", "learn", *words, input="n\n")
    assert result.exit_code == 1
    assert "around 0.0, 0.5, -1.0 rad" in result.output
    assert all(s.writes == 0 for s in r.port.servos)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("robot", "init"), "which port"),
        (("robot", "init", "--device", "/nowhere"), "does not exist"),
        (("bridge", "dynamixel"), "has no port; add"),
        (("bridge", "dynamixel", "--config", "model.toml"), "^model.toml: .*unknown servo model"),
        (
            ("bridge", "dynamixel", "--config", "baud.toml"),
            "^baud.toml: port.baud is 12; expected at least 1200",
        ),
        (("robot", "check"), "or give --live to look at the samples of its source"),
        (("robot", "check", "--config", "model.toml"), "^model.toml: .*unknown servo model 'QQ'"),
        (("robot", "learn", "--config", "model.toml"), "^leg 'l' has no lengths_m or origins_m, "),
        (("bridge", "dynamixel", "--device", "/nowhere"), "does not exist"),
        (("bridge", "feetech", "--device", "/nowhere"), "does not exist"),
        (("bridge", "virtual", "--fault", "broken"), "expected one of silent"),
        (("bridge", "virtual", "--record", "x.mcap"), "needs --scenario"),
        (("bridge", "virtual", "--servos", "STS9"), "unknown servo model 'STS9'"),
        (("bridge", "virtual", "--ports", "9"), "9 ports for 6 legs"),
        (("bridge", "virtual", "--config", "quadruped", "--ports", "2"), "has ports of its own"),
        (("bridge", "virtual", "--write-config", "/nonexist/x.toml"), "another --write-config"),
        (("bridge", "virtual", "--fault", "silent@1.2.3"), "times are in seconds"),
        (("bridge", "virtual", "--fault", "silent:id=99"), "there is no such servo; ids are 1, 2"),
        (("bridge", "virtual", "--fault", "hangup:port=x"), "there is no such port; there are p"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(
    words: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, baud, model in (("model", 1_000_000, "QQ"), ("baud", 12, "AX-12A")):
        (tmp_path / f"{name}.toml").write_text(
            '[robot]\nname = "r"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
            f'[port.a]\ndevice = "/x"\nbaud = {baud}\n[[leg]]\nid = "l"\njoints = ["a"]\n'
            f'servos = {{ ids = [1], model = "{model}" }}\n'
        )
    with pytest.raises(AdaptiveContactError, match=message):
        invoke(*words)


def test_a_rate_that_no_adapter_has_is_refused() -> None:
    result = tried("bridge", "dynamixel", "--device", "/x", "--baud", "12")
    assert result.exit_code == 2
    assert "greater than or equal to 1200" in result.output


def leg(**changes: object) -> Leg:
    base = Leg(id="l", joints=("a", "b", "c"), lengths_m=(0.05, 0.06, 0.1))
    return msgspec.structs.replace(base, **changes)


@pytest.mark.parametrize("seed", range(5))
def test_free_swings_keep_limits_and_steps_and_are_swings(seed: int) -> None:
    limits = Limits((-0.5, -0.6, -0.7), (0.5, 0.6, 0.7))
    one = leg(limits=limits)
    goals = free_swings(
        one, [0.0, 0.3, 0.5], np.random.default_rng(seed), amplitude_rad=0.4, max_step_rad=0.15
    )
    rows = np.array([next(goals) for _ in range(1500)])
    assert np.abs(np.diff(rows, axis=0)).max() <= 0.15 + 1e-9
    assert (rows >= np.array(limits.lower_rad)).all()
    assert (rows <= np.array(limits.upper_rad)).all()
    assert np.abs(rows - np.array([0.0, 0.3, 0.5])).max() <= 0.4 + 1e-9
    swing = infer_phase(rows, one)
    share = swing.mean()
    assert 0.5 < share < 0.98
    swings = int(np.sum(np.diff(swing.astype(int)) == 1))
    assert swings > 1500 / (2 * 18 + REST_TICKS) * 0.8


def test_free_swings_hold_still_now_and_then_for_gravity_to_show() -> None:
    goals = free_swings(
        leg(), [0.0, 0.3, 0.5], np.random.default_rng(3), amplitude_rad=0.4, max_step_rad=0.15
    )
    rows = np.array([next(goals) for _ in range(1500)])
    still = (np.diff(rows, axis=0) == 0).all(axis=1)
    runs = [len(list(ticks)) for same, ticks in itertools.groupby(still) if same]
    assert sum(run >= HELD_TICKS - 1 for run in runs) >= 1500 // (HELD_SWINGS * 40 + HELD_TICKS)


def test_a_leg_that_cannot_swing_says_so() -> None:
    rng = np.random.default_rng(1)
    goals = free_swings(leg(), [0, 0, 0], rng, amplitude_rad=0.01, max_step_rad=0.1)
    with pytest.raises(ConfigurationError, match="cannot lift its foot"):
        next(goals)


def test_the_picture_ends_where_the_foot_is() -> None:
    one = leg()
    assert one.chain is not None
    points = one.chain.frames([0.2, 0.4, -0.9])[0]
    assert points[-1] == pytest.approx(foot([0.2, 0.4, -0.9], one.lengths_m, one.joint_axes))
    assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(one.lengths_m)
    text = draw(shipped_robot(), {x: [0.0, 0.1, -0.5] for x in shipped_robot().leg_ids})
    assert text.count('class="link"') == 6 * 3 * 3
    assert "coxa +0.0°, link 52 mm, sign +1, offset +0.00 rad" in text


def arrows(text: str) -> list[tuple[float, float, float, float]]:
    """Of every arrow around a joint: where it begins, and where it ends."""
    found = re.findall(r'd="M ([-\d.]+) ([-\d.]+) A .*? 0 0 0 ([-\d.]+) ([-\d.]+)"', text)
    return [tuple(map(float, each)) for each in found]


def test_the_picture_says_where_front_is_and_which_way_angles_grow() -> None:
    robot = shipped_robot()
    text = draw(robot, {x: [0.0, 0.0, 0.0] for x in robot.leg_ids})
    assert "front (x)" in text
    assert "left (y) left" in text
    turned = arrows(text)
    assert len(turned) == 6 * 3  # a yaw of each leg on the body, two pitches beside it
    for _, begin_y, _, end_y in turned[6:]:
        assert end_y < begin_y - 5  # pitch plus is up, and y of a picture points down
    ends = dict(zip(robot.leg_ids, turned[:6], strict=True))
    assert ends["rm"][3] < ends["rm"][1] - 5  # yaw plus takes the right middle leg to the front
    assert ends["lm"][3] > ends["lm"][1] + 5  # and the left one to the rear
