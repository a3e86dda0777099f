"""What becomes of messages: samples with the right joints and numbers, or a problem each."""

from __future__ import annotations

import itertools
import math
import re
from typing import Any

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.robot import parse_robot
from adaptive_contact.ros2.intake import Intake
from adaptive_contact.ros2.problems import Complaints, Reason
from adaptive_contact.ros2.rmw import RosType
from adaptive_contact.ros2.ticks import Origin
from adaptive_contact.ros2.types import Types, typestore
from adaptive_contact.wire import ContactTruth, ServoSample
from ros_messages import Messages

from .conftest import LEGS, text_of

STATE = 'state = "/legs/controller_state"'
BOTH = 'state = "/joint_states"\ncommand = "/commands"'
A, B = b"a" * 16, b"b" * 16


STORES = [typestore(kind) for kind in ("jazzy", "2023", "humble", "old")]
READER = Types()


def read_state(message: Any) -> Any:
    """As it is read from the wire, without a hash."""
    for store in STORES:
        if [name for name, _ in store.fielddefs[RosType.CONTROLLER_STATE][1]] == list(
            vars(message)
        )[:-1]:
            payload = bytes(store.serialize_cdr(message, RosType.CONTROLLER_STATE))
            return READER.decode(RosType.CONTROLLER_STATE, "", payload)
    raise AssertionError(list(vars(message)))


class Rig:
    """An intake, what it made and what it complained of."""

    def __init__(self, robot: Any) -> None:
        self.problems: list[tuple[str, Reason, str]] = []
        self.intake = Intake(robot, 1000, lambda *found: self.problems.append(found))

    def convert(
        self,
        topic: str,
        name: str,
        message: Any,
        seq: int | None = None,
        *,
        by: bytes = A,
        time_ns: int = 10**9,
    ) -> dict[str, Any]:
        if name == RosType.CONTROLLER_STATE:
            message = read_state(message)
        return dict(self.intake.convert(topic, name, message, Origin(by, seq, time_ns)))

    @property
    def reasons(self) -> list[Reason]:
        return [reason for _, reason, _ in self.problems]


@pytest.fixture
def rig():
    return lambda text=STATE: Rig(parse_robot(text_of(text), source="test"))


@pytest.fixture
def made():
    return Messages()


def state(rig: Rig, made: Any, joints: list[str], seq: int | None, **origin: Any) -> dict[str, Any]:
    angles = [0.1 * i for i in range(len(joints))]
    message = made.state(joints, angles, [-a for a in angles], origin.pop("stamp", 10**9))
    return rig.convert("/legs/controller_state", RosType.CONTROLLER_STATE, message, seq, **origin)


@pytest.mark.parametrize("kind", ["jazzy", "2023", "humble", "old"])
def test_feedback_is_measured_and_reference_desired(rig, joints, kind) -> None:
    names = joints[::-1]  # the order of the message is its own
    got = state(rig(), Messages(kind), names, 7, stamp=5 * 10**9)
    assert set(got) == {"lf", "rf"}
    rf: ServoSample = got["rf"]
    assert rf.measured == pytest.approx([0.2, 0.1, 0.0])
    assert rf.desired == pytest.approx([-0.2, -0.1, 0.0])
    assert (rf.t_ns, rf.valid, rf.phase) == (5 * 10**9, None, None)


def test_lost_messages_are_gaps_of_seq(rig, made, joints) -> None:
    used = rig()
    seqs = [state(used, made, joints, seq)["rf"].seq for seq in (5, 6, 9, 10)]
    assert [b - a for a, b in itertools.pairwise(seqs)] == [1, 3, 1]


def test_a_message_twice_is_used_once(rig, made, joints) -> None:
    used = rig()
    state(used, made, joints, 5)
    assert state(used, made, joints, 5) == {}
    assert state(used, made, joints, 4) == {}
    assert used.reasons == ["repeated"] * 2


def test_another_publisher_is_a_new_run(rig, made, joints) -> None:
    used = rig()
    first = state(used, made, joints, 500)["rf"]
    second = state(used, made, joints, 1, by=B)["rf"]
    assert second.run > first.run
    again = state(used, made, joints, 2)["rf"]  # it counts anew, 498 back
    assert again.run > second.run


