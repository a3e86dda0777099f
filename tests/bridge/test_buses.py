"""Buses as they are: a head, mixed models, servos that are mute, astray, or of another maker.

The real DynamixelSDK over pseudo-terminals, as everywhere here.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from typer.testing import CliRunner

from adaptive_contact.bridge.bus import Bus
from adaptive_contact.bridge.compare import Servo, compare, read_servos
from adaptive_contact.bridge.handshake import check_ports
from adaptive_contact.bridge.plan import plan_ports
from adaptive_contact.bridge.survey import find_servos, group, wanted_legs
from adaptive_contact.bridge.tables import (
    MODELS,
    ServoModel,
    feetech_name,
    model_of_number,
    models_named,
    number_name,
)
from adaptive_contact.cli import main as cli
from adaptive_contact.errors import BusError, ConfigurationError
from adaptive_contact.robot import Port, Robot, load_robot, parse_robot
from adaptive_contact_sim.virtual.servo import VirtualServo

sys.path.insert(0, str(Path(__file__).parent))
from anybus import serve


@pytest.fixture(scope="module", autouse=True)
def _commands() -> None:
    if not cli.app.registered_groups:
        cli._register()


Serve = Callable[..., tuple[Path, Sequence[VirtualServo]]]


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Serve]:
    """Serve the servos of SPECs (see ``anybus``) on a port."""
    stop, stack = threading.Event(), contextlib.ExitStack()
    threads: list[threading.Thread] = []

    def make(*specs: str, where: str = "bus") -> tuple[Path, Sequence[VirtualServo]]:
        (tmp_path / where).mkdir()
        server, _ = serve(tmp_path / where, specs)
        stack.enter_context(server)
        threads.append(threading.Thread(target=server.run, args=(stop,), daemon=True))
        threads[-1].start()
        return tmp_path / where / "port0", server.ports[0].servos

    yield make
    stop.set()
    for thread in threads:
        thread.join(5.0)
    stack.close()


def command(*words: object) -> str:
    """What a command that succeeds says."""
    result = CliRunner().invoke(cli.app, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def init(device: Path, *words: str) -> tuple[str, Robot]:
    out = device.parent / "robot.toml"
    said = command("robot", "init", "--device", device, "--out", out, "--force", *words)
    return said, load_robot(out)


def robot(device: Path, *legs: tuple[Sequence[int], object], **port: object) -> Robot:
    """A description of legs with these ids and models; its bus waits, as this computer is busy."""
    port = {"timeout_ms": 60, **port}
    settings = "".join(f"{name} = {_toml(value)}\n" for name, value in port.items())
    text = (
        '[robot]\nname = "t"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
        f'[port.main]\ndevice = "{device}"\n{settings}'
    )
    for i, (ids, model) in enumerate(legs):
        joints = [f"j{j}" for j in range(len(ids))]
        text += f'[[leg]]\nid = "l{i}"\njoints = {_toml(joints)}\n[leg.servos]\n'
        text += f"ids = {list(ids)}\nmodel = {_toml(model)}\n"
    return parse_robot(text, source="t")


def _toml(value: object) -> str:
    return msgspec.json.encode(value).decode()


# -- ignore, --ids, a model per joint ----------------------------------------------------------


def test_a_head_is_ignored_where_the_port_says_so(bus: Serve) -> None:
    device, servos = bus("1-3:AX-12A", "20-21:AX-12A")
    legs = ((1, 2, 3), "AX-12A")
    [one, other] = check_ports(plan_ports(robot(device, legs, timeout_ms=10))).errors
    assert "unexpected servo 20 (AX-12A); add it to a leg" in one
    assert "unexpected servo 21" in other
    assert "ignore = [20, 21] in [port.main]" in one
    aside = robot(device, legs, timeout_ms=10, ignore=[20, 21])
    assert check_ports(plan_ports(aside)).errors == []
    assert all(servo.writes == 0 for servo in servos)


def test_legs_of_any_ids_and_the_rest_ignored(bus: Serve) -> None:
    device, _ = bus("1-12:AX-12A", "13:MX-28", "14:AX-12A:number=999")
    said, found = init(device, "--ids", "2,4,6/8,10,12", "--legs", "right,left")
    assert "servo 1, 3, 5, 7, 9, 11, 13, 14 is no leg's: ignored" in said
    assert [leg.servos.ids for leg in found.legs] == [(2, 4, 6), (8, 10, 12)]
    assert found.leg_ids == ("right", "left")
    assert found.ports["main"].ignore == (1, 3, 5, 7, 9, 11, 13, 14)
    assert check_ports(plan_ports(found), full=False).errors == []


def test_legs_of_several_sizes(bus: Serve) -> None:
    device, _ = bus("1-5:AX-12A")
    said, found = init(device, "--ids", "5,4/3,2,1")
    assert "2 legs of 2 and 3 joints" in said
    assert [leg.joints for leg in found.legs] == [("hip", "knee"), ("coxa", "femur", "tibia")]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--ids", "1,2,x"), "'1,2,x' is no list of ids"),
        (("--ids", "1,2,3/"), "'' is no list of ids"),
        (("--ids", "1,2,3/3,4,5"), "3 is there twice"),
        (("--ids", "1,2,253"), "253 is no id"),
        (("--ids", "1,2,3/4,5"), "has a leg of 2 servos"),
        (("--ids", "head:1,2,3"), "--ids names port 'head'; --device gives main"),
        (("--ids", "1,2,3", "--legs", "a,b"), "2 legs are named, but the servos make 1"),
        (("--ids", "1,2,9"), "port main has no servo 9 (ids there are 1-3)"),
    ],
)
def test_ids_that_cannot_be(bus: Serve, words: tuple[str, ...], message: str) -> None:
    device, _ = bus("1-3:AX-12A")
    joints = ("--joints", "3") if message.startswith("has a leg") else ()
    with pytest.raises((BusError, ConfigurationError)) as caught:
        init(device, *words, *joints)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not (device.parent / "robot.toml").exists()


@pytest.mark.slow
def test_ids_that_two_ports_have(bus: Serve) -> None:
    left, _ = bus("1-3:AX-12A", where="left")
    right, _ = bus("1-3:AX-12A", where="right")
    devices = ("--device", f"left={left}", "--device", f"right={right}")
    out = left.parent / "robot.toml"
    with pytest.raises(BusError, match="ports left, right all have these servos; name the port"):
        command("robot", "init", *devices, "--out", out, "--ids", "1,2,3")
    command("robot", "init", *devices, "--out", out, "--ids", "right:1,2,3/left:3,2,1")
    legs = load_robot(out).legs
    assert [(leg.servos.port, leg.servos.ids) for leg in legs] == [
        ("right", (1, 2, 3)), ("left", (3, 2, 1)),
    ]  # fmt: skip
    assert [leg.port for leg in wanted_legs("1/b:2")] == [None, "b"]


def test_an_ax18_in_a_leg_of_ax12(bus: Serve) -> None:
    device, _ = bus("1-2:AX-12A", "3:AX-18A")
    said, found = init(device)
    assert "2 x AX-12A, ids 1-2; 1 x AX-18A, ids 3" in said
    assert found.legs[0].servos.models == ("AX-12A", "AX-12A", "AX-18A")
    right = robot(device, ((1, 2, 3), ["AX-12A", "AX-12A", "AX-18A"]))
    assert check_ports(plan_ports(right), full=False).errors == []
    wrong = robot(device, ((1, 2, 3), ["AX-12A", "AX-18A", "AX-18A"]))
    [line] = check_ports(plan_ports(wrong), full=False).errors
    assert "servo 2 (l0 j1) is AX-12A, expected AX-18A" in line
    with pytest.raises(ConfigurationError, match=r"servos\.model has 2 values for 3 joints"):
        robot(device, ((1, 2, 3), ["AX-12A", "AX-18A"]))


@pytest.mark.parametrize(
    ("protocol", "models"),
    [(1, ["AX-12A", "MX-28", "MX-106"]), (2, ["XL-320", "XL430-W250", "MX-28(2.0)"])],
)
def test_a_leg_of_different_control_tables_is_read_and_driven(
    run: Callable, protocol: int, models: list[str]
) -> None:
    """Each servo's own registers, in one tick: positions, goals and torque."""
    r = run("drive", model=models, protocol=protocol, legs=1)
    for index, angle in enumerate((0.3, -0.2, 0.1)):
        r.rig.backend.place(index, angle)
    feed = r.commanding([0.5, -0.4, 0.2])
    r.catcher.wait(
        feed(
            lambda c: (
                c.ticks
                and c.ticks[-1]["l0"].measured == pytest.approx([0.5, -0.4, 0.2], abs=0.006)
                and c.ticks[-1]["l0"].desired == pytest.approx([0.5, -0.4, 0.2], abs=0.006)
            )
        )
    )
    assert all(r.rig.servo(servo).torque for servo in (1, 2, 3))


