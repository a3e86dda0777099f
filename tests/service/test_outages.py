"""No form outlives its source: what a service reports, as processes of each form pass it on."""

from __future__ import annotations

import itertools
import json
import math
import signal
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from test_foxglove_live import Client
from test_ros2_gateway import open_router
from test_ros2_gateway import port as port  # a fixture

import rig
from adaptive_contact.ros2 import rmw
from adaptive_contact.ros2.rmw import RosType
from adaptive_contact.ros2.types import typestore
from adaptive_contact.service.known_contacts import KnownContacts
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import (
    ALL_CONTACT,
    ContactEvent,
    Heartbeat,
    LegHeartbeat,
    decode,
)
from programs import Program
from test_docs import contacts_class
from waiting import until

LEGS = ("lf", "rf")
BOUND_S = 0.7
# A busy computer delays now one form, now another; what a form does by design it does each time.
TRIES = 4
S = 1_000_000_000


class Forms:
    """What each form says of each leg now: ``contact``, ``free`` or ``unknown``, and since when."""

    def __init__(self) -> None:
        self.said: dict[tuple[str, str], tuple[str, float]] = {}
        self.faults: list[object] = []

    def say(self, form: str, leg: str, contact: object, known: object = True) -> None:
        word = ("contact" if contact else "free") if known else "unknown"
        if self.said.get((form, leg), ("", 0.0))[0] != word:
            self.said[form, leg] = word, time.monotonic()

    def wait_any(self, keys: list[tuple[str, str]]) -> None:
        """Wait until forms have said something."""
        until(lambda: self.said.keys() >= set(keys), lambda: self.said)

    def wait(self, wanted: dict[tuple[str, str], str], timeout_s: float = 30.0) -> dict[str, float]:
        """When each form began to say what is wanted, the last of its legs."""

        def missing() -> dict[tuple[str, str], Any]:
            said = {key: self.said.get(key, ("nothing", 0.0))[0] for key in wanted}
            return {key: word for key, word in said.items() if word != wanted[key]}

        until(lambda: not missing(), missing, timeout_s)
        since: dict[str, float] = {}
        for form, leg in wanted:
            since[form] = max(since.get(form, 0.0), self.said[form, leg][1])
        return since


def read_ros(forms: Forms, session: zenoh.Session) -> list[object]:
    store = typestore()

    def values(sample: zenoh.Sample) -> None:
        message: Any = store.deserialize_cdr(sample.payload.to_bytes(), RosType.JOINT_VALUES)
        assert list(message.joint_names) == list(LEGS)
        for leg, row in zip(message.joint_names, message.interface_values, strict=True):
            found = dict(zip(row.interface_names, row.values.tolist(), strict=True))
            well = found["valid"] == (found["age"] <= 0.5)  # which NaN is not
            well &= bool(found["valid"] or (found["withheld"] and not found["contact"]))
            if not well:
                forms.faults.append(found)
            forms.say("contacts", leg, found["contact"], found["valid"])

    def key(topic: str, kind: str) -> str:
        address = rmw.Address(f"/adaptive_contact/{topic}", kind, store.hash_rihs01(kind))
        return rmw.topic_key(0, address)

    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)

    def listen(key_expr: str, sink: Callable[[zenoh.Sample], None]) -> object:
        return zenoh.ext.declare_advanced_subscriber(session, key_expr, sink, history=history)

    return [
        listen(key("contacts", RosType.JOINT_VALUES), values),
        *(
            listen(
                key(f"{leg}/contact", RosType.BOOL),
                lambda sample, leg=leg: forms.say("Bool", leg, sample.payload.to_bytes()[-1]),
            )
            for leg in LEGS
        ),
    ]


def read_foxglove(forms: Forms, number: int) -> None:
    client = Client(number)
    for leg in LEGS:
        client.subscribe(f"robot/leg/{leg}/contact")
    while True:
        try:
            _, _, event = client.message()
        except TimeoutError:
            continue
        forms.say("foxglove", event.leg, event.contact, event.status != "silent")


