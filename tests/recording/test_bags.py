"""Bags of ROS 2 as recordings: the same samples, events and scores as of our own recordings."""

from __future__ import annotations

import shutil
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.robot import Robot, parse_robot
from adaptive_contact.ros2.types import typestore
from adaptive_contact.service.recording import RecordingWriter, read_recording
from adaptive_contact.service.recording.export import export_recording
from adaptive_contact.wire import (
    JSON,
    ContactEvent,
    ContactTruth,
    Message,
    ServoSample,
    contact_key,
    decode,
    encode,
    servo_key,
    truth_key,
)
from programs import invoke
from ros_messages import Messages
from stepping import step

TICK = 20_000_000
START = 1_700_000_000_000_000_000
LATE = 3_000_000  # of the recorder against the stamp
LEGS = ("lf", "rf")
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in "cft"]
STATE = "/legs/controller_state"
TEXT = """
[robot]
name = "hexapod-ax12a"
period_s = 0.02
quantum_rad = 0.00511
[ros2]
state = "/legs/controller_state"
phase = "/gait/{leg}/swing"
truth = "/feet/{leg}"
""" + "".join(
    f"""
[[leg]]
id = "{leg}"
joints = ["coxa", "femur", "tibia"]
lengths_m = [0.052, 0.066, 0.138]
ros2 = {{ joints = ["{leg}_c", "{leg}_f", "{leg}_t"] }}
"""
    for leg in LEGS
)


@pytest.fixture
def robot() -> Robot:
    return parse_robot(TEXT, source="test")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "robot.toml"
    path.write_text(TEXT)
    return path


def walk(swings: int = 4) -> list[tuple[dict[str, ServoSample], list[tuple[str, ContactTruth]]]]:
    """Ticks of two legs that step in turn, 30 of 40 ticks in the air, and their touches."""
    rng = np.random.default_rng(5)
    ticks = []
    for k in range(40 * swings):
        samples, truth = {}, []
        for shift, leg in ((0, "lf"), (20, "rf")):
            desired, phase = step(k + shift)
            measured = [q + float(rng.normal(0, 0.002)) for q in desired]
            samples[leg] = ServoSample(
                t_ns=START + k * TICK,
                seq=k,
                measured=measured,
                desired=desired,
                phase=phase,
            )
            if (k + shift) % 40 in (0, 30):
                at = START + k * TICK
                truth.append((leg, ContactTruth(t_ns=at, contact=phase == "stance", force=0.0)))
        ticks.append((samples, truth))
    return ticks


class BagWriter(Messages):
    """Writes ticks into a bag of rosbags."""

    def __init__(
        self,
        path: Path,
        *,
        storage: StoragePlugin = StoragePlugin.MCAP,
        compressed: CompressionMode = CompressionMode.NONE,
    ) -> None:
        super().__init__()
        self.writer = Writer(path, version=9, storage_plugin=storage)
        if compressed is not CompressionMode.NONE:
            self.writer.set_compression(compressed, CompressionFormat.ZSTD)
        self._connections: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> BagWriter:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def put(self, topic: str, message: Any, time_ns: int, raw: bytes | None = None) -> None:
        kind = (topic, message.__msgtype__)
        if kind not in self._connections:
            self._connections[kind] = self.writer.add_connection(
                topic, message.__msgtype__, typestore=self.store
            )
        payload = self.cdr(message) if raw is None else raw
        self.writer.write(self._connections[kind], time_ns, payload)

    def state_of(self, samples: dict[str, ServoSample]) -> Any:
        names = [f"{leg}_{joint}" for leg in samples for joint in "cft"]
        read = [q for sample in samples.values() for q in sample.measured]
        told = [q for sample in samples.values() for q in sample.desired]
        return self.state(names, read, told, next(iter(samples.values())).t_ns)

    def tick(
        self, samples: dict[str, ServoSample], truth: list[tuple[str, ContactTruth]] = ()
    ) -> None:
        at = next(iter(samples.values())).t_ns + LATE
        for leg, sample in samples.items():
            self.put(f"/gait/{leg}/swing", self.flag(sample.phase == "swing"), at - 2)
        self.put(STATE, self.state_of(samples), at)
        for leg, change in truth:
            self.put(f"/feet/{leg}", self.flag(change.contact), change.t_ns + LATE)