# -- servos that are elsewhere, or answer little -----------------------------------------------


def test_a_servo_at_another_rate_is_looked_for_and_told(bus: Serve) -> None:
    device, servos = bus("1-5:AX-12A", "6:AX-12A:baud=57600")
    out = device.parent / "robot.toml"
    for words, why in [
        ((), "5 servos do not make legs"),
        (("--ids", "1,2,3/4,5,6"), "port main has no servo 6"),
    ]:
        ended = CliRunner().invoke(
            cli.app, ["robot", "init", "--device", str(device), "--out", str(out), *words]
        )
        assert why in str(ended.exception)
        assert "servo 6 answers at 57600 baud, protocol 1" in ended.output
    described = robot(device, ((1, 2, 3), "AX-12A"), ((4, 5, 6), "AX-12A"), timeout_ms=20)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "servo 6 answers at 57600 baud, protocol 1, not at 1000000 baud, protocol 1" in line
    assert "set its baud rate with DYNAMIXEL Wizard" in line
    assert "missing" not in line
    assert all(servo.writes == 0 for servo in servos)


def test_the_rate_of_most_servos_is_the_ports(bus: Serve) -> None:
    """A new servo at its own rate is the odd one, though it is heard first."""
    device, _ = bus("1:AX-12A:at=0.2", "2-4:AX-12A:baud=115200")
    out = device.parent / "robot.toml"
    words = ["robot", "init", "--device", str(device), "--out", str(out), "--force"]
    said = ""
    for _ in range(5):  # a busy computer's virtual servo may answer a ping too late
        said = CliRunner().invoke(cli.app, words).output
        if "servo 1" in said:
            break
    assert "ids 2-4; 115200 baud, protocol 1" in said
    assert "servo 1 answers at 1000000 baud, protocol 1" in said
    assert load_robot(out).ports["main"].baud == 115200
    found = find_servos("main", str(device), (1_000_000,))
    assert sorted(found.servos) == [1]


