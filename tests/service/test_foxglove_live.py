"""Foxglove's websocket protocol: a client sees what is on the wire, by the schemas it is given."""

from __future__ import annotations

import base64
import json
import struct
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.foxglove_live import FoxgloveServer
from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.wire import (
    HEARTBEAT,
    ContactEvent,
    Heartbeat,
    LegHeartbeat,
    ServoSample,
    contact_key,
    servo_key,
)
from waiting import Every

# A tick of a source whose clock began some days ago.
T_NS = 300_000_000_000_000
SAMPLE = ServoSample(
    t_ns=T_NS, seq=7, measured=[0.1, 0.2], desired=[0.3, 0.4], preview=[[1.0, 2.0]], phase="swing"
)
EVENT = ContactEvent(
    leg="lf", t_ns=T_NS, seq=7, onset_ns=T_NS - 5, contact=True, status="valid", score=1.5,
    residual=[0.5, -0.25], model_version=3,
)  # fmt: skip
BEAT = LegHeartbeat(t_ns=T_NS, age_s=0.0, contact=True)


class Client:
    """A client of ``foxglove.sdk.v1``: reads what is advertised, subscribes, decodes."""

    def __init__(self, port: int) -> None:
        self._stack = ExitStack()
        self._socket = self._stack.enter_context(
            connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")])
        )
        self.info = json.loads(self._socket.recv(timeout=600))
        self.channels: dict[str, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}

    def close(self) -> None:
        self._stack.close()

    def wait_channel(self, topic: str) -> dict[str, Any]:
        while topic not in self.channels:
            self._take(self._socket.recv(timeout=600))
        return self.channels[topic]

    def subscribe(self, topic: str) -> None:
        channel = self.wait_channel(topic)["id"]
        number = len(self._subscribed) + 1
        self._subscribed[number] = topic
        self._ask(number, channel)

    def _ask(self, number: int, channel: int) -> None:
        wanted = [{"id": number, "channelId": channel}]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def message(self) -> tuple[str, int, Any]:
        """Topic, log time and the decoded message."""
        while (found := self._take(self._socket.recv(timeout=600))) is None:
            pass
        return found

    def _take(self, received: str | bytes) -> tuple[str, int, Any] | None:
        if isinstance(received, str):
            said = json.loads(received)
            if said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
            elif said["op"] == "status":
                # On a busy computer the SDK advertises a channel before it knows it itself.
                for number, topic in self._subscribed.items():
                    if str(self.channels[topic]["id"]) in said["message"]:
                        self._ask(number, self.channels[topic]["id"])
            return None
        opcode, number, time_ns = struct.unpack_from("<BIQ", received)
        assert opcode == 1, "message data"
        topic = self._subscribed[number]
        channel = self.channels[topic]
        assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
        files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        made = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
        return topic, time_ns, made.FromString(received[13:])


@pytest.fixture
def server(router: Link) -> Iterator[FoxgloveServer]:
    stop = threading.Event()
    with (
        Link.open(client_settings(router.endpoints)) as link,
        FoxgloveServer(link, port=0) as one,
    ):
        worker = threading.Thread(target=one.run, args=(stop,))
        worker.start()
        yield one
        stop.set()
        worker.join(5)
        assert not worker.is_alive()


@pytest.fixture
def client(server: FoxgloveServer) -> Iterator[Client]:
    one = Client(server.port)
    yield one
    one.close()


@pytest.fixture
def source(router: Link) -> Iterator[None]:
    """Publishes again and again, as somebody may not be there yet."""
    servo, heartbeat = router.publisher(servo_key("lf")), router.publisher(HEARTBEAT)
    contact = router.publisher(contact_key("lf"), reliable=True, history=1)

    def publish() -> None:
        servo.put(SAMPLE)
        heartbeat.put(Heartbeat(legs={"lf": BEAT}))
        contact.put(EVENT)

    with closing(Every(0.02, publish)):
        yield


@pytest.mark.usefixtures("source")
def test_keys_are_topics_and_messages_keep_their_values(client: Client) -> None:
    assert client.info["capabilities"] == [], "nothing comes in"
    client.subscribe("robot/leg/lf/servo")
    topic, time_ns, servo = client.message()
    assert topic == "robot/leg/lf/servo"
    assert (servo.t_ns, servo.seq, servo.phase) == (T_NS, 7, "swing")
    assert (list(servo.measured), list(servo.desired)) == ([0.1, 0.2], [0.3, 0.4])
    assert [list(row.values) for row in servo.preview] == [[1.0, 2.0]]
    assert time_ns > 1_700_000_000 * 10**9, "of this computer's clock, not of the source's"
    client.subscribe("robot/leg/lf/contact")
    while topic != "robot/leg/lf/contact":
        topic, _, event = client.message()
    assert (event.contact, event.score, event.onset_ns) == (True, 1.5, T_NS - 5)


@pytest.mark.usefixtures("source")
def test_what_cannot_be_read_is_counted(
    router: Link, server: FoxgloveServer, client: Client
) -> None:
    client.subscribe("robot/leg/lf/servo")
    bad = router.publisher(servo_key("rf"))
    counted = ("robot/leg/rf/servo", "malformed")
    for _ in range(500):  # until the subscription has travelled
        bad.put_raw(b"\xc1", "application/msgpack")
        assert client.message()[0] == "robot/leg/lf/servo", "the others go on"
        if server.left_out[counted]:
            break
    assert server.left_out[counted]
    assert "robot/leg/rf/servo" not in client.channels


def test_a_port_in_use_is_one_line(server: FoxgloveServer, router: Link) -> None:
    with pytest.raises(ConfigurationError, match=r"in use.*give another --port"):
        FoxgloveServer(router, port=server.port)


def test_the_command_says_where_and_ends_on_a_signal(router: Link, program: Any) -> None:
    bridge = program(
        *("-m", "adaptive_contact", "bridge", "foxglove", "--port", "0"),
        *("--connect", router.endpoints[0]),
    )
    client = Client(int(bridge.wait_line(r"open ws://127\.0\.0\.1:(\d+)")[1]))
    assert client.info["op"] == "serverInfo"
    client.close()
    assert bridge.stop() == 0
    assert len(bridge.lines) == 1
