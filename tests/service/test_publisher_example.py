"""The example of a control loop, with a real service: the loop is there first, and waits."""

from __future__ import annotations

import itertools
import signal
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.wire import LearnerStatus, ServoSample, learner_key, servo_key
from waiting import free_address

EXAMPLE = Path(__file__).parents[2] / "examples" / "publisher.py"


@pytest.mark.e2e
def test_the_loop_waits_for_the_router_and_its_samples_are_used(
    program: Any, join: Any, inbox: Any
) -> None:
    endpoint = f"tcp/{free_address()}"
    loop = program(EXAMPLE, endpoint)
    assert loop.wait_line("").string == f"no router at {endpoint}; trying again"
    served = program("-m", "adaptive_contact", "serve", "--no-state", "--listen", endpoint)
    served.wait_line("listening on")
    client = join(endpoint)
    statuses, samples = inbox(LearnerStatus), inbox(ServoSample)
    client.subscribe(learner_key("rf"), statuses)
    client.subscribe(servo_key("rf"), samples)
    status = statuses.wait(lambda items: items[-1].ticks > 50, 60.0)[-1]
    assert status.rejects == {}
    assert status.status == "valid"
    heard = samples.items[:50]
    assert len({sample.run for sample in heard}) == 1
    assert {sample.phase for sample in samples.items} == {"swing", "stance"}
    assert [b.seq - a.seq for a, b in itertools.pairwise(heard)] == [1] * 49
    assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(heard))
    assert loop.stop() == 130
    assert not [line for line in loop.lines if "Traceback" in line]
    assert served.stop(signal.SIGTERM) == 0