def read(path: Path, robot: Robot) -> tuple[dict[str, list[Message]], Any]:
    """Messages by key, and the recording after the pass."""
    recording = read_recording(path, robot)
    found: dict[str, list[Message]] = {}
    for record in recording:
        kind = ServoSample if record.key.endswith("/servo") else ContactTruth
        message = decode(record.payload, kind, record.encoding)
        assert isinstance(message, kind)
        found.setdefault(record.key, []).append(message)
    return found, recording


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compressed", [CompressionMode.NONE, CompressionMode.MESSAGE])
def test_a_bag_gives_what_was_on_the_wire(tmp_path, robot, storage, compressed) -> None:
    ticks = walk()
    with BagWriter(tmp_path / "bag", storage=storage, compressed=compressed) as bag:
        for samples, truth in ticks:
            bag.tick(samples, truth)
    found, recording = read(tmp_path / "bag", robot)
    assert recording.notes == ()
    assert recording.damage is None
    for leg in LEGS:
        sent = [samples[leg] for samples, _ in ticks]
        got: list[Any] = found[servo_key(leg)]
        assert [s.seq for s in got] == list(range(len(sent)))
        assert len({s.run for s in got}) == 1
        for mine, other in zip(got, sent, strict=True):
            assert (mine.t_ns, mine.phase) == (other.t_ns, other.phase)
            assert (mine.measured, mine.desired) == (other.measured, other.desired)
        changes = [change for _, truth in ticks for which, change in truth if which == leg]
        assert found[truth_key(leg)] == changes
    again = list(recording)
    assert len(again) == sum(map(len, found.values()))
    # A file of the bag is one, too.
    (file,) = (tmp_path / "bag").glob("bag.*")
    alone, _ = read(file, robot)
    assert [sample.measured for sample in alone[servo_key("rf")]] == [s.measured for s in got]


def test_a_cut_bag_is_read_up_to_the_cut(tmp_path, robot) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for samples, truth in walk(100):
            bag.tick(samples, truth)
    (tmp_path / "bag" / "metadata.yaml").unlink()  # as a recorder that is killed leaves it
    file = tmp_path / "bag" / "bag.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    found, recording = read(tmp_path / "bag", robot)
    assert 100 < len(found[servo_key("rf")]) < 4000
    assert "cut at byte" in recording.damage


def test_what_is_missing_is_told_a_line_each(tmp_path, robot) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for samples, _ in walk(1):
            only = {"lf": samples["lf"]}
            bag.put("/other/controller_state", bag.state_of(samples), samples["lf"].t_ns)
            bag.put("/feet/lf", bag.joints(JOINTS, [0.0] * 6, 1), samples["lf"].t_ns)
            message = bag.state_of(only)
            message.joint_names[2] = "lf_gripper"
            bag.put(STATE, message, samples["lf"].t_ns)
        bag.put(STATE, message, START + 99 * TICK, raw=b"\x00\x01\x00\x00junk")
    found, recording = read(tmp_path / "bag", robot)
    assert not found
    text = "\n".join(recording.notes)
    assert len(recording.notes) == len(set(recording.notes)) == 7, text
    for words in (
        "no topic /gait/lf/swing in the bag",
        "no topic /gait/rf/swing in the bag",
        "no topic /feet/rf in the bag",
        "/feet/lf: carries sensor_msgs/msg/JointState; expected std_msgs/msg/Bool",
        "lf_gripper belong to no leg",
        "leg 'lf' lacks lf_t",
        "a message is no control_msgs/msg/JointTrajectoryControllerState",
    ):
        assert words in text
    assert "(80 times)" in text  # both legs lack joints in each of 40 messages


def test_a_missing_state_topic_names_those_that_fit(tmp_path, robot) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for samples, _ in walk(1):
            bag.put("/other/controller_state", bag.state_of(samples), samples["lf"].t_ns)
    _, recording = read(tmp_path / "bag", robot)
    (line,) = [note for note in recording.notes if STATE in note]
    assert "such topics are /other/controller_state" in line


def test_replay_and_score_take_a_bag_as_they_take_a_recording(tmp_path, config) -> None:
    from adaptive_contact_sim import Simulation, SimulationSettings, WalkSettings

    models = resources.files("adaptive_contact_models")
    baseline = str(models.joinpath("hexapod", "baseline.json"))
    sim = Simulation(SimulationSettings(motion=WalkSettings(), seed=31))
    with BagWriter(tmp_path / "bag") as bag, RecordingWriter(tmp_path / "own.mcap") as own:
        for tick in sim.run(12.0):
            samples = {
                leg: msgspec.structs.replace(
                    tick.samples[leg], preview=None, t_ns=START + tick.samples[leg].t_ns
                )
                for leg in LEGS
            }
            truth = [
                (leg, ContactTruth(t_ns=START + t.t_ns, contact=t.contact, force=0.0))
                for leg, t in tick.truth
                if leg in LEGS
            ]
            bag.tick(samples, truth)
            for leg, sample in samples.items():
                own.write_message(servo_key(leg), sample, sample.t_ns)
            for leg, change in truth:
                own.write_message(truth_key(leg), change, samples[leg].t_ns)
    events, scores = [], []
    for name in ("own.mcap", "bag"):
        out = tmp_path / f"{name}.jsonl"
        path = tmp_path / name
        invoke("replay", path, "--config", config, "--baseline", baseline, "--events", out)
        events.append(out.read_text().splitlines())
        said = invoke("score", path, "--config", config, "--events", out, "--json")
        scores.append(said[said.index("{") :].replace(str(path), ""))
    assert len(events[0]) > 8
    assert events[0] == events[1]
    assert scores[0] == scores[1]