def test_without_numbers_both_clocks_tell_losses(rig, made, joints) -> None:
    used = rig()
    tick = 20_000_000

    def seq(stamp: float, recorded: float) -> int:
        at = {"stamp": 10**9 + int(stamp * tick), "time_ns": 10**9 + int(recorded * tick)}
        return state(used, made, joints, None, **at)["rf"].seq

    assert seq(0, 0.1) == 0
    assert seq(1, 1.1) == 1
    assert seq(4, 4.1) == 4  # two lost
    assert seq(5, 8.0) == 5  # the recorder slept
    assert seq(6, 8.0) == 6
    assert seq(7.4, 8.4) == 7
    assert seq(10.4, 9.4) == 8  # a stamp that jumps


def test_an_empty_stamp_is_the_time_of_publishing(rig, made, joints) -> None:
    assert state(rig(), made, joints, 1, stamp=0, time_ns=77)["rf"].t_ns == 77


def test_a_reading_that_is_nan_is_the_last_one_and_not_valid(rig, made, joints) -> None:
    used = rig()
    state(used, made, joints, 1)
    angles = [0.5, math.nan, 0.5, 0.5, 0.5, 0.5]
    message = made.state(joints, angles, [0.0] * 6)
    got = used.convert("/legs/controller_state", RosType.CONTROLLER_STATE, message, 2)
    assert got["lf"].measured == pytest.approx([0.5, 0.1, 0.5])
    assert got["lf"].valid == [True, False, True]
    assert got["rf"].valid is None
    assert used.reasons == ["not_finite"]
    assert "lf_f" in used.problems[0][2]


def test_a_reference_that_is_nan_takes_its_leg_only(rig, made, joints) -> None:
    used = rig()
    state(used, made, joints, 1)
    told = [0.0, 0.0, math.inf, 0.0, 0.0, 0.0]
    got = used.convert(
        "/legs/controller_state", RosType.CONTROLLER_STATE, made.state(joints, [0.0] * 6, told), 2
    )
    assert set(got) == {"rf"}
    assert used.reasons == ["not_finite"]
    assert state(used, made, joints, 3)["lf"].seq - 2 == state(used, made, joints, 4)["lf"].seq - 3


def test_missing_and_strange_joints_are_named(rig, made, joints) -> None:
    used = rig()
    names = [*joints[:5], "gripper"]
    assert set(state(used, made, names, 1)) == {"lf"}
    state(used, made, names, 2)
    assert used.reasons == ["unmapped", "joints_missing", "joints_missing"]
    assert "gripper" in used.problems[0][2]
    assert "leg 'rf' lacks rf_t" in used.problems[1][2]


def test_a_joint_named_twice_takes_its_leg_only(rig, made, joints) -> None:
    used = rig()
    for seq in (1, 2):
        assert set(state(used, made, [*joints, "lf_f", "tail", "tail"], seq)) == {"rf"}
    assert used.reasons == ["unmapped", "named_twice", "named_twice"]
    assert "lf_f more than once" in used.problems[1][2]

    commanded = rig(BOTH)
    twice = made.joints([*joints, "rf_t"], [1.0] * 6 + [2.0])
    commanded.convert("/commands", RosType.JOINT_STATE, twice)
    assert set(read(commanded, made, joints, 1)) == {"lf"}
    assert commanded.reasons == ["named_twice", "no_command"]


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        ([], "there are none:"),
        ([""] * 6, "there are '', '', '', '' and 2 more:"),
        (["x" * 10_000], f"there are {'x' * 60}:"),
    ],
)
def test_whatever_joints_are_called_a_line_is_short(rig, made, names, shown) -> None:
    used = rig()
    assert state(used, made, names, 1) == {}
    _, reason, line = used.problems[-1]
    assert (reason, shown in line, len(line) < 400) == ("joints_missing", True, True)


