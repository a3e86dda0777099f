"""docs/messages.md is the contract: every field, key, reason and example of it is checked."""

from __future__ import annotations

import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

import rig
from adaptive_contact import wire
from adaptive_contact.status import LegFacts, ServiceStatus, StateFacts
from adaptive_contact.wire import (
    JSON,
    ContactEvent,
    Message,
    Reject,
    ServoSample,
    decode,
    encode,
)
from waiting import until

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs/messages.md").read_text(encoding="utf-8")

MESSAGES = [
    getattr(wire, name)
    for name in wire.__all__
    if isinstance(getattr(wire, name), type)
    and issubclass(getattr(wire, name), msgspec.Struct)
    and getattr(wire, name) is not Message
]


@pytest.mark.parametrize("kind", [*MESSAGES, ServiceStatus, LegFacts, StateFacts])
def test_every_field_is_described(kind: type[msgspec.Struct]) -> None:
    for field in kind.__struct_fields__:
        assert re.search(rf"[`{{ ]{field}[`}},]", TEXT), f"{kind.__name__}.{field}"
    for reason in Reject:
        assert f"| `{reason}` |" in TEXT


def test_the_examples_are_good_messages() -> None:
    sample, event = re.findall(r"```json\n(.*?)\n```", TEXT, re.DOTALL)
    read = decode(sample.encode(), ServoSample, JSON)
    assert encode(read, JSON).decode() == sample
    packed = encode(read)
    assert f"has {len(packed)}\nbytes" in TEXT
    assert packed[:18].hex(" ") in TEXT
    read_event = decode(event.encode(), ContactEvent, JSON)
    assert encode(read_event, JSON).decode() == event


def contacts_code() -> str:
    part = TEXT.split("## A safe subscriber")[1]
    (code,) = re.findall(r"```python\n(.*?)```", part, re.DOTALL)
    return str(code)


def contacts_class() -> Any:
    """The class of the section on safe subscribers."""
    names: dict[str, Any] = {}
    exec(contacts_code(), names)
    return names["Contacts"]


@pytest.mark.e2e
@pytest.mark.parametrize("options", [(), ("--json",)], ids=["msgpack", "json"])
def test_the_safe_subscriber_acts_on_no_old_contact_and_on_none_without_a_service(
    serve: Any, options: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    class_ = contacts_class()
    served = serve(*options)
    config = zenoh.Config.from_json5(
        f'{{mode: "client", connect: {{endpoints: ["{served.endpoint}"]}}}}'
    )
    # A program that neither closes nor drops its session ends.
    own = (
        f"{contacts_code()}\nimport zenoh\nconfig = zenoh.Config.from_json5({str(config)!r})\n"
        "contacts = Contacts(zenoh.open(config))\ncontacts.look('rf', 0)"
    )
    subprocess.run([sys.executable, "-c", own], check=True, timeout=600)
    with (
        zenoh.open(config) as session,
        closing(rig.Robot50(served.endpoint, touch=lambda _: True)),
    ):
        contacts = class_(session)
        until(lambda: contacts.look("rf", 0) == "contact")
        (tokens,) = re.findall(r"```python\n(tokens.*?)```", TEXT, re.DOTALL)
        exec(tokens, {"session": session})
        assert "robot/service" in capsys.readouterr().out
        began_ns = contacts.events["rf"]["t_ns"]
        until(lambda: contacts.look("rf", began_ns) == "contact")
        until(lambda: contacts.look("rf", began_ns + 1) == "free")
        assert contacts.look("lf", 0) == "unwatched"
        # Who joins late gets the contact that stands, however old, and may refuse it.
        late = class_(session)
        until(lambda: late.look("rf", began_ns) == "contact")
        until(lambda: late.look("rf", began_ns + 1) == "free")
        served.stop()
        until(lambda: contacts.look("rf", began_ns) == "unwatched")