def test_all_servos_at_another_rate_and_protocol(bus: Serve) -> None:
    device, _ = bus("1-3:XL430-W250:baud=57600")
    described = robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=20)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "no servo answers at 1000000 baud, protocol 1" in line
    assert "set baud = 57600 and protocol = 2 in [port.main]" in line


@pytest.mark.parametrize("model", ["AX-12A", "XL-320", "XL430-W250"])
def test_a_servo_that_answers_pings_only_is_told_and_put_right(bus: Serve, model: str) -> None:
    device, servos = bus(f"1-2:{model}", f"3:{model}:status_return=0")
    described = robot(device, ((1, 2, 3), model), protocol=servos[0].model.protocol)
    [line] = check_ports(plan_ports(described), full=False).errors
    assert "servo 3 answers to pings but not to reads" in line
    assert "--configure" in line
    assert servos[2].value("status_return") == 0
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert findings.errors == []
    assert findings.done == ["port main: servo 3: status return level set to 2"]
    assert [servo.value("status_return") for servo in servos] == [2, 2, 2]
    assert [servo.writes for servo in servos[:2]] == [0, 0]


def test_init_lets_a_mute_servo_answer(bus: Serve) -> None:
    device, servos = bus("1-2:AX-12A", "3:AX-12A:status_return=0")
    said, found = init(device, "--configure")
    assert "port main: servo 3: status return level set to 2" in said
    assert found.legs[0].servos.ids == (1, 2, 3)
    assert servos[2].answers == 2


