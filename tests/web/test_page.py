"""The page's threads between a real Zenoh and a browser's stream, without a service."""

from __future__ import annotations

from typing import Any

import pytest

from adaptive_contact.service.link import Link, Request, client_settings
from adaptive_contact.service.settings import SERVICE_TOKEN
from adaptive_contact.service.status import SERVICE_STATUS, LegFacts, ServiceStatus
from adaptive_contact.web import LivePage, WebSettings, page
from adaptive_contact.wire import LearnerStatus, LegTrace, learner_key, trace_key

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


def test_a_service_that_does_not_answer_for_its_ticks_is_named(
    router: Link, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "_UNANSWERED", 3)
    with (
        Link.open(client_settings(router.endpoints)) as own,
        Link.open(client_settings(router.endpoints)) as link,
        LivePage(WebSettings()) as live,
    ):
        service = Service(own)
        live.follow(link)

        def named(found: dict[str, Any]) -> bool:
            service.say()
            return "does not answer for its ticks" in str(found.get("banner"))

        found = events(live.url, named)
        (entry,) = found["banner"]
        assert "docs/security.md" in entry["do"]


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
        live.follow(link)

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


def test_closing_twice_is_safe() -> None:
    live = LivePage(WebSettings())
    live.close("over")
    live.close()
    live.wait()
