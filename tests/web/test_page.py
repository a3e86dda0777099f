"""The page's threads between a real Zenoh and a browser's stream, without a service."""

from __future__ import annotations

import json
import re
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from adaptive_contact.errors import ConfigurationError, RecordingError
from adaptive_contact.service.link import Link, Request, client_settings
from adaptive_contact.service.recording import Recording
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.status import SERVICE_STATUS, LegFacts, ServiceStatus
from adaptive_contact.web import LivePage, WebSettings, page
from adaptive_contact.web.recordings import Recordings
from adaptive_contact.wire import (
    MARK,
    LearnerStatus,
    LegTrace,
    Mark,
    decode,
    learner_key,
    trace_key,
)
from waiting import until

from .running import events

pytestmark = pytest.mark.e2e


class Service:
    """Says that it is there and that samples come, and answers for ticks as it is told."""

    def __init__(self, link: Link) -> None:
        link.token(SERVICE_TOKEN)
        self.status = link.publisher(SERVICE_STATUS, history=1)
        self.learner = link.publisher(learner_key("rf"))
        self.ticks = 0
        self.say()

    def say(self) -> None:
        facts = {"rf": LegFacts(joints=["coxa", "femur", "tibia"])}
        self.status.put(
            ServiceStatus(
                version="1", robot="mini", period_s=0.02, baseline="x", legs=facts, uptime_s=1.0
            )
        )
        self.ticks += 50
        self.learner.put(
            LearnerStatus(
                leg="rf",
                t_ns=self.ticks * 20_000_000,
                status="valid",
                model_version=1,
                residual_rms=[0.0] * 3,
                noise_floor=[0.0] * 3,
                ticks=self.ticks,
            )
        )


def test_answers_of_strangers_stop_nothing(router: Link) -> None:
    """Payloads that are none, of another leg, of numbers beyond all numbers."""
    good = LegTrace(
        leg="rf",
        number=2**62,
        t_ns=[1, 20_000_000],
        seq=[1, 2],
        swing=[True, None],
        measured=[[0.1], [0.1, 0.2, 0.3]],
        desired=[[1e308], [0.1, 0.2, 0.3]],
        predicted=[None, [0.1]],
        test_ratio=[1e308, None],
    )
    with (
        Link.open(client_settings(router.endpoints)) as own,
        Link.open(client_settings(router.endpoints)) as link,
        LivePage(WebSettings()) as live,
    ):
        asked: list[str | None] = []

        def answer(request: Request) -> None:
            asked.append(request.parameter("after"))
            request.reply_raw(b"\xff\xff", "application/msgpack", trace_key("rf"))
            request.reply_raw(b"[1]", "application/json", trace_key("rf"))
            request.reply(good, trace_key("lf"))
            request.reply(good, trace_key("rf"))
            request.close()

        own.queryable(trace_key("*"), answer)
        service = Service(own)
        live.show_service(link)

        def drawn(found: dict[str, Any]) -> bool:
            service.say()
            return "rf" in found.get("k", {})

        found = events(live.url, drawn)
        assert set(found["k"]) == {"rf"}
        events(live.url, lambda piece: "t" in piece and piece["t"] > found["t"] + 500)
        assert asked[0] is None
        assert asked[-1] == str(2**62)


def test_a_fault_of_the_page_reaches_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> bytes:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(page.Frames, "frame", broken)
    monkeypatch.setattr("threading.excepthook", lambda _: None)
    with LivePage(WebSettings()) as live, pytest.raises(ZeroDivisionError, match="planted"):
        live.wait()


# -- recordings ------------------------------------------------------------------------------------


def act(live: LivePage, path: str) -> tuple[int, str]:
    """Ask a page with a token to do something."""
    address, _, token = live.url.partition("/?token=")
    port = address.rpartition(":")[2]
    request = urllib.request.Request(
        f"{address.rstrip('/')}{path}",
        method="POST",
        headers={
            "X-Adaptive-Contact": "page",
            "Cookie": f"adaptive_contact_{port}={token}",
        },
    )
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as refused:
        return refused.code, refused.read().decode()