@pytest.mark.slow
def test_init_leaves_a_mute_head_alone(bus: Serve) -> None:
    device, servos = bus("1-2:AX-12A", "3,20:AX-12A:status_return=0")
    _, found = init(device, "--configure", "--ids", "1,2,3")
    assert [servo.answers for servo in servos] == [2, 2, 2, 0]
    assert found.ports["main"].ignore == (20,)


def test_a_locked_register_is_told(bus: Serve) -> None:
    device, servos = bus("1:XL-320:status_return=0:torque_enable=1")
    described = robot(device, ((1,), "XL-320"), protocol=2)
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert "switch its torque off first" in findings.advice[0]
    assert servos[0].value("status_return") == 0


def test_a_servo_that_confirms_no_writes_is_configured(bus: Serve) -> None:
    """At a status return level of 1 what was written is read back."""
    device, servos = bus("1-3:AX-12A:status_return=1:return_delay=250")
    described = robot(device, ((1, 2, 3), "AX-12A"))
    findings = check_ports(plan_ports(described), full=False, configure=True)
    assert len(findings.done) == 3
    assert findings.errors == findings.advice == []
    assert [servo.value("return_delay") for servo in servos] == [0, 0, 0]
    assert all(servo.answers == 1 for servo in servos)


def test_several_things_that_are_wrong_are_a_line_each(bus: Serve) -> None:
    device, _ = bus("1-2:AX-12A", "1:AX-12A:at=0.4", "20:AX-12A")
    path = write(device.parent / "robot.toml", robot(device, ((1, 2, 3), "AX-12A"), timeout_ms=10))
    words = [sys.executable, "-m", "adaptive_contact", "robot", "check", "--config", str(path)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=100)
    assert ended.returncode == 2
    first, *others = ended.stderr.splitlines()
    assert first == "adaptive-contact: 3 things stand in the way of the bridge:"
    assert [line[:4] for line in others] == ["  - "] * 3
    assert "missing servo 3 (l0 j2)" in others[0]


# -- models ------------------------------------------------------------------------------------


def test_every_model_has_a_number_of_its_own_and_a_manual() -> None:
    assert len({model.number for model in MODELS}) == len({m.name for m in MODELS}) == len(MODELS)
    assert all(model.manual.startswith("https://emanual.robotis.com/docs/en/") for model in MODELS)
    assert all(model_of_number(model.number) is model for model in MODELS)
    assert all(models_named(model.name) == (model,) for model in MODELS)


@pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)
def test_registers_of_a_model_do_not_overlap(model: ServoModel) -> None:
    taken = [at for r in model.registers.values() for at in range(r.address, r.address + r.size)]
    assert len(taken) == len(set(taken))


def test_every_register_is_where_others_tools_have_it() -> None:
    """Each register of each model, against tables that nobody here has typed."""
    path = Path(__file__).parent / "control_tables.json"
    told = json.loads(path.read_text(encoding="utf-8"))["tables"]
    for model in MODELS:
        compared: set[str] = set()
        for table in told:
            if model.number not in table["models"]:
                continue
            for name, place in table["registers"].items():
                register = model.registers[name]
                assert [register.address, register.size] == place, (model.name, name, table)
                compared.add(name)
        assert compared == set(model.registers), model.name


