"""Nothing moves that was not asked to move: any servo, set in any way, anywhere, whatever happens.

The real DynamixelSDK speaks over a pseudo-terminal with servos whose horns have no inertia, so that
each write shows all that it does.
"""

from __future__ import annotations

import dataclasses
import itertools
import select
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from anybus import AnyServo, Horns, any_servo
from hypothesis import HealthCheck, event, given, settings
from hypothesis import strategies as st

from adaptive_contact.bridge import bus
from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.cycle import Cycle
from adaptive_contact.bridge.drive import EASY_SHARE
from adaptive_contact.bridge.plan import JointPlan, LegPlan, PortPlan
from adaptive_contact.bridge.port import SdkPort
from adaptive_contact.bridge.tables import MODELS, ServoModel, models_named
from adaptive_contact.bridge.transport import Mailbox
from adaptive_contact.robot import Port
from adaptive_contact.robot.description import Protocol
from adaptive_contact.wire import MSGPACK, Command, encode
from adaptive_contact_sim.virtual import FaultSchedule, VirtualPort

# So long that no tick runs out of time, however busy the computer is.
PERIOD_S = 2.0
SETTLED_TICKS = 45


class Line:
    """A port that is served while the SDK waits: no thread, no race.

    Attributes:
        late: share of answers that come after the next question only.
    """

    late = 0.0

    def __init__(self, directory: Path, protocol: Protocol) -> None:
        model = next(m for m in MODELS if m.protocol == protocol)
        self.port = VirtualPort(
            f"p{protocol}",
            directory / f"p{protocol}",
            [any_servo(1, model.name, Horns(1), 0)],
            FaultSchedule([], np.random.default_rng(0)),
        )
        self.port.open()
        settings = Port(device=str(self.port.path), protocol=protocol, timeout_ms=1000)
        self.plan = PortPlan("main", settings, (), PERIOD_S)
        opened: list[Any] = []

        def kept(*given: Any) -> SdkPort:
            opened.append(SdkPort(*given))
            return opened[0]

        with mock.patch.object(bus, "SdkPort", kept):
            self.bus = Bus("main", settings)
        self.bus.open()
        (device,) = opened
        write = device.writePort

        rng = np.random.default_rng(0)

        def serve(packet: list[int]) -> int:
            done = int(write(packet))
            # What was held back is under way when the next question is asked.
            self.port.flush(time.monotonic() + 1.0)
            # The bytes pass through a worker of the kernel.
            frames, length = self.port.requests, 0.0
            while self.port.requests == frames and length < 5.0:
                ready, _, _ = select.select([self.port.master], [], [], 5.0)
                assert ready
                self.port.receive(time.monotonic(), 0.0)
                length += 0.01
            held = rng.random() < self.late
            self.bus.port.timeout_ms = 2.0 if held else 1000.0
            if not held:
                self.port.flush(time.monotonic() + 1.0)
            return done

        device.writePort = serve

    def close(self) -> None:
        self.bus.close()
        self.port.close()


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[Protocol, Line]]:
    directory = tmp_path_factory.mktemp("lines")
    made = {protocol: Line(directory, protocol) for protocol in {m.protocol for m in MODELS}}
    yield made
    for line in made.values():
        line.close()


@dataclasses.dataclass
class Stage:
    """A servo, the bridge that drives it, and what was commanded."""

    line: Line
    servo: AnyServo
    horns: Horns
    joint: JointPlan
    max_step_rad: float
    wish: float | None = None

    def __post_init__(self) -> None:
        leg = LegPlan("l", (self.joint,), self.max_step_rad)
        self.line.port.servos = (self.servo,)
        self.mailbox = Mailbox()
        plan = dataclasses.replace(self.line.plan, legs=(leg,))
        self.cycle = Cycle(plan, self.line.bus, "drive", self.mailbox, 1)
        self.ticks = 0

    @property
    def near_rad(self) -> float:
        """What counts as where the horn is: two steps, or one of the easy pace."""
        step = self.joint.model.step_rad
        return max(2 * step, EASY_SHARE * self.max_step_rad) + step

    def told(self) -> float:
        """Where the joint is by the servo's own numbers, rad."""
        register = self.servo.model.registers["present_position"]
        short, self.servo.short = self.servo.short, 0.0
        data = self.servo.read(register.address, register.size)
        self.servo.short = short
        assert isinstance(data, bytes)
        return self.joint.angle(register.value(data))

    def tick(self, command: float | None) -> None:
        """One tick: the horn moves at most a step towards the command, or not at all."""
        if command is None:
            command = self.wish  # for another 200 ms
        else:
            self.wish = command
            payload = encode(Command(desired=[command]))
            self.mailbox.store_command("l", payload, MSGPACK, time.monotonic_ns())
        before, at, writes = self.horns.angle(0), self.told(), self.servo.writes
        drove = self.servo.drives
        now_ns = time.monotonic_ns()
        self.cycle.tick(0, self.ticks, now_ns, now_ns)
        self.ticks += 1
        moved = abs(self.horns.angle(0) - before)
        step = self.joint.model.step_rad
        if command is None and self.ticks == 1:
            assert self.servo.writes == writes
        if not drove:
            assert moved <= self.near_rad, f"woke {moved} rad off"
            return
        # The servo's own numbers may go the other way: it says where it is after.
        now = self.told()
        if moved:
            assert moved <= max(self.max_step_rad, step) * (1 + 1e-9) + 1e-9, f"jumped {moved} rad"
            assert abs(abs(now - at) - moved) <= step, "told otherwise than moved"
            assert command is not None
            # Towards the command, or what limits leave of it; a sag or rounding is less than near.
            lower, upper = min(self.joint.lower_rad, at), max(self.joint.upper_rad, at)
            wanted = min(max(command, lower), upper)
            away = abs(now - wanted) - abs(at - wanted)
            assert away <= self.near_rad, f"{away} rad away from {wanted}"