def test_names_that_change_their_order_with_each_message_are_followed(rig, made, joints) -> None:
    used = rig()
    for seq, names in enumerate(itertools.islice(itertools.permutations(joints), 200)):
        angles = [0.1 * joints.index(name) for name in names]
        message = made.state(list(names), angles, angles)
        got = used.convert("/legs/controller_state", RosType.CONTROLLER_STATE, message, seq)
        assert got["rf"].measured == got["rf"].desired == pytest.approx([0.3, 0.4, 0.5])
    assert not used.problems


def test_positions_that_are_not_there_are_told(rig, made, joints) -> None:
    used = rig()
    message = made.state(joints, [], [0.0] * 6)
    assert used.convert("/legs/controller_state", RosType.CONTROLLER_STATE, message, 1) == {}
    assert used.reasons == ["no_positions"]


def read(rig: Rig, made: Any, joints: list[str], seq: int) -> dict[str, Any]:
    message = made.joints(joints, [0.1] * len(joints))
    return rig.convert("/joint_states", RosType.JOINT_STATE, message, seq)


def test_joint_states_take_the_command_in_force(rig, made, joints) -> None:
    used = rig(BOTH)
    assert read(used, made, joints, 1) == {}
    assert used.reasons == ["no_command"] * 2
    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints[:4], [1.0, 2.0, 3.0, 4.0]))
    got = read(used, made, joints, 2)
    assert set(got) == {"lf"}
    assert got["lf"].desired == [1.0, 2.0, 3.0]
    used.convert("/commands", RosType.TRAJECTORY, made.trajectory(joints[4:], [[5.0, 6.0]]))
    assert read(used, made, joints, 3)["rf"].desired == [4.0, 5.0, 6.0]


def test_joint_states_may_come_in_parts(rig, made, joints) -> None:
    used = rig(BOTH)
    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints, [0.0] * 6))
    parts = [read(used, made, joints[at : at + 3], seq) for seq, at in ((1, 0), (2, 3), (5, 0))]
    assert [list(part) for part in parts] == [["lf"], ["rf"], ["lf"]]
    assert not used.problems


def test_a_leg_that_moves_without_commands_gives_no_samples(rig, made, joints) -> None:
    used = rig(BOTH)

    def reads(seq: int, angle: float) -> set[str]:
        message = made.joints(joints, [angle] * 3 + [0.0] * 3)
        return set(used.convert("/joint_states", RosType.JOINT_STATE, message, seq))

    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints, [0.0] * 6))
    # On its way to its last command, however slow, it moves, too; then it holds its pose.
    assert all(reads(seq, max(1.0 - 0.006 * seq, 0.02)) == {"lf", "rf"} for seq in range(200))
    assert not used.problems
    for seq in range(200, 220):  # readings that are wrong now and then say nothing
        assert reads(seq, 0.02 + 0.5 * (seq % 4 < 2)) == {"lf", "rf"}
    assert [len(reads(seq, 0.5)) for seq in range(220, 224)] == [2, 2, 1, 1]
    assert reads(224, 0.02) == {"rf"}  # passing where it was says nothing
    assert used.reasons == ["no_command"] * 3
    assert (
        "leg 'lf' goes elsewhere, and its last command is more than 1 s old" in used.problems[0][2]
    )
    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints[:3], [0.1] * 3))
    assert reads(225, 0.1) == {"lf", "rf"}


def test_an_array_needs_its_order(rig, made, joints) -> None:
    values = made.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    used = rig(BOTH)
    used.convert("/commands", RosType.ARRAY, values)
    assert used.reasons == ["no_positions"]
    ordered = rig(f"{BOTH}\ncommand_joints = {joints[::-1]}".replace("'", '"'))
    ordered.convert("/commands", RosType.ARRAY, values)
    assert read(ordered, made, joints, 1)["lf"].desired == [6.0, 5.0, 4.0]
    ordered.convert("/commands", RosType.ARRAY, made.array([1.0]))
    assert ordered.reasons == ["no_positions"]


def test_what_is_no_command_is_told(rig, made, joints) -> None:
    used = rig(BOTH)
    used.convert("/commands", RosType.JOINT_STATE, made.joints(["q1", "q2"], [0.0, 0.0]))
    used.convert("/commands", RosType.TRAJECTORY, made.trajectory(joints, [[0.0] * 6, [1.0] * 6]))
    assert used.reasons == ["unmapped", "trajectory"]
    assert "q1, q2 belong to no leg" in used.problems[0][2]