def test_a_family_of_two_control_tables_is_none() -> None:
    assert [m.name for m in models_named("XM-540")] == ["XM540-W150", "XM540-W270"]
    with pytest.raises(ConfigurationError, match=r"may be MX-106 or MX-106\(2\.0\), which have"):
        models_named("MX-10")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("xc430w250", "did you mean '2XC430-W250'"),
        ("AX-12B", "did you mean 'AX-12"),
        ("foo", "expected one such as AX-12A or XL430-W250; all that are known are in docs"),
        ("", "expected one such as"),
        ("EX-106+", "servo model 'EX-106+' has no control table here"),
    ],
)
def test_a_name_of_no_model(name: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        models_named(name)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 200


def test_models_that_are_named_though_there_is_no_table() -> None:
    assert number_name(107) == "EX-106+, model number 107"
    assert number_name(35073) == "RH-P12-RN, model number 35073"
    assert number_name(999) == "model number 999"


def test_the_other_firmware_of_an_mx(bus: Serve) -> None:
    device, _ = bus("1-3:MX-28(2.0)")
    with pytest.raises(ConfigurationError, match=r'or model = "MX-28\(2\.0\)" if it has that'):
        plan_ports(robot(device, ((1,), "MX-28"), protocol=2))
    said, found = init(device)
    assert "3 x MX-28(2.0), ids 1-3" in said
    assert found.legs[0].servos.model == "MX-28(2.0)"
    described = robot(device, ((1, 2, 3), "MX-28(2.0)"), protocol=2)
    assert check_ports(plan_ports(described), full=False, drive=True).errors == []


def test_fast_sync_read_is_not_for_an_xl320() -> None:
    with pytest.raises(ConfigurationError, match="XL-320 knows no fast sync read"):
        plan_ports(robot(Path("/dev/x"), ((1,), "XL-320"), protocol=2, fast=True))


class Feetech:
    """Answers reads as a Feetech STS servo: firmware, model number and id at its own places."""

    def __init__(self, servo: VirtualServo, number: bytes) -> None:
        def read(address: int, size: int) -> bytes:
            memory = bytes((3, 10, 0)) + number + bytes((servo.id, 0)) + bytes(80)
            return memory[address : address + size]

        servo.read = read  # type: ignore[method-assign,assignment]


@pytest.mark.parametrize(
    ("number", "name"),
    [((777).to_bytes(2, "little"), "STS3215"), ((1284).to_bytes(2, "big"), "SCS0009"),
     (b"\x63\x00", "number 99")],
)  # fmt: skip
def test_a_feetech_servo_is_no_dynamixel(bus: Serve, number: bytes, name: str) -> None:
    device, servos = bus("1-3:AX-12A")
    Feetech(servos[2], number)
    with pytest.raises(BusError) as caught:
        init(device)
    assert f"servo 3 (Feetech {name}, no Dynamixel) is of no known model" in str(caught.value)
    [line] = check_ports(plan_ports(robot(device, ((1, 2, 3), "AX-12A"))), full=False).errors
    assert f"is a Feetech {name}, no Dynamixel, expected AX-12A" in line
    assert servos[2].writes == 0


def test_a_dynamixel_is_no_feetech() -> None:
    # AX: id, baud rate, return delay; an id that is also the return delay.
    assert feetech_name(bytes((3, 1, 3)), 3) is None
    assert feetech_name(bytes((3, 1, 250)), 3) is None


# -- registers compared ------------------------------------------------------------------------


def test_check_tells_what_differs_and_what_shapes_the_motion(bus: Serve) -> None:
    device, servos = bus("1-5:AX-12A", "6:AX-12A:upper_slope=64:moving_speed=200")
    legs = ((1, 2, 3), "AX-12A"), ((4, 5, 6), "AX-12A")
    described = robot(device, *legs, timeout_ms=10)
    path = device.parent / "robot.toml"
    said = CliRunner().invoke(cli.app, ["robot", "check", "--config", str(write(path, described))])
    assert said.exit_code == 0
    assert (
        "CCW compliance slope differs among AX-12A: 32 in 5 servos, 64 in servo 6 (l1 j2)"
        in said.output
    )
    assert "moving speed of servo 6 (l1 j2) is 200: goals are followed at 2.3 rad/s" in said.output
    assert said.output.count("differs") == 1
    assert all(servo.writes == 0 for servo in servos)


def write(path: Path, described: Robot) -> Path:
    from adaptive_contact.robot.write import write_robot

    path.write_text(write_robot(described), encoding="utf-8")
    return path


def test_servos_that_are_alike_and_free_say_nothing(bus: Serve) -> None:
    device, _ = bus("1-2:AX-12A", "3:MX-28")
    described = robot(device, ((1, 2, 3), ["AX-12A", "AX-12A", "MX-28"]))
    assert compare(read_servos(plan_ports(described))) == []


def servo_of(model: str, number: int, **values: int) -> Servo:
    return Servo(number, f"l{number} j", models_named(model)[0], values)


@pytest.mark.parametrize(
    ("servos", "lines"),
    [
        (
            [servo_of("XM430-W350", n, profile_velocity=44, drive_mode=0) for n in (1, 2)],
            ["profile velocity of all 2 servos is 44: goals are followed at 1.1 rad/s at the most"],
        ),
        (
            [servo_of("XM430-W350", 1, profile_velocity=100, profile_acceleration=30,
                      drive_mode=4)],
            ["profile velocity of servo 1 (l1 j) is 100 ms: goals are reached so much later",
             "profile acceleration of servo 1 (l1 j) is 30 ms: so long a servo gathers speed"],
        ),
        (
            [servo_of("XM430-W350", 1, profile_acceleration=10, drive_mode=0)],
            ["is 10: goals are followed with a limited acceleration (3.75 rad/s²)"],
        ),
        (
            [servo_of("XL430-W250", n, drive_mode=n % 2) for n in (2, 4, 5)],
            ["drive mode differs among XL430-W250: 0 in 2 servos, 1 in servo 5 (l5 j) (1 is rev"],
        ),
        (
            [servo_of("XL430-W250", 1, pwm_limit=442), servo_of("AX-12A", 2, torque_limit=512)],
            ["torque limit of servo 2 (l2 j) is 512 of 1023: it drives with 50 %",
             "PWM limit of servo 1 (l1 j) is 442 of 885: it drives with 50 %"],
        ),
        ([servo_of("AX-12A", 1, torque_limit=0)], []),
        ([servo_of("MX-28", n, position_p=32, goal_acceleration=0) for n in (1, 2)], []),
        ([servo_of("MX-28", 1, position_p=32), servo_of("MX-64", 2, position_p=8)], []),
        (
            [servo_of("AX-12A", n, return_delay=250 * (n == 3)) for n in (1, 2, 3)],
            ["return delay differs among AX-12A: 0 in 2 servos, 250 in servo 3 (l3 j)"],
        ),
    ],
)  # fmt: skip
def test_what_is_said_of_registers(servos: list[Servo], lines: list[str]) -> None:
    said = compare(servos)
    assert len(said) == len(lines), said
    for line, part in zip(said, lines, strict=True):
        assert part in line


TUTORIAL = Path(__file__).parents[2] / "docs" / "tutorial.md"
REPLACED = [
    ["1:AX-12A:at=0.4"],
    ["9:AX-12A:baud=57600"],
    ["9:AX-18A"],
    ["9:AX-12A:return_delay=250:moving_speed=300:lower_slope=64"],
]


def test_the_tutorial_says_of_a_replaced_servo_what_the_commands_say(bus: Serve) -> None:
    text = TUTORIAL.read_text(encoding="utf-8").split("## When a servo or a horn was replaced")[1]
    lines = [
        line.removeprefix("adaptive-contact: ").removeprefix("  - ")
        for line in text.split("\n## ")[0].splitlines()
        if line.startswith(("adaptive-contact: port", "adaptive-contact: CW", "  - port"))
        or (line.startswith("adaptive-contact: ") and " servo 9 " in line)
    ]
    assert len(lines) == 8
    names = ("lf", "lm", "lr", "rf", "rm", "rr")
    said = []
    for i, new in enumerate(REPLACED):
        device, _ = bus("1-8:AX-12A", "10-18:AX-12A", *new, where=f"bus{i}")
        legs = [
            f'[[leg]]\nid = "{name}"\njoints = ["coxa", "femur", "tibia"]\n'
            f"servos = {{ ids = [{3 * j + 1}, {3 * j + 2}, {3 * j + 3}] }}\n"
            for j, name in enumerate(names)
        ]
        described = parse_robot(
            '[robot]\nname = "t"\nperiod_s = 0.02\nquantum_rad = 0.005\n'
            f'[port.main]\ndevice = "{device}"\n' + "".join(legs),
            source="t",
        )
        described = msgspec.structs.replace(
            described, ports={"main": Port(device=str(device), timeout_ms=20)}
        )
        findings = check_ports(plan_ports(described), full=False)
        found = findings.errors + findings.advice
        if not findings.errors:
            found += compare(read_servos(plan_ports(described)))
        said += [line.replace(str(device), "/home/you/bus/port0") for line in found]
    for line in lines:
        assert line in said, said


# -- bad input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("port", "message"),
    [
        ({"ignore": [253]}, "[port.main] ignore has 253; ids are 0 to 252"),
        ({"ignore": [2]}, "servo id 2 is in ignore of [port.main], too"),
        ({"ignore": ["x"]}, "ignore"),
        ({"ignroe": [2]}, "did you mean"),
    ],
)
def test_an_ignore_that_cannot_be(port: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        robot(Path("/dev/x"), ((1, 2, 3), "AX-12A"), **port)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("model", [7, ["AX-12A", 7, "AX-12A"], [], True])
def test_a_model_that_is_no_name(model: object) -> None:
    with pytest.raises(ConfigurationError) as caught:
        robot(Path("/dev/x"), ((1, 2, 3), model))
    assert "model" in str(caught.value)
    assert "\n" not in str(caught.value)


# -- the virtual X-series ----------------------------------------------------------------------


def master(device: Path, protocol: int = 2) -> Any:
    made = Bus("main", Port(device=str(device), protocol=protocol, timeout_ms=200.0))  # type: ignore[arg-type]
    made.open()
    return made


def put(bus: Any, servo: int, address: int, data: bytes) -> int:
    """The error of a write: 0 when it was done."""
    result, error = bus._packets.writeTxRx(bus._port, servo, address, len(data), list(data))
    assert result == 0
    return int(error) & 0x7F


def get(bus: Any, servo: int, address: int, size: int) -> bytes:
    from adaptive_contact.bridge.tables import Block

    data = bus._read_one(servo, Block(address, size)).data
    assert data is not None
    return bytes(data)


@pytest.mark.parametrize(
    ("model", "addresses", "data"),
    [("XM430-W350", 168, 224), ("XM430-W350", 578, 634), ("XL330-M288", 168, 208),
     ("MX-64(2.0)", 168, 224)],
)  # fmt: skip
def test_indirect_addresses_stand_for_registers(
    bus: Serve, model: str, addresses: int, data: int
) -> None:
    device, [servo] = bus(f"1:{model}:at=0.5")
    line = master(device)
    assert get(line, 1, data, 2) == b"\0\0"
    assert put(line, 1, data, b"\x07") == 0  # stands for itself
    assert get(line, 1, data, 1) == b"\x07"
    goal, position = (
        servo.model.registers[n].address for n in ("goal_position", "present_position")
    )
    places = [*range(position, position + 4), *range(goal, goal + 4), 64]
    table = b"".join(at.to_bytes(2, "little") for at in places)
    assert put(line, 1, addresses, table) == 0
    assert get(line, 1, addresses, len(table)) == table
    here = get(line, 1, position, 4)
    assert here != bytes(4)
    assert get(line, 1, data, 4) == here
    assert put(line, 1, data + 8, b"\x01") == 0
    assert servo.torque
    assert put(line, 1, data + 4, (2100).to_bytes(4, "little")) == 0
    assert get(line, 1, goal, 4) == (2100).to_bytes(4, "little")
    assert put(line, 1, data + 4, (5000).to_bytes(4, "little")) == 6  # as the goal's own: a limit
    assert put(line, 1, data, b"\0\0\0\0") == 7  # as the position's own: read only
    assert get(line, 1, goal, 4) == (2100).to_bytes(4, "little")
    line.close()


@pytest.mark.parametrize("place", [0, 36, 63, 662, 65535])
def test_an_indirect_address_that_cannot_be_is_refused(bus: Serve, place: int) -> None:
    device, _ = bus("1:XM430-W350")
    line = master(device)
    assert put(line, 1, 170, place.to_bytes(2, "little")) == 4
    assert get(line, 1, 170, 2) == (225).to_bytes(2, "little")
    line.close()


def test_an_xl330_ends_where_its_indirect_data_do(bus: Serve) -> None:
    device, _ = bus("1:XL330-M288")
    line = master(device)
    assert get(line, 1, 227, 1) == b"\0"
    from adaptive_contact.bridge.tables import Block

    assert line._read_one(1, Block(228, 1)).data is None
    line.close()


def clear(bus: Any, servo: int, *parameters: int) -> int:
    size = len(parameters) + 3
    packet = [0, 0, 0, 0, servo, size & 0xFF, size >> 8, 0x10, *parameters, 0, 0]
    _, result, error = bus._packets.txRxPacket(bus._port, packet)
    assert result == 0
    return int(error) & 0x7F


KEY = (0x01, 0x44, 0x58, 0x4C, 0x22)


def test_clear_takes_whole_turns_away_and_moves_nothing(bus: Serve) -> None:
    device, [servo] = bus("1:XM430-W350:operating_mode=4")
    place = servo._backend
    line = master(device)
    assert put(line, 1, 64, b"\x01") == 0
    far = 2048 + 3 * 4096
    assert put(line, 1, 116, far.to_bytes(4, "little")) == 0
    moving = servo.model.registers["moving"].address
    end = time.monotonic() + 60.0
    while get(line, 1, moving, 1) != b"\0":
        assert time.monotonic() < end
    angle = place.angle(0)
    assert clear(line, 1, 0x02, 0x44, 0x58, 0x4C, 0x22) == 4  # reserved
    assert clear(line, 1, *KEY[:3]) == 4
    assert clear(line, 1, *KEY) == 0
    position = servo.model.registers["present_position"].address
    assert 0 <= int.from_bytes(get(line, 1, position, 4), "little") <= 4095
    assert int.from_bytes(get(line, 1, 116, 4), "little") == 2048
    assert put(line, 1, 116, (2048).to_bytes(4, "little")) == 0
    assert place.angle(0) == pytest.approx(angle, abs=2 * servo.model.step_rad)
    line.close()


def test_clear_is_refused_while_a_horn_turns_and_by_an_xl320(bus: Serve) -> None:
    device, [servo, _] = bus("1:XM430-W350", "2:XL-320")
    servo._backend.speed = lambda index: 1.0  # type: ignore[method-assign]
    line = master(device)
    assert clear(line, 1, *KEY) == 1
    assert clear(line, 2, *KEY) == 2
    line.close()


def test_an_xl320_shuts_down_by_its_torque_limit(bus: Serve) -> None:
    device, [servo] = bus("1:XL-320")
    described = robot(device, ((1,), "XL-320"), protocol=2)
    servo.set_errors(0x01)  # overload
    [line] = check_ports(plan_ports(described), full=False).advice
    assert "shut down, its torque limit is 0" in line
    assert "(35)" in line


def test_find_servos_names_what_it_wrote_nothing_to(bus: Serve) -> None:
    device, servos = bus("1-3:AX-12A:status_return=0")
    found = find_servos("main", str(device))
    assert found.mute == (1, 2, 3)
    assert found.done == ()
    with pytest.raises(BusError, match="servo 1, 2, 3 answers to pings but not to reads"):
        group([found], 3)
    assert all(servo.writes == 0 for servo in servos)
