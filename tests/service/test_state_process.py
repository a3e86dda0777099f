"""`serve --state` and `state show|reset` as processes, killed and restarted."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import adaptive_contact_models
from adaptive_contact.cli._options import learned_of
from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link
from adaptive_contact.service.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import LearnerStatus, ServoSample, learner_key, servo_key
from waiting import matched

pytestmark = pytest.mark.e2e

Join = Callable[..., Link]
Sample = Callable[..., ServoSample]


@pytest.fixture
def state(ours: Any) -> Callable[..., tuple[int, str, str]]:
    """Runs `adaptive-contact state …`."""
    return lambda *words: ours("state", *words)


def learner(link: Link, inbox: Any, leg: str, test: Callable[[LearnerStatus], bool]) -> Any:
    got = inbox(LearnerStatus)
    subscribed = link.subscribe(learner_key(leg), got)
    found = got.wait(lambda items: any(test(status) for status in items))
    subscribed.close()
    return next(status for status in found if test(status))


def feed(link: Link, leg: str, sample: Sample, first: int, last: int, **fields: Any) -> None:
    publisher = matched(link.publisher(servo_key(leg)))
    for seq in range(first, last + 1):
        publisher.put(sample(seq, contact=seq % 2 == 1, **fields))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_what_was_learned_survives_and_what_passed_meanwhile_is_counted(
    serve: Any, join: Join, inbox: Any, sample: Sample, tmp_path: Path, number: int
) -> None:
    folder = str(tmp_path / "kept")
    first = serve("--state", folder)
    link = join(first.endpoint)
    feed(link, "rf", sample, 1, 20, run=5)
    assert learner(link, inbox, "rf", lambda status: status.ticks == 20).contacts == 10
    if number == signal.SIGKILL:
        kept = inbox(ServiceStatus)
        link.subscribe(SERVICE_STATUS, kept, history=True)
        kept.wait(lambda items: items[-1].state is not None and items[-1].state.saved > 0, 40.0)
    assert first.stop(number) == (0 if number == signal.SIGTERM else -number)
    second = serve("--state", folder)
    assert "state restored" in second.log.read_text()
    link = join(second.endpoint)
    feed(link, "rf", sample, 31, 40, run=5)
    status = learner(link, inbox, "rf", lambda status: status.ticks == 10)
    assert status.contacts == 15, "the learner went on from where it was"
    assert status.missed == 10, "21 to 30 passed while nobody listened"
    assert second.stop() == 0


def test_a_second_service_says_so_and_does_not_save(
    serve: Any, join: Join, inbox: Any, tmp_path: Path
) -> None:
    folder = str(tmp_path)
    first = serve("--state", folder)
    second = serve("--state", folder, "--connect", first.endpoint)
    got = inbox(ServiceStatus)
    join(first.endpoint).subscribe(SERVICE_STATUS, got, history=True)
    found = got.wait(
        lambda items: len({s.instance for s in items if "another service runs" in str(s.note)}) > 1
    )
    assert any("every event comes twice; stop one of them" in str(one.note) for one in found)
    assert any(status.note and "in use by another service" in status.note for status in got.items)
    assert second.stop() == 0
    assert re.search(
        r"not alone .*another service runs here for robot mini .*every event comes twice",
        second.log.read_text(),
    )
    got.items.clear()
    got.wait(lambda items: items[-1].note is None)
    assert first.stop() == 0


def test_a_path_that_is_no_text_is_shown_as_far_as_it_is(
    serve: Any, join: Join, sample: Sample, inbox: Any, state: Any, tmp_path: Path
) -> None:
    folder = tmp_path / os.fsdecode(b"kept\xff")
    shown = str(tmp_path / "kept\N{REPLACEMENT CHARACTER}")
    served = serve("--state", str(folder))
    link = join(served.endpoint)
    kept = inbox(ServiceStatus)
    link.subscribe(SERVICE_STATUS, kept, history=True)
    assert kept.wait(2)[-1].state.folder == f"{shown}/mini"
    feed(link, "rf", sample, 1, 4)
    learner(link, inbox, "rf", lambda status: status.ticks == 4)
    assert served.stop() == 0
    rows = json.loads(state("show", "--state", str(folder), "--json")[1])
    assert rows
    assert all(row["file"].startswith(f"{shown}/mini/rf-") for row in rows)
    assert state("reset", "--state", str(folder), "--yes")[1] == f"forgot {len(rows)} files\n"
    assert state("show", "--state", str(folder))[1] == f"no state in {shown}\n"

    baseline = tmp_path / os.fsdecode(b"base\xff.json")
    source = Path(adaptive_contact_models.__file__).parent / "hexapod" / "baseline.json"
    baseline.write_bytes(source.read_bytes())
    _, origin = learned_of(shipped_robot(), None, baseline)
    assert origin == str(tmp_path / "base\N{REPLACEMENT CHARACTER}.json")


def test_contradictory_options_get_one_line(ours: Any, tmp_path: Path) -> None:
    done = ours("serve", "--state", tmp_path, "--no-state")
    assert (done.code, "--state and --no-state contradict each other" in done.err) == (2, True)


def test_show_and_reset(
    serve: Any, join: Join, inbox: Any, sample: Sample, state: Any, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    folder = tmp_path / "kept"
    code, _, error = state("show", "--state", str(folder))
    assert (code, error.count("\n")) == (2, 1)
    assert "is no folder; give the --state DIR of the service" in error
    served = serve("--state", str(folder))
    link = join(served.endpoint)
    for leg in ("lf", "rf"):
        feed(link, leg, sample, 1, 4)
        learner(link, inbox, leg, lambda status: status.ticks == 4)
    assert served.stop() == 0
    # A look between two samples of a leg may have saved it before the end did.
    for before in folder.glob("*/*.before"):
        before.unlink()

    code, out, error = state("show", "--state", str(folder), "--json")
    assert (code, error) == (0, "")
    rows = json.loads(out)
    assert [(row["robot"], row["leg"], row["model_version"]) for row in rows] == [
        ("mini", "lf", 3),
        ("mini", "rf", 3),
    ]
    assert all(row["refused"] is None for row in rows)
    damaged = Path(rows[0]["file"])
    damaged.write_bytes(damaged.read_bytes()[:-9])
    monkeypatch.setenv("COLUMNS", "80")
    _, out, _ = state("show", "--state", str(folder))
    assert out.startswith(f"mini, in {folder}/mini\n")
    assert f"{damaged.name}: damaged: " in out
    names = [Path(row["file"]).name for row in rows]
    listed = [line.split() for line in out.splitlines() if " kB " in line]
    assert [(line[-1], line[-2]) for line in listed] == [
        (name, "refused" if name == damaged.name else "sound") for name in names
    ]
    assert max(map(len, out.splitlines()[1:5])) <= 80

    # What the learner refused is no state to go on from, whole as it may be.
    whole = Path(rows[1]["file"])
    aside = whole.with_name(f"{whole.name}.refused")
    whole.rename(aside)
    for before in folder.glob("*/*.before"):
        before.unlink()
    _, out, _ = state("show", "--state", str(folder), "--leg", "rf")
    assert "state.refused" in out
    aside.rename(whole)

    running = serve("--state", str(folder))
    code, _, error = state("reset", "--state", str(folder), "--yes")
    assert code == 2
    assert "in use by another service" in error
    assert running.stop() == 0
    # What saves that were killed have left; `.old` is all that was learned.
    for path in (damaged, whole):
        path.with_suffix(".new").write_bytes(b"half of a st")
        path.with_suffix(".old").write_bytes(whole.read_bytes())
    code, _, error = state("reset", "--state", str(folder), "--leg", "zz", "--yes")
    assert code == 2
    assert "nothing of leg 'zz' is kept in" in error
    code, out, _ = state("reset", "--state", str(folder), "--leg", "rf", "--yes")
    assert (code, out.startswith("forgot")) == (0, True)
    assert not list(folder.glob("*/rf-*"))
    assert {path.suffix for path in folder.glob("*/lf-*")} >= {".new", ".old"}
    left = json.loads(state("show", "--state", str(folder), "--json")[1])
    assert {Path(row["file"]).name.partition("-")[0] for row in left} == {"lf"}
