"""The demo: its files and figures, and its end when something goes wrong."""

from __future__ import annotations

import json
import os
import re
import signal
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

from adaptive_contact.service.recording import read_recording

pytestmark = pytest.mark.e2e

WAIT_S = 180.0  # the first start of an installation compiles, which takes long beside other work


def test_it_writes_what_it_shows(start: Callable[..., Any], tmp_path: Path) -> None:
    args = ("--seconds", "24", "--seed", "3", "--out", "here/demo", "--web", "--no-browser")
    demo = start("demo", *args)
    url = demo.wait_line(r"live page at (http://\S+)").group(1)
    with urllib.request.urlopen(f"{url}stream", timeout=WAIT_S) as page:
        stream = page.read().decode()  # until its last words
    assert demo.wait(90) == 0, demo.lines
    for shown in ('"rf":[[', '"status":"adapting"', "event: end", "The demo is over"):
        assert shown in stream, shown
    pids = [
        int(line.split("process ")[1].split(",")[0]) for line in demo.lines if "process " in line
    ]
    assert len(pids) == 2, "service and simulator"
    assert not any(psutil.pid_exists(pid) for pid in pids)
    out = tmp_path / "here" / "demo"
    assert {path.name for path in out.iterdir()} == {"demo.mcap", "report.html", "summary.json"}

    summary = json.loads((out / "summary.json").read_text("utf-8"))
    assert (summary["seed"], summary["robot"]) == (3, "hexapod-ax12a")
    assert summary["drift"]["values"].keys() == {"friction", "mass"}
    assert 5 < summary["drift"]["at_s"] < 20
    before = summary["before"]
    assert before["counted"]["touches"] >= 12
    assert before["counted"]["recall"] >= 0.9
    assert 0 < before["counted"]["latency_median_ms"] < 40
    assert before["false_alarms"] <= 1
    assert set(before["legs"]) == {"lf", "lm", "lr", "rf", "rm", "rr"}
    # A leg with four times the friction is another leg: a model that stays the same cannot do.
    frozen = summary["frozen_after"]["legs"]["rf"]
    learned = summary["after"]["legs"]["rf"]
    assert frozen["swings_with_errors"] >= 4
    assert learned["swings_with_errors"] <= frozen["swings_with_errors"] / 2
    assert summary["frozen_after"]["counted"]["touches"] == summary["after"]["counted"]["touches"]
    assert any(line == summary["result"][2] for line in demo.lines)

    drawn = json.loads(re.findall(r"<script type=.application/json.*?>(.*?)</script>",
                                  (out / "report.html").read_text("utf-8"))[0])  # fmt: skip
    assert drawn["title"].splitlines() == summary["result"]
    assert drawn["mark_ms"] == round(1000 * summary["drift"]["at_s"])
    assert [leg["leg"] for leg in drawn["legs"]] == [*before["legs"], "rf\nfrozen"]
    assert all(leg["truth"] and leg["t_ms"] for leg in drawn["legs"])
    kinds = {record.key.rpartition("/")[2] for record in read_recording(out / "demo.mcap")}
    assert {"servo", "truth", "contact", "learner", "status"} <= kinds


def _processes(demo: Any) -> tuple[int, int]:
    service = demo.wait_line(r"^service +process (\d+),", WAIT_S)
    simulator = demo.wait_line(r"^simulator +process (\d+),", WAIT_S)
    return int(service.group(1)), int(simulator.group(1))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_it_ends_everything_it_started(start: Callable[..., Any], number: int) -> None:
    demo = start("demo", "--seconds", "60", "--out", "out")
    service, simulator = _processes(demo)
    assert demo.stop(number) == 130
    assert not psutil.pid_exists(service)
    assert not psutil.pid_exists(simulator)
    assert demo.lines[-1] == "adaptive-contact: stopped; nothing was judged"


@pytest.mark.parametrize("which", ["the service", "the simulator"])
def test_the_failure_of_a_process_is_one_line(
    start: Callable[..., Any], tmp_path: Path, which: str
) -> None:
    demo = start("demo", "--seconds", "60", "--out", "out")
    service, simulator = _processes(demo)
    demo.wait_line(r"^ +0 of", WAIT_S)
    os.kill(service if which == "the service" else simulator, signal.SIGKILL)
    assert demo.wait(WAIT_S) == 2
    assert not psutil.pid_exists(service)
    assert not psutil.pid_exists(simulator)
    assert demo.lines[-1].startswith(f"adaptive-contact: {which} ended too early (exit code -9)")
    assert not any("Traceback" in line for line in demo.lines)
    assert not (tmp_path / "out" / "report.html").exists()
