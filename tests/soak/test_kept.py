"""What a soak keeps of what it heard."""

from __future__ import annotations

import json
from pathlib import Path

from .conduct import Broken, Heard
from .kept import keep_heard
from .made import event, take


def test_faults_and_events_are_kept_in_order_of_time(tmp_path: Path) -> None:
    heard = Heard(events=[(300, event(2)), (100, event(1))])
    path = tmp_path / "heard.jsonl"
    path.write_text("of the run before\n")
    keep_heard(take(heard, (Broken("router", 200, 250),)), path)
    first, fault, last = (json.loads(line) for line in path.read_text().splitlines())
    assert (first["heard_ns"], first["leg"], first["seq"]) == (100, "rf", 1)
    assert fault == {"fault": "router", "from_ns": 200, "to_ns": 250}
    assert (last["heard_ns"], last["seq"], last["contact"]) == (300, 2, True)
