"""The examples as their users run them; the gait controller's loop is in test_tutorial.py."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from adaptive_contact.bridge.status import BridgeStatus, Quantiles, ServoCounts
from adaptive_contact.service.link import Link, router_settings
from adaptive_contact.wire import ContactEvent, contact_key

EXAMPLES = Path(__file__).parents[2] / "examples"


def status(state: str = "running", **more: object) -> BridgeStatus:
    quiet = Quantiles()
    return BridgeStatus(
        port="left", t_ns=1, mode="observe", state=state, rate_hz=50.0, wanted_hz=50.0,
        cycle_ms=quiet, jitter_ms=quiet, cycles=1, missed=0, **more,
    )  # fmt: skip


@pytest.mark.e2e
@pytest.mark.timeout(60)
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
            # A status is not kept for who comes late: the router has to have heard of the logger.
            deadline = time.monotonic() + 10.0
            while not bridge.matched and time.monotonic() < deadline:
                time.sleep(0.01)
            for message in (status(), status(), status("lost", servos=silent)):
                bridge.put(message)
            assert process.stdout.readline().endswith("bridge left running\n")
            assert process.stdout.readline().endswith("bridge left lost, silent servos 3\n")
        finally:
            process.terminate()
            assert process.wait(20) == 0
            process.stdout.close()