def test_a_command_that_is_nan_leaves_the_last_one(rig, made, joints) -> None:
    used = rig(BOTH)
    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints, [0.5] * 6))
    used.convert("/commands", RosType.JOINT_STATE, made.joints(joints, [math.nan] + [0.6] * 5))
    assert read(used, made, joints, 1)["lf"].desired == [0.5, 0.6, 0.6]
    assert used.reasons == ["not_finite"]


def test_phase_and_foot_switches_are_of_their_leg(rig, made, joints) -> None:
    used = rig(STATE + '\nphase = "/gait/{leg}/swing"\ntruth = "/feet/{leg}"')
    assert (
        used.convert("/feet/lf", RosType.BOOL, made.flag(False), time_ns=79 * 10**9) == {}
    )  # no clock yet
    used.convert("/gait/rf/swing", RosType.BOOL, made.flag(True))
    message = read_state(made.state(joints, [0.0] * 6, [0.0] * 6, 50 * 10**9))
    origin = Origin(A, 1, 80 * 10**9)
    got = dict(
        used.intake.convert("/legs/controller_state", RosType.CONTROLLER_STATE, message, origin)
    )
    assert (got["rf"].phase, got["lf"].phase) == ("swing", None)
    used.convert("/gait/rf/swing", RosType.BOOL, made.flag(False))
    assert state(used, made, joints, 2)["rf"].phase == "stance"
    state(used, made, joints, 3, stamp=51 * 10**9, time_ns=81 * 10**9)
    truth: ContactTruth = used.convert(
        "/feet/rf", RosType.BOOL, made.flag(True), time_ns=82 * 10**9
    )["rf"]
    assert (truth.contact, truth.t_ns) == (True, 52 * 10**9)
    assert used.convert("/feet/rf", RosType.BOOL, made.flag(True), time_ns=83 * 10**9) == {}


def test_complaints_are_counted_and_said_now_and_then() -> None:
    complaints = Complaints(every_s=10.0)
    problem = ("/x", "unreadable", "no message")
    said = [complaints.count(*problem, now_s) for now_s in (0.0, 1.0, 9.0, 10.0)]
    assert said == ["/x: no message", None, None, "/x: no message (3 times)"]
    assert complaints.counts["/x", "unreadable"] == 4
    assert complaints.lines() == ["/x: no message (4 times)"]


@pytest.mark.parametrize(
    ("ros2", "says"),
    [
        ('state = "joint_states"', "expected a topic"),
        ('state = "/a b"', "expected a topic"),
        ("", "no state topic"),
        (f"{STATE}\ndomain = 233", "domain is 233"),
        (f'{STATE}\nnode = "1x"', "node is '1x'"),
        (f'{STATE}\ndistro = "foxy"', "distro"),
        (f'{STATE}\nphase = "/swing"', "write {leg} into it"),
        (f'{BOTH}\ncommand_joints = ["lf_c"]', "command_joints lacks lf_f, lf_t"),
        ('stat = "/x"', "did you mean 'state'"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(ros2: str, says: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(says)):
        parse_robot(text_of(ros2), source="robot.toml")


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"rf_t"]', '"rf_t", "x"]', "4 values for 3 joints"),
        ('"rf_t"]', '"lf_t"]', "twice"),
        ("[ros2]\n" + STATE, "", "[leg.ros2] without [ros2]"),
    ],
)
def test_wrong_joints_are_refused(old: str, new: str, says: str) -> None:
    text = text_of(STATE).replace(old, new)
    with pytest.raises(ConfigurationError, match=says.replace("[", r"\[")):
        parse_robot(text, source="robot.toml")


def test_a_robot_without_ros2_is_refused() -> None:
    text = text_of(STATE).replace("[ros2]\n" + STATE, "")
    text = text.replace(LEGS, '[[leg]]\nid = "a"\njoints = ["x"]')
    with pytest.raises(ConfigurationError, match=r"write \[ros2\]"):
        Intake(parse_robot(text, source="robot.toml"), 1, lambda _: None)