def test_a_bag_needs_a_mapping(tmp_path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.tick(walk(1)[0][0])
    with pytest.raises(ConfigurationError, match="give --config"):
        invoke("replay", tmp_path / "bag", "--events", tmp_path / "out")


OLD = b"#ROSBAG V2.0\n" + bytes(100)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("old.bag", b"#ROSBAG V2.0\n", "a bag of ROS 1; convert it"),
        ("old.bag.active", OLD, "a bag of ROS 1; convert it"),
        ("no_suffix", OLD, "a bag of ROS 1; convert it"),
        ("walk_0.mcap.zstd", b"x", "unpack each such file with `zstd -d .*walk_0.mcap.zstd`"),
        ("bad.db3", b"nothing", "cannot be read as a bag"),
        ("none.db3", None, "cannot be read"),
    ],
)
def test_other_files_are_refused(tmp_path, robot, name, content, words) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=words):
        list(read_recording(tmp_path / name, robot))


def test_other_folders_are_refused(tmp_path, robot) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        read_recording(tmp_path, robot)
    (tmp_path / "a.bag").write_bytes(OLD)
    with pytest.raises(RecordingError, match="a bag of ROS 1; convert it"):
        read_recording(tmp_path, robot)


def test_an_export_is_read_back_by_rosbags(tmp_path: Path) -> None:
    """Joint states, contacts and truth, and the events of a replay in place of recorded ones."""
    source, out = tmp_path / "own.mcap", tmp_path / "bag"
    replayed = tmp_path / "events.jsonl"

    def event(leg: str, k: int, *, contact: bool) -> ContactEvent:
        return ContactEvent(
            leg=leg, t_ns=START + k * TICK, seq=k, onset_ns=START + k * TICK - 40_000_000,
            contact=contact, status="valid", score=1.5, residual=[0.0] * 3, model_version=1,
        )  # fmt: skip

    with RecordingWriter(source, {"robot": "hexapod"}) as writer:
        for k in range(100):
            for leg in LEGS:
                angles = [0.1, 0.2, k / 100]
                sample = ServoSample(t_ns=START + k * TICK, seq=k, measured=angles, desired=angles)
                writer.write_message(servo_key(leg), sample, sample.t_ns + LATE)
            if k in (20, 60):
                change = ContactTruth(t_ns=START + k * TICK, contact=k == 20, force=0.0)
                writer.write_message(truth_key("lf"), change, change.t_ns + LATE)
                told = event("lf", k, contact=k == 20)
                writer.write_message(contact_key("lf"), told, told.t_ns + LATE)
    replayed.write_bytes(
        b"".join(encode(event("rf", k, contact=k == 30), JSON) + b"\n" for k in (30, 50))
    )
    for given, leg, at in (((), "lf", (20, 60)), (("--events", replayed), "rf", (30, 50))):
        invoke("export", source, "--to", "bag", "-o", out, *given)
        found: dict[str, list[tuple[int, Any]]] = {}
        with AnyReader([out], default_typestore=typestore()) as reader:
            qos = {one.topic: one.ext.offered_qos_profiles for one in reader.connections}
            for one, time_ns, data in reader.messages():
                content = reader.deserialize(data, one.msgtype)
                found.setdefault(one.topic, []).append((time_ns, content))
        contact = f"/adaptive_contact/{leg}/contact"
        assert set(found) == {
            "/joint_states", "/adaptive_contact/lf/truth", contact, "/adaptive_contact/contacts",
        }  # fmt: skip
        times = [START + k * TICK + LATE for k in at]
        assert [(time_ns, flag.data) for time_ns, flag in found[contact]] == [
            (times[0], True),
            (times[1], False),
        ]
        assert qos[contact][0].durability is QosDurability.TRANSIENT_LOCAL
        assert not qos["/joint_states"]
        _, every = found["/adaptive_contact/contacts"][0]
        values = dict(zip(every.joint_names, every.interface_values, strict=True))[leg]
        row = dict(zip(values.interface_names, values.values, strict=True))
        assert row["contact"] == row["valid"] == 1.0
        assert (row["score"], row["onset_age"], row["age"]) == (1.5, 0.04, pytest.approx(0.0))
        time_ns, last = found["/joint_states"][-1]
        assert time_ns == START + 99 * TICK + LATE
        assert last.name == ["rf_coxa", "rf_femur", "rf_tibia"]
        assert last.position.tolist() == [0.1, 0.2, 0.99]
        assert last.header.stamp.nanosec == (START + 99 * TICK) % 10**9
        with pytest.raises(ConfigurationError, match="exists already"):
            invoke("export", source, "--to", "bag", "-o", out)
        shutil.rmtree(out)


def test_events_of_another_recording_are_counted(tmp_path: Path, robot: Robot) -> None:
    source = tmp_path / "own.mcap"
    with RecordingWriter(source) as writer:
        writer.write_message(servo_key("lf"), walk(1)[0][0]["lf"], 0)
    other = ContactEvent(
        leg="lf", t_ns=7, seq=1, onset_ns=7, contact=True, status="valid", score=1.5,
        residual=[], model_version=1,
    )  # fmt: skip
    exported = export_recording(
        read_recording(source), tmp_path / "bag", "bag", robot=robot, events=[other]
    )
    assert list(exported.left_out) == [
        ("robot/leg/lf/contact", "an event of a sample that is not there")
    ]