def read_rows(form: str, forms: Forms, views: Iterator[dict[str, Any]]) -> None:
    for view in views:
        for row in view["legs"]:
            forms.say(form, row["leg"], row["contact"], row["contact"] is not None)


def read_page(forms: Forms, url: str) -> None:
    with urllib.request.urlopen(f"{url}stream", timeout=600) as answer:
        lines = (json.loads(line[6:]) for line in answer if line.startswith(b'data: {"legs"'))
        read_rows("page", forms, lines)


def read_class(forms: Forms, contacts: Any, over: threading.Event) -> None:
    while not over.wait(0.02):
        for leg in LEGS:
            found = contacts.look(leg, 0)
            forms.say("Contacts", leg, found == "contact", found != "unwatched")


def quietly(over: threading.Event, read: Callable[..., None], *args: Any) -> None:
    """Read on a thread until the process it reads ends, after the test."""

    def work() -> None:
        try:
            read(*args)
        except Exception:
            if not over.is_set():
                raise

    threading.Thread(target=work, daemon=True).start()


@pytest.mark.e2e
@pytest.mark.timeout(240)
def test_no_form_shows_a_contact_for_longer_than_is_known(
    serve: Any, program: Any, port: int, config: Path
) -> None:
    """Causes, one after the other; after each, what is known is shown again."""
    served = [serve()]
    endpoint = served[0].endpoint
    forms, over, kept = Forms(), threading.Event(), ExitStack()
    with kept:
        wire = kept.enter_context(closing(rig.Wire(endpoint)))
        source = kept.enter_context(closing(rig.Robot50(endpoint, LEGS)))

        def begin(*args: str) -> Program:
            return program("-m", "adaptive_contact", *args, "--connect", wire.endpoint)

        ros = kept.enter_context(open_router(port))
        _kept = read_ros(forms, ros)
        address = f"127.0.0.1:{port}"
        gateway = begin("bridge", "ros2", "--config", str(config), "--ros-connect", address)
        foxglove = begin("bridge", "foxglove", "--port", "0")
        page = begin("watch", "--web", "--no-browser")
        watch = begin("watch", "--json", "--seconds", "0.1")
        client = zenoh.Config.from_json5(
            f'{{mode: "client", connect: {{endpoints: ["{wire.endpoint}"]}}}}'
        )
        client.insert_json5("transport/link/tx/lease", "2000")
        session = kept.enter_context(zenoh.open(client))
        kept.callback(over.set)
        quietly(over, read_class, forms, contacts_class()(session), over)
        wired = kept.enter_context(Link.open(client_settings([endpoint])))
        wired.subscribe(
            ALL_CONTACT,
            lambda got: (
                (event := decode(got.payload, ContactEvent, got.encoding))
                and forms.say("events", event.leg, event.contact, event.status != "silent")
            ),
        )
        shown = foxglove.wait_line(r"open ws://127\.0\.0\.1:(\d+)")
        quietly(over, read_foxglove, forms, int(shown[1]))
        quietly(over, read_page, forms, page.wait_line(r"live page at (\S+)")[1])
        lines = (json.loads(watch.next_line(r"\{", 600.0).string) for _ in itertools.count())
        quietly(over, read_rows, "watch", forms, lines)

        publishers = source.publishers

        def publish(*legs: str) -> None:
            source.publishers = {leg: publishers[leg] for leg in legs}

        def signalled(number: int) -> Callable[[], None]:
            return lambda: served[-1].process.send_signal(number)

        passed_on = ("contacts", "foxglove", "page", "watch", "Contacts")
        causes = {
            "the source dies in stance": (
                True, LEGS, publish, lambda: publish(*LEGS), True,
            ),
            "one leg dies in swing": (
                False, ("rf",), lambda: publish("lf"), lambda: publish(*LEGS), True,
            ),
            "the link is cut": (True, LEGS, wire.cut, wire.mend, False),
            "the service stands still": (
                True, LEGS, signalled(signal.SIGSTOP), signalled(signal.SIGCONT), False,
            ),
            "the service ends": (
                True, LEGS, signalled(signal.SIGTERM),
                lambda: served.append(serve("--listen", endpoint)), True,
            ),
            "the service is killed": (
                True, LEGS, signalled(signal.SIGKILL),
                lambda: served.append(serve("--listen", endpoint)), False,
            ),
        }  # fmt: skip
        # Who joins Foxglove gets the next event.
        forms.wait_any([("foxglove", leg) for leg in LEGS])
        for cause, (contact, legs, end, mend, by_event) in causes.items():
            best: dict[str, float] = {}
            for _ in range(TRIES):
                for source.contact in (True, contact):
                    well = "contact" if source.contact else "free"
                    forms.wait({(form, leg): well for form in (*passed_on, "Bool") for leg in LEGS})
                last_s = time.monotonic()
                end()
                wanted = {(form, leg): "unknown" for form in passed_on for leg in legs}
                wanted |= {("events", leg): "unknown" for leg in legs if by_event}
                wanted |= {("Bool", leg): "free" for leg in legs if contact}
                for form, since_s in forms.wait(wanted).items():
                    best[form] = min(best.get(form, math.inf), since_s - last_s)
                others = {(form, leg): well for form in passed_on for leg in set(LEGS) - set(legs)}
                forms.wait(others)
                mend()
                if max(best.values()) <= BOUND_S:
                    break
            print(cause, {form: round(late, 2) for form, late in best.items()})
            assert max(best.values()) <= BOUND_S, (cause, best)
        forms.wait({(form, leg): "contact" for form in passed_on for leg in LEGS})
        gateway.process.send_signal(signal.SIGINT)
        forms.wait({("contacts", leg): "unknown" for leg in LEGS})
        forms.wait({("Bool", leg): "free" for leg in LEGS})
        assert forms.faults == []


