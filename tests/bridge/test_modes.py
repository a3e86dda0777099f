"""Modes and limits that the bridge finds: driven as the servo has them, or refused in one line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import pytest
from described import AX, STS

from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.health import News, ServoHealth
from adaptive_contact.bridge.modes import setting
from adaptive_contact.bridge.packets import Status, fast_sync_status, split_fast_sync
from adaptive_contact.bridge.plan import PortPlan
from adaptive_contact.bridge.tables import MODELS, ServoModel, models_named

MX = {"model": "MX-28", "protocol": 1}
MX64 = {"model": "MX-64", "protocol": 1}
XM = {"model": "XM430-W350", "protocol": 2}

WRONG = [
    (AX, {"lower_limit": 0, "upper_limit": 0}, "is in wheel mode (both angle limits are 0)"),
    (AX, {"lower_limit": 600, "upper_limit": 500}, "has angle limits 600 and 500"),
    (AX, {"lower_limit": 1023, "upper_limit": 1023}, "has angle limits 1023 and 1023"),
    (
        MX,
        {"lower_limit": 4095, "upper_limit": 4095, "resolution_divider": 4},
        "has a resolution divider of 4, expected 1",
    ),
    (MX64, {"torque_control": 1}, "is in torque control mode (register 70 is 1), expected 0"),
    (XM, {"operating_mode": 0}, "is in operating mode 0 (current), expected 3"),
    (XM, {"operating_mode": 16}, "is in operating mode 16 (PWM), expected 3"),
    (XM, {"drive_mode": 2}, "has drive mode 2 (slave"),
    (XM, {"lower_limit": 3000, "upper_limit": 2000}, "has position limits 3000 and 2000"),
    (STS, {"control_mode": 1}, "does not follow goal positions (its control mode is 1), expected"),
    (STS, {"control_mode": 3}, "does not follow goal positions (its control mode is 3), expected"),
    (STS, {"resolution_divider": 4}, "has a resolution divider of 4, expected 1"),
    (STS, {"lower_limit": 3000, "upper_limit": 2000}, "has angle limits 3000 and 2000"),
]


@pytest.mark.parametrize("drive", [False, True])
@pytest.mark.parametrize(("kind", "registers", "words"), WRONG)
def test_what_follows_no_goals_is_refused_in_one_line(
    rig: Callable, kind: dict, registers: dict[str, int], words: str, drive: bool
) -> None:
    r = rig(**kind)
    for name, value in registers.items():
        r.servo(2).store(name, value)
    [line] = check_ports(r.plans, full=False, drive=drive).errors
    assert f"servo 2 {words}" in line
    assert "set" in line or "write" in line or "clear it" in line  # what to do
    assert ("FD software" in line) == (kind is STS)


UNDRIVEN = [
    ("drive_mode", 8, "torque on by goal", "clear it"),
    ("secondary_id", 2, "has secondary id 2, expected 255", "set it"),
]


@pytest.mark.parametrize(("name", "value", "words", "remedy"), UNDRIVEN)
def test_what_is_observed_and_not_driven(
    rig: Callable, name: str, value: int, words: str, remedy: str
) -> None:
    r = rig(**XM)
    r.servo(1).store(name, value)
    assert check_ports(r.plans, full=False).errors == []
    [line] = check_ports(r.plans, full=False, drive=True).errors
    assert words in line
    assert remedy in line


@pytest.mark.parametrize(
    "registers",
    [{"drive_mode": 1}, {"drive_mode": 4}, {"operating_mode": 4}, {"secondary_id": 253}],
)
def test_what_is_followed_is_let_through(rig: Callable, registers: dict[str, int]) -> None:
    r = rig(**XM)
    for name, value in registers.items():
        r.servo(1).store(name, value)
    findings = check_ports(r.plans, full=False, drive=True)
    assert findings.errors == findings.advice == []


def test_a_servo_that_is_replaced_by_one_set_differently_is_not_driven(run: Callable) -> None:
    r = run("drive", ticks=3, **XM)
    feed = r.commanding([0.4] * 3)
    r.catcher.wait(feed(lambda c: c.ticks[-1]["l0"].measured == pytest.approx([0.4] * 3, abs=0.02)))
    servo = r.rig.servo(2)
    servo.store("homing_offset", 512)
    servo.reboot()
    r.catcher.wait(feed(lambda c: any("set differently" in line for line in c.lines)))
    [line] = [line for line in r.catcher.lines if "set differently" in line]
    assert "homing offset 512, was 0" in line
    assert not servo.torque


def read_from(model: ServoModel, **registers: int) -> list[bytes]:
    """A servo's settings as they are read, those registers set, all else 0."""
    data = []
    for block in model.settings:
        memory = bytearray(block.size)
        for name, value in registers.items():
            place = model.registers.get(name)
            if place and block.address <= place.address < block.address + block.size:
                at = place.address - block.address
                memory[at : at + place.size] = value.to_bytes(
                    place.size, "little", signed=value < 0
                )
        data.append(bytes(memory))
    return data


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_every_model_as_delivered_is_driven_over_its_whole_travel(model: ServoModel) -> None:
    ends = {"lower_limit": model.lowest, "upper_limit": model.highest}
    modes = {"operating_mode": 3, "resolution_divider": 1, "secondary_id": 255}
    modes["control_mode"] = model.joint_mode or 0
    found = setting(model, read_from(model, **ends, **modes))
    assert found.wrong is found.undriven is None
    assert (found.lowest, found.highest) == (model.lowest, model.highest)


