"""A robot.toml is checked once, on load, with one line that helps."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact import ServoSample
from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import AngleFrame, Port, load_robot, parse_robot, shipped_robot
from adaptive_contact.robot.load import is_shipped, recorded_as
from adaptive_contact.robot.write import write_robot
from adaptive_contact.status import LegFacts

GOOD = """
[robot]
name = "mybot"
period_s = 0.02
quantum_rad = 0.00511
[[leg]]
id = "rf"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.052, 0.066, 0.138]
"""


def test_the_shortest_file_is_enough() -> None:
    robot = parse_robot(GOOD, source="x")
    assert robot.leg_ids == ("rf",)
    assert robot.leg("rf").joint_axes == ("yaw", "pitch", "pitch")
    assert robot.quantum("rf") == 0.00511


@pytest.mark.parametrize(("own", "known"), [("", False), ("quantum_rad = 0.003\n", True)])
def test_a_step_may_be_left_out(own: str, known: bool) -> None:
    text = GOOD.replace("quantum_rad = 0.00511\n", "") + own
    robot = parse_robot(text, source="x")
    assert (robot.quantum("rf"), robot.knows_step("rf")) == (0.003 if known else 0.001, known)
    assert LegFacts.from_robot(robot, "rf").quantum_rad == (0.003 if known else None)
    again = parse_robot(write_robot(robot), source="x")
    assert (again.quantum("rf"), again.steps_known) == (robot.quantum("rf"), False)


def test_a_robot_has_as_many_legs_as_a_service_can_follow() -> None:
    more = "".join(f'[[leg]]\nid = "l{n}"\njoints = ["a"]\n' for n in range(63))
    assert len(parse_robot(GOOD + more, source="x").legs) == 64
    with pytest.raises(
        ConfigurationError, match="leg has a length of 65; expected at most 64: give"
    ):
        parse_robot(GOOD + more + '[[leg]]\nid = "one-more"\njoints = ["a"]\n', source="x")


@pytest.mark.parametrize("name", ["hexapod", "quadruped", "quadruped12", "leg5"])
def test_what_is_written_is_read_back(name: str) -> None:
    robot = shipped_robot(name)
    ports = robot.ports or {"a.b": Port(device="/dev/x")}
    robot = msgspec.structs.replace(robot, ports=ports)
    written = write_robot(robot)
    again = parse_robot(written, source="written")
    assert write_robot(again) == written
    assert again.ports == robot.ports
    for one, other in zip(robot.legs, again.legs, strict=True):
        assert other.chain == one.chain
        assert other.mount.xyz_m == one.mount.xyz_m
        assert other.limits.upper_rad == pytest.approx(one.limits.upper_rad, abs=1e-5)
        assert one.servos is None or other.servos.models == one.servos.models


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("period_s = 0.02", "period_s = 20", "period_s is 20"),
        ("period_s = 0.02", 'period_s = "fast"', "period_s"),
        ("period_s = 0.02", "", "missing key `period_s` - at `robot`; such as period_s = 0.02"),
        (
            '["coxa", "femur", "tibia"]',
            '["a", "b"]\naxes = ["yaw", "up"]',
            "expected roll, pitch, yaw, or a direction such as [0, 1, 0]",
        ),
        ("[[leg]]", "[detector]\nleg = 3\n[[leg]]", "or as a table of its own"),
        ("period_s = 0.02", "period_s = 0.02\nperiods = 1", "did you mean 'period_s'?"),
        ("quantum_rad = 0.00511", "quantum_rad = 0", "quantum_rad is 0"),
        ('id = "rf"', 'id = "r*"', "an id is 1 to 32 letters"),
        ('["coxa", "femur", "tibia"]', "[]", "joints has a length of 0; expected at least 1"),
        ('["coxa", "femur", "tibia"]', '["a", "a", "b"]', "repeat a name"),
        ("[0.052, 0.066, 0.138]", "[0.052, 0.066]", "lengths_m has 2 values for 3 joints"),
        (
            "[0.052, 0.066, 0.138]",
            "[0.052, -1, 0.138]",
            "lengths_m[1] is -1; expected more than 0 m",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            'lengths_m = [0.1, 0.1, 0.1]\naxes = ["yaw", "yaw", "yaw"]',
            "no joint raises the foot; look at axes, or leave lengths_m out",
        ),
        *(
            (
                "lengths_m = [0.052, 0.066, 0.138]",
                wrong,
                f"leg[0].{found}; expected ",
            )
            for wrong, found in (
                ('axes = [[0, 1], "yaw", "yaw"]', "axes[0] is [0, 1]"),
                ("axes = [0, 1, 0]", "axes[0] is 0"),
                ('axes = "roll"', "axes is 'roll'"),
                ('axes = ["roll", [0, true, 0], "pitch"]', "axes[1][1] is True"),
                ("origins_m = [0.1, 0.2, 0.2]", "origins_m[0] is 0.1"),
                ("origins_m = [[0, 1], [0, 0, 1], [0, 0, 1]]", "origins_m[0] is [0, 1]"),
            )
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            "origins_m = [[0.1, 0, 0], [0.1, 0, 0], [0, 0, 0]]",
            "ends with [0, 0, 0], so that 'tibia' moves nothing; expected the way from this joint",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            "origins_m = [[1e-9, 0, 0], [0, 0, 0], [1e-9, 0, 0]]",
            "reaches 2e-09 m; expected the way",
        ),
        ("period_s = 0.02", "period_s = 0.02\naxes = []", "it belongs to another table"),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            'axes = ["roll", [0, 0, 0], "pitch"]',
            "axes has [0.0, 0.0, 0.0]; expected a direction such as [0, 1, 0]",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            'axes = ["roll", [0, nan, 1], "pitch"]',
            "expected a direction such as [0, 1, 0]",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            "lengths_m = [0.1, 0.1, 0.1]\norigins_m = [[0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0]]",
            "has lengths_m and origins_m; give one",
        ),
        ("lengths_m = [0.052, 0.066, 0.138]", "origins_m = [[0, 0, 0.1]]", "1 values for 3 joints"),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            "origins_m = [[0.1, 0, 0], [0.1, nan, 0], [0.1, 0, 0]]",
            "origins_m[1][1] is nan; expected at least -5 m",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            "origins_m = [[0, 0, 0], [0, 0, 0], [0, 0, 0]]",
            "reaches 0 m; expected the way from each joint to the next",
        ),
        (
            "lengths_m = [0.052, 0.066, 0.138]",
            'axes = ["yaw", [0, 0, -1], "yaw"]\norigins_m = [[0.1, 0, 0], [0.1, 0, 0], [0, 0, 1]]',
            "no joint raises the foot; look at axes, or leave origins_m out",
        ),
        ("[[leg]]", "[[leg", "not valid TOML"),
        ("[[leg]]", "[detector]\nfalse_alarms_per_hour = 0\n[[leg]]", "false_alarms_per_hour is 0"),
        (
            "[[leg]]",
            "[detector]\nlasting_ms = 5000\n[[leg]]",
            "lasting_ms is 5000; expected at most",
        ),
        ("[[leg]]", "[detector]\ntouch_push = 0\n[[leg]]", "touch_push is 0; expected at least 1"),
        (
            "[[leg]]",
            "[detector]\nhangs_push = 4\n[[leg]]",
            "[detector] hangs_push is 4; expected at most carries_push, which is 3",
        ),
        (
            "[[leg]]",
            "[detector]\ntouches_above = 0.2\n[[leg]]",
            "touches_below is 0.45; expected at most touches_above, which is 0.2",
        ),
        ("[[leg]]", "[servo]\nslope_rad = 0\n[[leg]]", "slope_rad is 0"),
        ('id = "rf"', "id = 3", 'leg[0].id is 3; expected a text ("...")'),
        ("period_s = 0.02", 'period_s = "fast"', "robot.period_s is 'fast'; expected a number"),
        ('"mybot"', '"  "', "[robot] name is '  '; expected letters"),
        ('"mybot"', '"my\\u001bbot"', "expected letters that can be printed"),
        ('"femur"', '""', "leg[0].joints[1] has a length of 0"),
        ('"femur"', '"fe\\nmur"', "expected letters that can be printed"),
        ("lengths_m", "mount = { xyz_m = [nan, 0, 0] }\nlengths_m", "mount.xyz_m[0] is nan"),
        ("lengths_m", "mount = { xyz_m = [90, 60, 0] }\nlengths_m", "expected at most 5 m"),
        (
            "lengths_m",
            "mount = { yaw_rad = 90 }\nlengths_m",
            "yaw_rad is 90; expected at most 6.28319 rad",
        ),
        *(
            ("lengths_m", f"angles = {{ {wrong} }}\nlengths_m", found)
            for wrong, found in (
                ("directions = [1, -1]", "angles.directions"),
                ("directions = [1, 0, 1]", "directions[1] is 0; expected 1 or -1"),
                ("offsets_rad = [0, 57.3, 0]", "expected at most 6.28319 rad, not degrees"),
                ("direction = [1, 1, 1]", "directions"),
            )
        ),
        ('["coxa"', '["x"]\n[[leg]]\nid = "rf"\njoints = ["coxa"', "used twice"),
        ("[[leg]]", '[port.a]\ndevice = ""\n[[leg]]', "port.device has a length of 0"),
        ("[[leg]]", '[port.a]\ndevice = "/\\u0000"\n[[leg]]', "letters that can be printed"),
        ("[[leg]]", '[port.a]\ndevice = "x"\nprotocol = 3\n[[leg]]', "expected 1 (AX"),
        ("[[leg]]", '[ros2]\ndistro = "foxy"\n[[leg]]', "expected humble, iron, jazzy"),
        *(
            (
                "lengths_m",
                f"{key} = {{ {ids}offsets_rad = [0, {wrong}, 0] }}\nlengths_m",
                f"{key}.o",
            )
            for key, ids in (("servos", "ids = [1, 2, 3], "), ("angles", ""))
            for wrong in ("nan", "inf", "90")
        ),
    ],
)
def test_what_is_wrong_is_said_in_one_line(old: str, new: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=f"^my/robot.toml: .*{re.escape(says)}"):
        parse_robot(GOOD.replace(old, new), source="my/robot.toml")


def test_a_file_with_the_mark_of_windows_is_read(tmp_path: Path) -> None:
    (tmp_path / "r.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load_robot(tmp_path / "r.toml") == parse_robot(GOOD, source="x")


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: load_robot(path / "none.toml"), "cannot be read"),
        (lambda path: load_robot(path / "r.toml"), "not UTF-8"),
        (lambda _: parse_robot(GOOD, source="x").leg("xx"), "has no leg 'xx'; its legs are rf"),
        (
            lambda _: shipped_robot("octopus"),
            "there are hexapod, leg5, quadruped, quadruped12, others",
        ),
        (
            lambda _: load_robot("octopus"),
            r"or a shipped robot's name \(hexapod, leg5, ",
        ),
    ],
)
def test_what_is_not_there_is_told(
    tmp_path: Path, make: Callable[[Path], object], says: str
) -> None:
    (tmp_path / "r.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigurationError, match=says):
        make(tmp_path)


def test_a_name_is_a_robot_that_ships(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load_robot("quadruped12") == shipped_robot("quadruped12")
    assert is_shipped("hexapod")
    assert not is_shipped("hexapod/robot.toml")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hexapod").write_text(GOOD)  # a file of that name comes first
    assert load_robot("hexapod") == parse_robot(GOOD, source="x")
    for name in ("hexapod", "hexapod-ax12a"):
        assert recorded_as(name) == shipped_robot("hexapod")
    assert recorded_as("octopus") is None


def test_an_axis_is_a_word_or_a_direction() -> None:
    text = GOOD.replace(
        "lengths_m = [0.052, 0.066, 0.138]",
        'axes = ["roll", [0, -2, 0], [0, 3, 4]]\n'
        "origins_m = [[0, 0.05, 0], [0, 0, -0.1], [0, 0.01, -0.1]]",
    )
    leg = parse_robot(text, source="x").leg("rf")
    assert leg.joint_axes == ("roll", "pitch", (0.0, 0.6, 0.8))
    assert leg.chain.origins_m[2] == (0.0, 0.01, -0.1)
    assert leg.lengths_m is None


@pytest.mark.parametrize("joints", range(1, 8))
def test_a_chain_has_one_to_seven_joints(joints: int) -> None:
    axes = ["yaw", "roll", "pitch", "pitch", "roll", [0, 1, 1], "yaw"][:joints]
    axes[0] = "roll"
    text = (
        GOOD.replace('["coxa", "femur", "tibia"]', str([f"j{i}" for i in range(joints)]))
        .replace("lengths_m = [0.052, 0.066, 0.138]", f"axes = {axes}")
        .replace("axes", f"origins_m = {[[0, 0.02, -0.1]] * joints}\naxes", 1)
    )
    leg = parse_robot(text, source="x").leg("rf")
    assert leg.chain.foot([0.0] * joints) == pytest.approx([0, 0.02 * joints, -0.1 * joints])


# -- `[leg.angles]`: the wire's angles into the description's, and back

ANGLE = st.floats(-6.0, 6.0)


def leg(text: str = "") -> AngleFrame:
    return AngleFrame(parse_robot(GOOD + text, source="test").leg("rf"))


def test_directions_come_before_offsets() -> None:
    """Without the table a sample is left as it is; one of another length is, to the checks."""
    sample = ServoSample(
        t_ns=1, seq=1, measured=[0.1, 0.2, 0.3], desired=[1.0, 1.0, 1.0], preview=[[0.0] * 3]
    )
    assert leg().same
    assert leg().sample(sample) is sample
    frame = leg("angles = { directions = [1, -1, -1], offsets_rad = [0.0, 0.5, -1.0] }")
    turned = frame.sample(sample)
    assert turned.measured == [0.1, 0.5 - 0.2, -1.0 - 0.3]
    assert turned.desired == [1.0, -0.5, -2.0]
    assert turned.preview == [[0.0, 0.5, -1.0]]
    assert sample.measured == [0.1, 0.2, 0.3], "inputs are never changed"
    assert frame.sample(ServoSample(t_ns=1, seq=1, measured=[1.0], desired=[])).measured == [1.0]


@given(
    st.lists(st.sampled_from([1, -1]), min_size=3, max_size=3),
    st.lists(ANGLE, min_size=3, max_size=3),
    st.lists(ANGLE, min_size=3, max_size=3),
)
def test_there_and_back_is_where_it_was(
    directions: list[int], offsets: list[float], wire: list[float]
) -> None:
    frame = leg(f"angles = {{ directions = {directions}, offsets_rad = {offsets} }}")
    assert frame.wire(frame.angles(wire)) == pytest.approx(wire, abs=1e-12)