def registers_of(model: ServoModel) -> st.SearchStrategy[dict[str, int]]:
    """All that decides how a model follows goals."""
    step = st.integers(model.lowest, model.highest)
    whole, wheel = (model.lowest, model.highest), (0, 0)
    multi = (model.multi_turn or model.highest,) * 2
    limits = st.one_of(
        st.just(whole), st.sampled_from([wheel, multi]), st.tuples(step, step), st.just(whole)
    )
    torque = st.integers(0, 1)
    goal = step
    if model.compact:
        fields: dict[str, Any] = {}
        if model.feetech:
            fields["shutdown"] = st.sampled_from([0x2C, 0x25, 0])
            fields["eeprom_lock"] = st.integers(0, 1)
        if "homing_offset" in model.registers:
            fields |= {
                "resolution_divider": st.sampled_from([1] * 7 + [2]),
                "homing_offset": st.one_of(st.just(0), st.integers(-2047, 2047)),
                "phase": st.sampled_from([12, 12, 28]),
                "torque_limit": st.sampled_from([1000, 1000, 500, 0]),
            }
            goal = st.one_of(step, st.integers(-28672, 28672))
        elif "resolution_divider" in model.registers:
            fields |= {
                "resolution_divider": st.sampled_from([1, 1, 1, 2, 4]),
                "multi_turn_offset": st.one_of(st.just(0), st.integers(-24576, 24576)),
            }
            goal = st.one_of(step, st.integers(-28672, 28672))
        if "torque_control" in model.registers:
            fields["torque_control"] = st.sampled_from([0] * 7 + [1])
        if "control_mode" in model.registers:
            fields["control_mode"] = st.sampled_from([model.joint_mode] * 7 + [1, 3])
        if "drive_mode" in model.registers:
            fields["drive_mode"] = st.sampled_from([0, 0, 0, 1, 1, 2])
    else:
        fields = {
            "operating_mode": st.sampled_from([3, 3, 3, 3, 3, 4, 4, 5, 5, 0, 1, 16]),
            "drive_mode": st.sampled_from([0, 0, 0, 0, 1, 1, 4, 5, 8, 2, 13]),
            "secondary_id": st.sampled_from([255] * 7 + [253, 2]),
            "homing_offset": st.one_of(
                st.just(0), st.integers(-1100, 1100), st.integers(-(2**20), 2**20)
            ),
        }
        if "startup" in model.registers:
            fields["startup"] = st.integers(0, 1)
        goal = st.one_of(step, st.integers(-20000, 20000))
    rest = st.fixed_dictionaries({**fields, "torque_enable": torque, "goal_position": goal})
    return st.builds(
        lambda limits, rest: {"lower_limit": limits[0], "upper_limit": limits[1], **rest},
        limits,
        rest,
    )


# One of each control table as likely as all the others: 30 X-series have the same.
KINDS = list({id(model.registers): model.name for model in MODELS}.values())
models = st.one_of(st.sampled_from(KINDS), st.sampled_from([model.name for model in MODELS]))
horn = st.one_of(st.floats(-2.5, 2.5), st.floats(-12.0, 12.0))
wish = st.one_of(st.floats(-3.0, 3.0), st.floats(-15.0, 15.0))
EVENTS = (
    "nothing", "nothing", "reboot", "reboot elsewhere", "let go", "switched on", "another's goal",
    "overload", "recovers", "deaf", "short", "late", "cable", "silence", "set again",
)  # fmt: skip
script = st.lists(st.tuples(st.sampled_from(EVENTS), wish, st.integers(1, 7), horn), max_size=6)