def test_a_recording_has_what_came_and_its_marks(router: Link, tmp_path: Path) -> None:
    with (
        Link.open(client_settings(router.endpoints)) as own,
        Link.open(client_settings(router.endpoints)) as link,
        LivePage(WebSettings(record_to=tmp_path)) as live,
    ):
        assert "?token=" in live.url, "who may write files has shown a token, on loopback, too"
        assert act(live, "/record/start") == (409, "there is no router yet; nothing to record\n")
        live.show_service(link)
        assert act(live, "/mark?t=1&label=x") == (409, "nothing is being recorded\n")
        # Nothing that is asked names the file.
        status, state = act(live, "/record/start?file=../../evil&name=/tmp/evil")
        assert status == 200
        file = json.loads(state)["file"]
        assert re.fullmatch(r"page-\d{8}-\d{6}-\d{3}\.mcap", file)
        assert act(live, "/record/start") == (409, "a recording runs already; stop it first\n")
        service = Service(own)
        for bad in ("", "-1", "1e3", "9" * 11, "\u0663"):
            path = f"/mark?t={urllib.parse.quote(bad)}"
            assert act(live, path) == (400, "no time of this page; expected /mark?t=1200\n")
        before_s = time.time()
        label = urllib.parse.quote("slip\x1b[2J" + "x" * 200)
        assert act(live, f"/mark?t=0&label={label}")[0] == 200

        def recorded() -> bool:
            service.say()
            keys = {record.key for record in Recording(tmp_path / file)}
            return {MARK, learner_key("rf")} <= keys

        until(recorded)
        status, state = act(live, "/record/stop")
        facts = json.loads(state)
        assert not facts["running"]
        assert facts["bytes"] == (tmp_path / file).stat().st_size > 0
        assert act(live, "/record/stop")[0] == 200, "twice is safe"
    (mark,) = [record for record in Recording(tmp_path / file) if record.key == MARK]
    message = decode(mark.payload, Mark, mark.encoding)
    assert message.label == f"slip\\u001b[2J{'x' * 72}"
    assert before_s - 60 < message.t_ns / 1e9 < before_s
    assert [path.name for path in tmp_path.iterdir()] == [file]


def test_no_recording_writes_over_a_file_or_through_a_link(
    router: Link, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.strftime", lambda *_: "page-20260101-000000")
    monkeypatch.setattr("time.time_ns", lambda: 5_000_000)
    victim = tmp_path / "victim"
    victim.write_text("kept")
    (tmp_path / "page-20260101-000000-005.mcap").symlink_to(victim)
    with pytest.raises(RecordingError, match="cannot be written to"):
        Recordings(tmp_path).start(router)
    assert victim.read_text() == "kept"


def test_what_stands_in_the_way_of_a_recording_is_one_line(
    router: Link, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ConfigurationError, match="found no such folder"):
        LivePage(WebSettings(record_to=tmp_path / "none"))
    (tmp_path / "file").touch()
    with pytest.raises(ConfigurationError, match="found a file; give a folder"):
        LivePage(WebSettings(record_to=tmp_path / "file"))
    with LivePage(WebSettings()) as live:
        line = "this page records nothing; give `watch --web` a folder by --record-to\n"
        assert act(live, "/record/start") == (403, line)
    folder = tmp_path / "folder"
    folder.mkdir()
    recordings = Recordings(folder)
    with monkeypatch.context() as patch:
        patch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=499_000_000))
        with pytest.raises(RecordingError, match="make room first"):
            recordings.start(router)
    recordings.start(router)
    with monkeypatch.context() as patch:  # full while it runs: what there is stays
        patch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=499_000_000))
        until(lambda: recordings.state()["error"])
    state = recordings.state()
    assert (state["running"], state["error"][:25]) == (False, "less than 0.5 GB is free ")
    kept = Recording(folder / state["file"])
    assert not list(kept)
    assert kept.damage is None
    recordings.start(router)
    folder.rename(tmp_path / "elsewhere")
    error = until(lambda: recordings.state()["error"])
    assert error == "the folder cannot be used any more (No such file or directory)"
    with pytest.raises(RecordingError, match="cannot be written to"):
        recordings.start(router)


def test_a_recording_ends_by_itself_and_with_the_page(
    router: Link, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = Recordings(tmp_path)
    recordings.start(router)
    monkeypatch.setattr("adaptive_contact.web.recordings._LONGEST_S", 0.1)
    recordings.stop()
    recordings.start(router)
    until(lambda: not recordings.state()["running"])
    with LivePage(WebSettings(record_to=tmp_path)) as live:
        live.show_service(router)
        file = json.loads(act(live, "/record/start")[1])["file"]
    assert Recording(tmp_path / file).about["key"] == "robot/**"
    assert not list(Recording(tmp_path / file))
