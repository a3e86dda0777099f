"""What happens to a robot that nobody watches: events are right again within two seconds.

Real processes, real Zenoh, a fake learner behind the real checks of a stream.  Every test shows
what a person sees of the fault: in LearnerStatus, in ``watch``, or in the log.
"""

from __future__ import annotations

import os
import re
import time
from pathlib import Path
from typing import Any

import pytest

import rig
from programs import ROUTER, Program
from waiting import free_address

pytestmark = pytest.mark.e2e

# The 2 s, from the end of a cause to the arrival of an event on a sample sent after it; on
# a machine that is too busy for it, SLACK_S gives some more.
RECOVERY_S = 2.0 + float(os.environ.get("SLACK_S", "0"))


def test_a_killed_router_comes_back(serve: Any, program: Any) -> None:
    endpoint = f"tcp/{free_address()}"

    def start() -> Program:
        started: Program = program("-c", ROUTER, endpoint)
        started.wait_line(re.escape(endpoint))
        return started

    router = start()
    served = serve("--connect", endpoint)
    robot, listener = rig.Robot50(endpoint, ("lf", "rf")), rig.Listener(endpoint)
    with rig.closing(listener, robot):
        listener.steady(robot, "rf", 2)
        listener.wait(lambda me: "rf" in me.statuses)
        before = listener.statuses["rf"]
        router.process.kill()
        router.wait()
        last = robot.seq
        while robot.seq < last + 50:  # a second of outage
            time.sleep(0.02)
        start()
        back = time.monotonic()
        assert listener.wait_event("rf", robot, after=back) - back < RECOVERY_S
        listener.steady(robot, "rf")
        listener.steady(robot, "lf")
        listener.wait(lambda me: me.statuses["rf"].missed >= 40)
        status = listener.statuses["rf"]
        assert rig.uncounted(before, status) == 0
        assert str(status.missed) in rig.watched(listener.link).split()
    assert served.stop() == 0
    log = served.log.read_text()
    assert f"unreachable: nobody listens on {endpoint}" in log
    assert "router is back" in log


def test_a_cut_link_is_mended_and_no_other_leg_suffers(serve: Any) -> None:
    served = serve()
    wire = rig.Wire(served.endpoint)
    near, far = rig.Robot50(served.endpoint, ("lf",)), rig.Robot50(wire.endpoint, ("rf",))
    listener = rig.Listener(served.endpoint)
    with rig.closing(wire, listener, far, near):
        listener.steady(far, "rf", 2)
        wire.cut()
        began = len(listener.of("lf"))
        listener.wait(lambda me: "rf" in me.statuses and me.statuses["rf"].status == "silent")
        assert str(listener.statuses["rf"].note).startswith("no sample for 0.")
        before = listener.statuses["rf"]
        # Longer than the lease of 2 s, so that the link is given up and made anew.
        listener.wait(lambda me: len(me.of("lf")) >= began + 18)
        wire.mend()
        mended = time.monotonic()
        # What waited in the cut wire comes first, in one go; what is meant is what is sent now.
        assert listener.wait_event("rf", far, after=mended) - mended < RECOVERY_S
        listener.steady(far, "rf")
        listener.wait(lambda me: me.statuses["rf"].missed > 0)
        assert rig.uncounted(before, listener.statuses["rf"]) == 0
        seqs = [event.seq for event in listener.of("lf")]
        assert seqs == list(range(seqs[0], seqs[-1] + 1, rig.HALF)), "the other leg lost nothing"
        assert listener.statuses["lf"].missed == 0
    assert served.stop() == 0


def test_a_service_restarted_under_a_running_robot(serve: Any, tmp_path: Path) -> None:
    endpoint = f"tcp/{free_address()}"
    arguments = ("--listen", endpoint, "--state", str(tmp_path / "kept"))
    first = serve(*arguments)
    robot, listener = rig.Robot50(endpoint, ("rf",), run=7), rig.Listener(endpoint)
    with rig.closing(listener, robot):
        listener.steady(robot, "rf", 2)
        assert first.stop() == 0
        second = serve(*arguments)
        ready = time.monotonic()
        assert listener.wait_event("rf", robot, after=ready) - ready < RECOVERY_S
        listener.steady(robot, "rf")
        # A long gap counts once a few samples have confirmed it.
        listener.wait(lambda me: me.statuses["rf"].missed > 10)
        status = listener.statuses["rf"]
        assert status.ticks + status.missed <= robot.seq
        assert str(status.missed) in rig.watched(listener.link).split()
    assert second.stop() == 0
    assert re.search(r"state restored .*leg=rf model_version=3", second.log.read_text())