def happen(stage: Stage, what: str, where: float) -> None:
    """Something that the bridge does not do, and is not told."""
    servo, registers = stage.servo, stage.servo.model.registers

    def put(name: str, value: int) -> None:
        register = registers[name]
        servo.write(register.address, register.data(value))

    if what.startswith("reboot"):
        stage.horns.set_torque(0, False)
        if what.endswith("elsewhere"):
            stage.horns.place(0, where)
        servo.reboot()
    elif what == "let go":
        put("torque_enable", 0)
        stage.horns.place(0, where)
    elif what == "switched on":
        put("torque_enable", 1)
    elif what == "another's goal":
        lowest, highest = servo.goals()
        goal = servo.model.centre + round(where / servo.model.step_rad)
        least = -20000 if registers["goal_position"].signed else 0
        put("goal_position", min(max(goal, lowest, least), highest, 20000))
    elif what == "overload":
        servo.set_errors(servo.value("shutdown"))
        stage.horns.place(0, where)
    elif what == "recovers":
        if servo.model.feetech:
            put("torque_enable", 1)
        elif servo.model.compact:
            put("torque_limit", 1023)
        else:
            servo.reboot()
    elif what == "deaf":
        servo.deaf = 3
    elif what == "short":
        servo.short = 0.3
    elif what == "late":
        stage.line.late = 0.5
    elif what == "cable":
        stage.cycle.restart()
    elif what == "set again" and not servo.drives and not servo.model.feetech:
        # A Feetech servo keeps goals beyond its limits and stays: that is neither refused nor read.
        put("upper_limit", max(servo.value("upper_limit") // 2, 1))


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    data=st.data(),
    name=models,
    at=horn,
    direction=st.sampled_from([1, -1]),
    offset=st.floats(-3.0, 3.0),
    max_step=st.one_of(st.just(0.15), st.floats(0.001, 0.6)),
    limited=st.booleans(),
    keeps=st.booleans(),
    events=script,
    last=wish,
)
def test_nothing_moves_that_was_not_asked_to_move(
    lines: dict[Protocol, Line],
    data: st.DataObject,
    name: str,
    at: float,
    direction: int,
    offset: float,
    max_step: float,
    limited: bool,
    keeps: bool,
    events: list[tuple[str, float, int, float]],
    last: float,
) -> None:
    [model] = models_named(name)
    registers = data.draw(registers_of(model), label="registers")
    horns = Horns(1)
    horns.place(0, at)
    servo = any_servo(1, model.name, horns, 0, registers)
    servo.keeps_goal = keeps
    if model.compact and model.protocol == 2:  # XL-320: the manual does not say
        servo.goal_wakes = data.draw(st.booleans(), label="goal wakes")
    servo.switched_on = []
    ends = sorted(
        direction * (steps - model.centre) * model.step_rad + offset
        for steps in (model.lowest, model.highest)
    )
    if limited:
        ends = [max(ends[0], offset - 1.0), min(ends[1], offset + 1.0)]
    joint = JointPlan(1, "j", (model,), direction, offset, ends[0], ends[1])
    stage = Stage(lines[model.protocol], servo, horns, joint, max_step)
    for _ in range(2):
        stage.tick(None)
    assert servo.writes == 0  # nothing is written before a command
    for what, command, ticks, where in events:
        servo.short = stage.line.late = 0.0
        before = len(servo.switched_on)
        happen(stage, what, where)
        del servo.switched_on[before:]  # that was not the bridge
        for _ in range(ticks):
            stage.tick(None if what == "silence" else command)
    servo.short, servo.deaf, stage.line.late = 0.0, 0, 0.0
    moved, start = 0.0, stage.told()
    for _ in range(SETTLED_TICKS):
        now = horns.angle(0)
        stage.tick(last)
        moved += abs(horns.angle(0) - now)
    near = stage.near_rad / model.step_rad
    assert max(servo.switched_on, default=0) <= near, "torque came on with an old goal"
    why = stage.cycle.lacking.get("l", "")
    bounds = stage.cycle.drivers["l"].bounds[0]
    wanted = min(max(last, bounds[0]), bounds[1])
    there = abs(stage.told() - wanted) <= 2 * model.step_rad
    # Found outside its limits, and not told to come in by a whole step.
    step = model.step_rad
    stays = last - step < start < bounds[0] or bounds[1] < start < last + step
    assert moved or there or why or stays, "neither moved, nor said why"
    event("moved" if moved else "there" if there else why.split(" (")[-1][:30])


@pytest.mark.parametrize("name", KINDS)
def test_a_late_answer_never_passes_for_one_to_a_later_question(
    lines: dict[Protocol, Line], name: str
) -> None:
    """Whatever was asked before, and whatever is asked next: also the same of a horn that moved."""
    [model] = models_named(name)
    line, horns = lines[model.protocol], Horns(1)
    servo = any_servo(1, name, horns, 0)
    line.port.servos = (servo,)
    blocks = {*model.settings, model.watched, model.goal_and_motion, model.state, model.measured}
    late = line.bus.late[1]
    for n, (before, block) in enumerate(itertools.product(blocks, blocks)):
        line.late = 1.0
        assert line.bus.read([1], before)[1].data is None
        line.late = 0.0
        horns.place(0, 0.01 * n)
        assert line.bus.read([1], block)[1].data == servo.read(block.address, block.size)
    assert line.bus.late[1] == late + len(blocks) ** 2