def event(t_ns: int, contact: bool = True, **fields: Any) -> ContactEvent:
    return ContactEvent(
        **{
            "leg": "rf",
            "t_ns": t_ns,
            "seq": t_ns,
            "onset_ns": t_ns,
            "contact": contact,
            "status": "valid",
            "score": 2.0,
            "residual": [0.1],
            "model_version": 1,
            **fields,
        }
    )


def beat(t_ns: int, age_s: float, contact: bool) -> Heartbeat:
    return Heartbeat(legs={"rf": LegHeartbeat(t_ns=t_ns, age_s=age_s, contact=contact)})


def test_a_contact_that_is_withdrawn_stands_again_only_if_the_service_says_so() -> None:
    known = KnownContacts()
    assert [e.status for e in known.event(event(7), 0)] == ["silent"], "not known yet"
    known.heartbeat(beat(20, 0.1, contact=True), S)
    assert [e.contact for e in known.poll_events(S)] == [True]
    assert known.poll_events(S) == []
    known.heartbeat(beat(30, 0.1, contact=True), 2 * S)
    assert known.poll_events(2 * S + S * 4 // 10) == []
    (gone,) = known.poll_events(2 * S + S * 4 // 10 + 1)
    assert (gone.contact, gone.withheld, gone.status, gone.t_ns) == (False, True, "silent", 30)
    assert known.event(event(30, contact=False, status="silent", withheld=True), 3 * S) == []
    known.heartbeat(beat(40, 0.0, contact=False), 4 * S)
    assert known.poll_events(4 * S) == [], "whether it stands shows with its next event"
    assert known.event(event(50), 4 * S) == [event(50)]
    known.heartbeat(Heartbeat(legs={}), 4 * S)
    assert [e.contact for e in known.poll_events(4 * S)] == [False], (
        "another service has no such leg"
    )


@pytest.mark.parametrize("age_s", [math.nan, math.inf, -1.0, 1e308])
def test_an_age_that_is_none_says_that_nothing_is_known(age_s: float) -> None:
    known = KnownContacts()
    known.heartbeat(beat(1, age_s, contact=True), S)
    assert not known.is_known("rf", S)
