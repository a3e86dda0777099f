"""kill -9 at any instant: the state opens, and holds at least what was said to be saved."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from adaptive_contact.robot import shipped_robot
from adaptive_contact.service.link import Link, client_settings, router_settings
from adaptive_contact.service.state import Record, StateStore, list_states
from adaptive_contact.status import SERVICE_STATUS, ServiceStatus
from adaptive_contact.wire import decode
from programs import Program
from rig import Robot50
from waiting import until

from .saver import LEGS, identity

SAVER = Path(__file__).with_name("saver.py")


def numbers(folder: Path) -> list[int]:
    """What each leg would go on from; every file that is there must be whole."""
    store = StateStore.open(folder, "mini")
    assert store.trouble is None, "a killed service must not keep its folder locked"
    found = []
    for leg in LEGS:
        records = [record for _, record in store.candidates(identity(leg))]
        assert records, leg
        for record in records:
            assert isinstance(record, Record), (leg, record)
            number = record.body["number"]
            assert record.body["rows"] == bytes([number % 251]) * 300_000
        found.append(records[0].body["number"])
    store.close()
    return found


def kill_over_and_over(folder: Path, kills: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    newest = 0
    said = 0  # rounds that were wholly on disk
    for _ in range(kills):
        with contextlib.closing(Program(SAVER, folder, newest + 1)) as saver:
            # Not before a first round: until then there may be nothing to open.
            saver.wait_line("ready" if said else r"\d")
            time.sleep(rng.uniform(0.0, 0.1))  # the instant of the kill, not a synchronisation
            saver.process.kill()
        said = max([said, *(int(line) for line in saver.lines if line.isdigit())])
        found = numbers(folder)
        assert min(found) >= said, "what was said to be on disk is there"
        newest = max(found)


@pytest.mark.e2e
@pytest.mark.timeout(1800)
def test_random_kills(tmp_path: Path) -> None:
    """A few; ``KILLS=100 pytest tests/state/test_kill.py`` for as many as were asked for."""
    kill_over_and_over(tmp_path, int(os.environ.get("KILLS", "4")), seed=1)


@contextlib.contextmanager
def serving(endpoint: str, folder: Path) -> Iterator[None]:
    """The real service, killed at the end."""
    words = ("-m", "adaptive_contact", "serve", "--connect", endpoint, "--state", folder)
    with contextlib.closing(Program(*words, "--log-level", "error")) as service:
        yield
        assert service.process.poll() is None, "it ended by itself"
        service.process.kill()


def wait_status(link: Link, test: Callable[[ServiceStatus], bool]) -> ServiceStatus:
    def told() -> list[ServiceStatus]:
        replies = link.query(SERVICE_STATUS, timeout_s=1.0)
        statuses = [decode(one.payload, ServiceStatus, one.encoding) for one in replies]
        return [one for one in statuses if isinstance(one, ServiceStatus) and test(one)]

    found: list[ServiceStatus] = until(told)
    return found[0]


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_random_kills_of_a_whole_service(tmp_path: Path) -> None:
    """From its first import on, while it starts, restores, learns and saves."""
    rng = np.random.default_rng(2)
    kills = int(os.environ.get("KILLS", "4"))
    legs = len(shipped_robot().leg_ids)
    with Link.open(router_settings(["tcp/127.0.0.1:0"])) as router:
        endpoint = router.endpoints[0]
        robot = Robot50(endpoint, shipped_robot().leg_ids, run=1, touch=lambda _: False)
        with contextlib.closing(robot), Link.open(client_settings([endpoint])) as link:
            with serving(endpoint, tmp_path):  # until then there may be nothing to open
                wait_status(link, lambda s: s.state is not None and s.state.saved >= legs)
            for _ in range(kills):
                with serving(endpoint, tmp_path):
                    time.sleep(rng.uniform(0.0, 8.0))  # the instant of the kill
                found = list_states(tmp_path)
                assert all(isinstance(one.record, Record) for one in found), found
                assert len([one for one in found if one.path.suffix == ".state"]) == legs
            with serving(endpoint, tmp_path):
                last = wait_status(link, lambda s: s.uptime_s < 30 and s.state is not None)
                assert (len(last.state.restored), last.state.refused) == (legs, [])
