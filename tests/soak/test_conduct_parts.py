"""The parts that a soak is conducted with: processes found and killed, and the plan."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adaptive_contact.errors import ConfigurationError

pytest.importorskip("mujoco")

from adaptive_contact.cli._child import Child
from adaptive_contact_sim.scenario import parse_drift

from .conduct import born, children_of, crash_service, resident_mb
from .plan import SoakPlan


@pytest.mark.e2e
def test_a_service_is_killed_as_by_a_crash(tmp_path: Path) -> None:
    """It used to be asked to end, and saved everything before it did."""
    listen = ("--listen", "tcp/127.0.0.1:0", "--state", str(tmp_path), "--log-level", "warning")
    with Child("the service", ("serve", *listen)) as child:
        assert born(child.pid)
        crash_service(child)
        assert not child.running
        assert "exit code -9" in str(child.failure())
        assert born(child.pid) == ""


def test_a_program_that_compiles_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first start takes minutes on a slow or busy computer."""
    go, popen = tmp_path / "go", subprocess.Popen
    code = (
        "import pathlib, sys, time\n"
        "print('compiling the arithmetic of a tick', flush=True)\n"
        "while not pathlib.Path(sys.argv[1]).exists(): time.sleep(0.01)\n"
        "time.sleep(0.3); print('ready', flush=True); time.sleep(60)\n"
    )
    monkeypatch.setattr(
        subprocess, "Popen", lambda _, **how: popen([sys.executable, "-c", code, str(go)], **how)
    )
    with Child("the program", ()) as child:
        child.wait_line(re.compile("compiling"), 60.0)
        go.touch()
        child.wait_line(re.compile("ready"), 0.0)


def test_a_process_is_told_from_a_later_one_of_its_id() -> None:
    assert born(os.getpid()).isdigit()
    assert born(2**22 + 1) == "", "beyond any id"


def test_children_of_a_process_are_found() -> None:
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        until = time.monotonic() + 20
        while not (found := children_of(process.pid)):
            assert time.monotonic() < until
            time.sleep(0.01)
        assert all(resident_mb(pid) > 0.1 for pid in found)
        process.communicate(b"\n", timeout=20)


def test_the_plan_is_one_that_the_simulator_takes() -> None:
    for minutes in (1.0, 30.0, 600.0):
        plan = SoakPlan(minutes=minutes)
        kinds = [fault.kind for fault in plan.faults]
        assert sorted(kinds) == ["router", "router", "service"]
        for drift in plan.drifts:
            assert parse_drift(drift.option).at_s == pytest.approx(drift.at_s)
            assert drift.at_s + drift.duration_s < plan.seconds
    with pytest.raises(ConfigurationError, match="expected 1 to 1440 min"):
        SoakPlan(minutes=0.5)