def test_a_homing_offset_takes_away_the_turn_that_torque_would_lose() -> None:
    """ROBOTIS forum 7814: homing -512, limits 2048 to 4095, at 3700: -396 once torque is on."""
    [model] = models_named("XC430-W240")
    ends = {"lower_limit": 2048, "upper_limit": 4095}
    modes = {"operating_mode": 3, "homing_offset": -512, "secondary_id": 255}
    found = setting(model, read_from(model, **ends, **modes))
    assert (found.lowest, found.highest) == (2048, 3583)


def test_multi_turn_is_driven_within_its_turn_and_an_scs_wheel_is_refused() -> None:
    [sts], [scs] = models_named("STS3215"), models_named("SCS0009")
    turns = setting(sts, read_from(sts, resolution_divider=1))  # both limits 0
    assert turns.wrong is None
    assert (turns.lowest, turns.highest, turns.ends) == (0, 4095, None)
    assert "is in multi-turn mode (both angle limits are 0)" in turns.advice
    assert "is in wheel mode" in setting(scs, read_from(scs)).wrong
    gain = setting(sts, read_from(sts, resolution_divider=1, position_p=99))
    assert gain.values == turns.values  # a gain may change while it is driven


@pytest.mark.parametrize("kind", [AX, MX, XM])
def test_late_answers_accuse_no_servo(rig: Callable, kind: dict) -> None:
    """Limits of 0 and 1023, and an answer to the first question in the place of the second's."""
    r = rig(seed=0, **kind)
    r.fault("late:p=0.25,ms=45")
    findings = check_ports(r.plans, full=False, drive=True)
    for line in findings.errors + findings.advice:
        for accusation in ("mode", "limits", "expected AX", "torque limit", "several servos"):
            assert accusation not in line, line


def test_when_all_answers_are_late_the_computer_is_named_once(rig: Callable) -> None:
    r = rig(**AX, legs=1)
    r.fault("late:ms=450")
    errors = check_ports(r.plans, full=False).errors
    assert len(errors) == 1
    assert "this computer is too busy" in errors[0]


@pytest.mark.parametrize("kind", [AX, pytest.param(XM, marks=pytest.mark.slow)])
def test_late_answers_are_waited_for_longer_and_named(rig: Callable, kind: dict) -> None:
    """Of servos that do answer, what is wrong is found all the same."""
    r = rig(**kind, legs=1)
    r.fault("late:ms=30")
    findings = check_ports(r.plans, full=False)
    assert findings.errors == []
    assert sum("this computer is too busy" in line for line in findings.advice) == 1
    r.fault("late:ms=30", "silent:id=2")
    [line] = check_ports(r.plans, full=False).errors
    assert "missing servo 2 (l0 j1); check cable, power, id and baud rate" in line


class Told:
    """What is said of servos whose answers come late, or not at all."""

    def __init__(self, plan: PortPlan) -> None:
        self.health = {joint.servo: ServoHealth() for joint in plan.joints}
        self.late = Counter[int]()
        self.news = News(plan)
        self.said: list[str] = []

    def look(self, seconds: int, late: Iterable[int] = (), dead: Iterable[int] = ()) -> list[str]:
        """Some seconds on: answers of some come late now and then, those of others not at all."""
        for second in range(seconds):
            self.late.update(late)
            for servo, record in self.health.items():
                misses = servo in dead or (servo in late and second % 2)
                record.misses = 3 if misses else 0
            self.said += self.news.lines(self.health, self.late)
        said, self.said = self.said, []
        return said


def test_a_crowd_of_late_servos_is_one_line_and_a_single_one_is_named(rig: Callable) -> None:
    told = Told(rig(**AX).plans[0])
    [busy] = told.look(60, late=(1, 2, 3, 4, 5, 6))
    assert "too busy" in busy
    assert told.look(12) == ["port p0: answers come in time again"]
    [line] = told.look(1, dead=(1,))
    assert "servo 1 (l0 j0): no answer; check its cable and power" in line


def test_a_dead_servo_is_named_on_a_busy_computer_too(rig: Callable) -> None:
    """The answers of all others come too late, now and then; of the dead one comes nothing."""
    told = Told(rig(**AX).plans[0])
    busy, silent = told.look(10, late=(1, 3, 4, 5, 6), dead=(2,))
    assert "too busy" in busy
    assert silent == "port p0: servo 2 (l0 j1): no answer; check its cable and power"
    assert told.look(10, late=range(1, 7)) == ["port p0: servo 2 (l0 j1): answers again"]


def test_a_servo_whose_answers_keep_coming_late_is_not_sent_to_its_cable(rig: Callable) -> None:
    [line] = Told(rig(**AX).plans[0]).look(20, late=(3,), dead=(3,))
    assert "servo 3 (l0 j2): its answers come too late; set timeout_ms higher in [port.p0]" in line


def test_a_part_cut_short_spoils_a_fast_answer_and_is_no_reading() -> None:
    """What follows a short part lies off its place; the ids no longer are those that were asked."""
    whole = fast_sync_status([Status(i, 0, bytes([i] * 4)) for i in (1, 2, 3)])
    short = fast_sync_status(
        [Status(1, 0, b"\1\1\1\1"), Status(2, 0, b"\0"), Status(3, 0, b"\3\3\3\3")]
    )
    assert [a.id for a in split_fast_sync(whole[8:-2], 4)] == [1, 2, 3]
    assert [a.id for a in split_fast_sync(short[8:-2], 4)] != [1, 2, 3]
