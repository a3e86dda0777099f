"""The examples as their users run them; the gait controller's loop is in test_tutorial.py."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from adaptive_contact.bridge.status import BridgeStatus, Quantiles, ServoCounts
from adaptive_contact.bridge.survey import write_robot
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.wire import ContactEvent, contact_key

EXAMPLES = Path(__file__).parents[2] / "examples"


def status(state: str = "running", **more: object) -> BridgeStatus:
    quiet = Quantiles()
    return BridgeStatus(
        port="left", t_ns=1, mode="observe", state=state, rate_hz=50.0, wanted_hz=50.0,
        cycle_ms=quiet, jitter_ms=quiet, cycles=1, missed=0, **more,
    )  # fmt: skip


def test_the_examples_are_in_the_source_distribution() -> None:
    settings = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text(encoding="utf-8"))
    assert "examples" in settings["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]


def ended(process: subprocess.Popen[str], code: int) -> str:
    """What a process that ends by itself has said; a traceback is none of it."""
    said = process.communicate(timeout=40)[0]
    assert process.returncode == code, said
    assert "Traceback" not in said
    return said


def begin(example: str, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-u", str(EXAMPLES / example), *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--leg", "zz"), "has no leg 'zz'"),
        (("--config", "/nonexist.toml"), "cannot be read"),
        (("--reach", "0.3"), "cannot reach 0.300 m out"),
        (("--zenoh-config", "/nonexist.json5"), "/nonexist.json5"),
        (("--namespace", "a b"), "namespace 'a b' cannot be part of a key"),
    ],
)
def test_the_gait_controller_says_in_one_line_what_is_wrong(
    words: tuple[str, ...], message: str
) -> None:
    said = ended(begin("gait_controller.py", *words), 2)
    assert message in said
    assert said.count("\n") == 1


@pytest.mark.e2e
@pytest.mark.timeout(60)
def test_the_gait_controller_without_a_bridge() -> None:
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        said = ended(begin("gait_controller.py", "--connect", link.endpoints[0]), 2)
    assert said.startswith("gait_controller: no sample of leg 'rf' for 5 s; run")
    assert said.count("\n") == 1


@pytest.mark.e2e
@pytest.mark.timeout(60)
def test_the_logger_can_be_stopped_while_it_waits_for_a_router() -> None:
    logger = begin("logger.py", "--connect", "tcp/127.0.0.1:1")
    assert logger.stdout is not None
    assert "nobody listens on" in logger.stdout.readline()
    logger.send_signal(signal.SIGINT)
    ended(logger, 0)


@pytest.mark.e2e
@pytest.mark.timeout(60)
def test_a_bridge_without_a_router_says_so(rig: Callable, tmp_path: Path) -> None:
    r = rig(model="AX-12A", protocol=1)
    (tmp_path / "robot.toml").write_text(write_robot(r.robot))
    bridge = subprocess.Popen(
        [sys.executable, "-u", "-m", "adaptive_contact", "bridge", "dynamixel", "--config",
         str(tmp_path / "robot.toml"), "--connect", "tcp/127.0.0.1:1"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        assert bridge.stdout is not None
        said = [bridge.stdout.readline() for _ in range(2)]
        assert any("port p0: unreachable: nobody listens on" in line for line in said), said
    finally:
        bridge.send_signal(signal.SIGINT)
        ended(bridge, 0)


@pytest.mark.e2e
@pytest.mark.timeout(120)
def test_the_logger_tells_contacts_and_changes() -> None:
    silent = {"3": ServoCounts(silent=True, faults={"no_answer": 3})}
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as link:
        contacts = link.publisher(contact_key("rf"), reliable=True, history=1)
        bridge = link.publisher("robot/bridge/left/status")
        command = [sys.executable, "-u", str(EXAMPLES / "logger.py")]
        process = subprocess.Popen(
            [*command, "--connect", link.endpoints[0]], stdout=subprocess.PIPE, text=True
        )
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "listening\n"
            contacts.put(
                ContactEvent(
                    leg="rf", t_ns=40_000_000, onset_ns=27_000_000, seq=2, contact=True, score=1.5,
                    status="valid", residual=[0.0, 0.1, 0.0], model_version=1,
                )
            )  # fmt: skip
            assert "rf contact  score 1.5, touched 13 ms before" in process.stdout.readline()
            # A status is not kept for late joiners, and may be lost: it is sent until it is heard.
            telling, said = [status()], threading.Event()

            def tell() -> None:
                while not said.wait(0.02):
                    bridge.put(telling[0])

            teller = threading.Thread(target=tell)
            teller.start()
            try:
                assert process.stdout.readline().endswith("bridge left running\n")
                telling[0] = status("lost", servos=silent)
                assert process.stdout.readline().endswith("bridge left lost, silent servos 3\n")
            finally:
                said.set()
                teller.join()
        finally:
            process.terminate()
            assert process.wait(20) == 0
            process.stdout.close()
