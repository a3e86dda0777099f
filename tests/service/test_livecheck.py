"""``robot check --live``: what any source's samples say of signs, order, zeros, range and rate."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from adaptive_contact.checks.livecheck import LiveCheck, LiveReport
from adaptive_contact.cli._robot_check import report_lines
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.notes import speaks_of_angles
from adaptive_contact.robot import Leg, Mount, Robot, foot, shipped_robot
from adaptive_contact.service.link import NoRouterError
from adaptive_contact.wire import MSGPACK, ServoSample, encode, servo_key
from adaptive_contact.wire.received import Received
from programs import tried

PERIOD_NS = 20_000_000
STANDING = (0.0, 0.6, -1.8)
TICKS = 1000


def sample(seq: int, measured: Sequence[float], desired: Sequence[float] | None = None):
    told = list(measured) if desired is None else list(desired)
    return ServoSample(
        t_ns=10**18 + seq * PERIOD_NS, seq=seq, measured=list(measured), desired=told, run=1
    )


def received(leg: str, one: ServoSample) -> Received:
    return Received(servo_key(leg), encode(one), MSGPACK, 0, None)


@functools.cache
def walk() -> list[tuple[str, ServoSample]]:
    from adaptive_contact_sim.arrays import record_arrays
    from adaptive_contact_sim.simulation import SimulationSettings
    from adaptive_contact_sim.walk import WalkSettings

    motion = WalkSettings(gait="tripod", stop_on="truth", react_ms=60.0)
    run = record_arrays(SimulationSettings(motion=motion, seed=31), TICKS * PERIOD_NS / 1e9)
    return [
        (name, sample(k, leg.measured[k].tolist(), leg.desired[k].tolist()))
        for k in range(TICKS)
        for name, leg in run.legs.items()
    ]


def turned(samples: list[tuple[str, ServoSample]], turn: Callable) -> list[tuple[str, ServoSample]]:
    """The samples of a source that counts otherwise."""
    return [
        (
            leg,
            msgspec.structs.replace(
                one,
                measured=np.asarray(turn(np.array(one.measured))).tolist(),
                desired=np.asarray(turn(np.array(one.desired))).tolist(),
            ),
        )
        for leg, one in samples
    ]


def report(samples: list[tuple[str, ServoSample]], robot: Robot | None = None) -> LiveReport:
    check = LiveCheck(robot or shipped_robot())
    for leg, one in samples:
        check.process_message(received(leg, one))
    return check.report(TICKS * PERIOD_NS / 1e9)


def test_a_robot_that_walks_as_described_is_confirmed() -> None:
    found = report(walk())
    assert found.findings == []
    assert found.exit_code == 0
    assert found.confirmed == list(shipped_robot().leg_ids)
    assert found.open == []
    leg = found.legs[0]
    last = next(one for name, one in reversed(walk()) if name == leg.leg)
    place = foot(last.measured, shipped_robot().legs[0].lengths_m, ("yaw", "pitch", "pitch"))
    assert leg.rate_hz == pytest.approx(50.0)
    assert leg.height_m == pytest.approx(place[2])
    assert leg.reach_m == pytest.approx(np.hypot(place[0], place[1]))
    assert [joint.axis for joint in leg.joints] == ["yaw", "pitch", "pitch"]


WAYS = {
    "pitch downwards": (lambda q: q * [1, -1, -1], "directions = [1, -1, -1]"),
    "tibia first": (lambda q: q[::-1], "in the order coxa, femur, tibia"),
    "another zero": (lambda q: q - [0, 0.3, -0.6], "offsets_rad = ["),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_source_that_counts_otherwise_is_told_what_to_write(way: str) -> None:
    turn, advice = WAYS[way]
    found = report(turned(walk(), turn))
    assert found.exit_code == 1
    signs = [finding for finding in found.findings if finding.cause == "signs"]
    assert len(signs) == 1
    assert signs[0].legs == list(shipped_robot().leg_ids)
    assert speaks_of_angles(signs[0].what)
    assert advice in signs[0].what
    if way == "another zero":  # found by search, to 0.01 rad
        zeros = signs[0].what.partition(advice)[2].partition("]")[0]
        assert [float(zero) for zero in zeros.split(",")] == pytest.approx([0, 0.3, -0.6], abs=0.03)
    assert found.confirmed == []


def moved(*poses: Sequence[float], leg: str = "lf", robot: Robot | None = None) -> list[str]:
    """What is said of a leg that is held in poses, with a move of a second between them."""
    check = LiveCheck(robot or shipped_robot())
    seq = 0
    for k, pose in enumerate(poses):
        start = np.array(poses[max(k - 1, 0)])
        for share in (*np.linspace(0, 1, 50), *[1.0] * 25):
            check.process_message(
                received(leg, sample(seq, (start + share * (np.array(pose) - start)).tolist()))
            )
            seq += 1
    return check.moves


def test_a_joint_moved_by_hand_is_named_with_the_way_its_foot_went() -> None:
    leg = shipped_robot().leg("lf")
    raised = (0.0, 1.1, -1.8)
    was, came = (foot(pose, leg.lengths_m, leg.joint_axes)[2] for pose in (STANDING, raised))
    (up,) = moved(STANDING, raised)
    assert up.startswith(f"lf: femur +28.6°: the foot went up by {1e3 * (came - was):.0f} mm and")
    (left,) = moved(STANDING, (0.4, 0.6, -1.8))
    assert left.startswith("lf: coxa +22.9°: the foot went back by")
    assert " and left by " in left
    assert moved(STANDING, (0.0, 0.65, -1.8)) == []  # 3 degrees are no move


def hanging(yaw_rad: float = 0.0) -> Robot:
    """A leg that hangs straight down at 0, and rolls at its hip."""
    leg = Leg(
        id="lf",
        joints=("roll", "hip", "knee"),
        axes=("roll", (0, 1, 0), (0, 1, 0)),
        origins_m=((0.0, 0.05, 0.0), (0.0, 0.0, -0.2), (0.0, 0.0, -0.2)),
        mount=Mount(xyz_m=(0.2, 0.1, 0.0), yaw_rad=yaw_rad),
    )
    return Robot(name="r", period_s=0.02, quantum_rad=0.005, legs=(leg,))


def test_the_way_of_a_foot_is_told_along_the_body_s_axes() -> None:
    zero = (0.0, 0.0, 0.0)
    [back] = moved(zero, (0.0, 0.25, 0.0), robot=hanging())
    assert back == f"lf: hip +14.3°: the foot went back by {400 * np.sin(0.25):.0f} mm"
    [left] = moved(zero, (0.25, 0.0, 0.0), robot=hanging())
    assert "roll +14.3°: the foot went left by " in left
    [both] = moved(zero, (0.0, 0.6, -1.2), robot=hanging())
    assert "the foot went up by 70 mm" in both
    # A leg that is mounted a quarter turn to the left goes there.
    [right] = moved(zero, (0.0, 0.25, 0.0), robot=hanging(np.pi / 2))
    assert "the foot went right by 99 mm" in right


def test_a_chain_that_no_motion_confirms_is_said_to_be_checked_by_hand() -> None:
    poses = [(0.1 * math.sin(k / 9), 0.6 + 0.2 * math.sin(k / 7), -1.2) for k in range(300)]
    found = report([("lf", sample(k, pose)) for k, pose in enumerate(poses)], hanging())
    assert found.open == found.by_hand == ["lf"]
    assert found.confirmed == []
    assert [joint.axis for joint in found.legs[0].joints] == ["roll", "0 1 0", "0 1 0"]
    [line] = [line for line in report_lines(found) if "by hand" in line]
    assert line.startswith("signs, order and zeros of leg lf: not confirmed by the motion")
    place = hanging().leg("lf").chain.foot(poses[-1])  # type: ignore[union-attr]
    assert found.legs[0].forward_m == pytest.approx(0.2 + place[0])
    assert found.legs[0].left_m == pytest.approx(0.1 + place[1])


def still(poses: dict[str, Sequence[float]], ticks: int = 60) -> list[tuple[str, ServoSample]]:
    return [(leg, sample(k, pose)) for k in range(ticks) for leg, pose in poses.items()]


def test_feet_of_a_robot_that_stands_show_a_zero_that_is_off() -> None:
    poses = dict.fromkeys(shipped_robot().leg_ids, STANDING)
    flat = report(still(poses))
    assert abs(flat.flatness.off_m) < 1e-9
    # Nothing is said of signs where nothing walks.
    assert (flat.findings, flat.confirmed, flat.open) == ([], [], list(shipped_robot().leg_ids))
    off = report(still({**poses, "rm": (0.0, 0.6 + 0.25, -1.8)})).flatness
    leg = shipped_robot().leg("rm")
    up = foot((0.0, 0.85, -1.8), leg.lengths_m, leg.joint_axes)[2]
    level = foot(STANDING, leg.lengths_m, leg.joint_axes)[2]
    assert off.leg == "rm"
    assert off.off_m == pytest.approx(up - level)


def test_a_leg_at_rest_says_whether_it_hangs_or_stands() -> None:
    sagging = [("lf", sample(k, (0.0, 0.58, -1.8), STANDING)) for k in range(60)]
    leg = shipped_robot().leg("lf")
    hangs, told = (
        foot(pose, leg.lengths_m, leg.joint_axes)[2] for pose in ((0.0, 0.58, -1.8), STANDING)
    )
    (view,) = report(sagging).legs
    assert view.above_m == pytest.approx(hangs - told)
    assert view.above_m < 0
    lines = report_lines(report(sagging))
    assert any(f"{1e3 * (told - hangs):.0f} mm below their commands" in line for line in lines)
    assert not any("above their commands" in line for line in lines)
    (moving,) = report(sagging[:5]).legs
    assert moving.above_m is None  # not known to rest


def test_what_the_wire_itself_shows() -> None:
    poses = dict.fromkeys(shipped_robot().leg_ids, STANDING)
    beyond = report(still({**poses, "lf": (0.0, 0.6, 1.8)}))
    (limits,) = beyond.findings
    assert (limits.cause, limits.leg) == ("limits", "lf")
    assert "tibia in 100% of the samples, by 58°" in limits.what
    degrees = report(turned(walk(), lambda q: np.degrees(q)))
    assert [finding.cause for finding in degrees.findings] == ["units"]
    named = report([(leg.upper(), one) for leg, one in still(poses)])
    assert [finding.cause for finding in named.findings] == ["leg_ids"]
    none = report([])
    assert [finding.cause for finding in none.findings] == ["silent"]
    assert none.exit_code == 1


@pytest.fixture
def run_live(beside_a_source: Callable) -> Callable:
    """The command, beside a source of samples."""
    words = ("robot", "check", "--live", "--seconds", "120")
    return lambda samples, *more: beside_a_source(samples, *words, *more)


def test_over_zenoh_with_a_picture(run_live: Callable, tmp_path: Path) -> None:
    result = run_live(walk(), "--picture", str(tmp_path / "legs.svg"))
    assert result.exit_code == 0, result.output
    assert "as the motion says, leg lf lm lr rf rm rr" in result.output
    assert "nothing looks wrong" in result.output
    assert "front (x)" in (tmp_path / "legs.svg").read_text()


def test_errors_are_one_line() -> None:
    for words, error in (
        (("--live", "--connect", "tcp/127.0.0.1:1"), NoRouterError),
        (("--live", "--device", "/dev/null"), ConfigurationError),
        (("--connect", "tcp/127.0.0.1:1"), ConfigurationError),
    ):
        assert isinstance(tried("robot", "check", *words).exception, error)
