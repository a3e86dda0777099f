"""docs/security.md, tried out: who gets in, who may say what, and that nothing secret is told."""

from __future__ import annotations

import base64
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.link import Link, NoRouterError, client_settings, router_settings
from adaptive_contact.service.settings import SERVICE_TOKEN, leg_token, shown
from adaptive_contact.status import SERVICE_STATUS
from adaptive_contact.wire import (
    ALL_CONTACT,
    ALL_LEARNER,
    Command,
    ContactEvent,
    LearnerStatus,
    LegTrace,
    ServoSample,
    command_key,
    contact_key,
    decode,
    learner_key,
    model_key,
    servo_key,
    trace_key,
)
from programs import Program
from waiting import matched

TEXT = (Path(__file__).parents[2] / "docs/security.md").read_text(encoding="utf-8")
_, _, TLS_SERVICE, TLS_CLIENT = re.findall(r"```json5\n(.*?)```", TEXT, re.DOTALL)
# A wrong password is one, too: it is a right one mistyped, or somebody's of another robot.
MISTYPED = "CHANGE-MY-2"
SECRETS = ("CHANGE-ME-1", "CHANGE-ME-2", "CHANGE-ME-3", MISTYPED)

Sample = Callable[..., ServoSample]


class Guarded:
    """The service with the documented set, open to other machines, and its users."""

    def __init__(self, served: Any, join: Callable[..., Link], users: Any) -> None:
        self.served = served
        self.endpoint: str = served.endpoint.replace("0.0.0.0", "127.0.0.1")
        self._join = join
        self._users = users

    def user(self, name: str) -> Link:
        """A session of a user's own, by the user's file."""
        return self._join(self.endpoint, zenoh_config=getattr(self._users, name))


@pytest.fixture
def guarded(serve: Any, join: Callable[..., Link], users: Any) -> Guarded:
    served = serve("--listen", "0.0.0.0:0", "--zenoh-config", str(users.service))
    return Guarded(served, join, users)


@pytest.fixture
def certificates(tmp_path: Path) -> Path:
    """A folder with those of the document: a CA's, the service's and a client's."""

    def openssl(*args: str) -> None:
        subprocess.run(["openssl", *args], check=True, capture_output=True, cwd=tmp_path)

    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2")
    openssl("req", "-x509", *new, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=test ca")
    for name in ("service", "client"):
        (tmp_path / f"{name}.ext").write_text("subjectAltName=IP:127.0.0.1,DNS:localhost")
        openssl(
            "req", *new, "-keyout", f"{name}.key", "-out", f"{name}.csr", "-subj", f"/CN={name}"
        )
        openssl(
            *("x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key"),
            *("-CAcreateserial", "-days", "2", "-extfile", f"{name}.ext", "-out", f"{name}.pem"),
        )
    return tmp_path


@pytest.mark.e2e
def test_only_the_service_publishes_contacts_and_statuses(
    guarded: Guarded, users: Any, inbox: Any, sample: Sample
) -> None:
    for config in (None, users.stranger):
        with pytest.raises(NoRouterError, match="user and password"):
            Link.open(client_settings([guarded.endpoint], wait=False, zenoh_config=config))

    robot, viewer = guarded.user("robot"), guarded.user("viewer")
    contacts, plain, statuses = inbox(ContactEvent), inbox(ContactEvent), inbox(LearnerStatus)
    viewer.subscribe(ALL_CONTACT, contacts, history=True)
    robot.subscribe(ALL_CONTACT, plain)
    viewer.subscribe(ALL_LEARNER, statuses)
    tokens = inbox()
    viewer.watch_tokens(SERVICE_TOKEN, tokens)
    assert tokens.wait(1)[0] == (SERVICE_TOKEN, True)

    # The robot's samples get through, and the service's events to both.
    servo = matched(robot.publisher(servo_key("rf")))
    servo.put(sample(1, contact=True))
    assert contacts.wait(1)[0].seq == 1
    assert plain.wait(1)[0].seq == 1
    statuses.wait(lambda items: any(status.ticks == 1 for status in items))

    # What only the service may say: nobody receives it from others, neither at once nor later.
    event = contacts.items[0]
    forged = ContactEvent(
        **{**{name: getattr(event, name) for name in event.__struct_fields__}, "seq": 666}
    )
    wrong = LearnerStatus(
        leg="rf",
        t_ns=1,
        status="valid",
        model_version=666,
        residual_rms=[],
        noise_floor=[],
    )
    trap = LegTrace(leg="rf", number=666)
    # (From sessions of their own: within a session everybody hears himself, without a router.)
    liars = [guarded.user(name) for name in ("robot", "viewer")]
    for liar in liars:
        liar.publisher(contact_key("rf"), reliable=True).put(forged)
        liar.publisher(contact_key("rf"), reliable=True, history=1).put(forged)
        liar.publisher(learner_key("rf")).put(wrong)
        liar.publisher(SERVICE_STATUS).put(wrong)
        liar.queryable(model_key("rf"), lambda request: request.reply(wrong))
        liar.queryable(trace_key("rf"), lambda request: request.reply(trap))
        liar.token(leg_token("zz"))
    liars[1].publisher(servo_key("rf")).put(sample(555, contact=False))
    for liar in liars:  # a round trip: what it put before has been dealt with after it
        assert len(liar.query(model_key("rf"))) >= 1
    servo.put(sample(2))
    # (Of a leg without samples an event says that it is silent.)
    assert {e.seq for e in contacts.wait(lambda items: items[-1].seq == 2)} == {1, 2}
    late = inbox(ContactEvent).subscribe(guarded.user("viewer"), ALL_CONTACT, history=True)
    assert [e.seq for e in late.wait(1)] == [2]
    statuses.wait(lambda items: any(status.ticks == 2 for status in items))
    assert all(status.model_version == 3 for status in statuses.items)
    assert {e.seq for e in plain.wait(lambda items: items[-1].seq == 2)} == {1, 2}
    (last,) = viewer.query(contact_key("rf"))
    assert b"666" not in last.payload
    (report,) = viewer.query(model_key("rf"))
    assert report.error is None
    assert leg_token("zz") not in viewer.alive("robot/leg/*")
    assert viewer.query(trace_key("rf")) == [], "ticks are kept from the first question on"
    servo.put(sample(3))
    statuses.wait(lambda items: any(status.ticks == 3 for status in items))
    (ticks,) = viewer.query(trace_key("rf"))
    trace = decode(ticks.payload, LegTrace, ticks.encoding)
    assert (trace.number, trace.seq) == (1, [3])

    assert guarded.served.stop() == 0
    log = guarded.served.log.read_text()
    assert not [secret for secret in SECRETS if secret in log]


@pytest.mark.e2e
def test_only_the_robot_moves_its_legs(guarded: Guarded, inbox: Any) -> None:
    bridge, gait, viewer = (guarded.user(name) for name in ("robot", "robot", "viewer"))
    goals, seen = inbox(Command), inbox(Command)
    bridge.subscribe(command_key("rf"), goals)
    viewer.subscribe(command_key("rf"), seen)
    commands = matched(gait.publisher(command_key("rf")))
    commands.put(Command(desired=[0.1, 0.2, 0.3]))
    assert goals.wait(1)[0].desired == [0.1, 0.2, 0.3]

    viewer.publisher(command_key("rf"), reliable=True).put(Command(desired=[0.9, 0.9, 0.9]))
    assert len(viewer.query(model_key("rf"))) == 1  # a round trip: it has been dealt with
    commands.put(Command(desired=[0.4, 0.5, 0.6]))
    assert [c.desired[0] for c in goals.wait(2)] == [0.1, 0.4]
    # What a viewer hears of himself never went through the router.
    assert [c.desired[0] for c in seen.items] == [0.9]
    assert guarded.served.stop() == 0


@pytest.mark.e2e
@pytest.mark.parametrize("everything", ["**", "robot/**"])  # of `doctor`, and of `record`
def test_who_asks_for_everything_gets_what_he_may_see(
    guarded: Guarded, inbox: Any, sample: Sample, everything: str
) -> None:
    robot, gait, viewer = (guarded.user(name) for name in ("robot", "robot", "viewer"))
    goals, seen, tokens = inbox(Command), inbox(), inbox()
    robot.subscribe(command_key("rf"), goals)
    viewer.subscribe(everything, seen)
    guarded.user("viewer").watch_tokens(everything, tokens)
    matched(gait.publisher(command_key("rf"))).put(Command(desired=[0.1, 0.2, 0.3]))
    goals.wait(1)
    servo = matched(robot.publisher(servo_key("rf")))
    kinds = {servo_key("rf"), contact_key("rf"), learner_key("rf"), SERVICE_STATUS}
    servo.put(sample(1, contact=True))
    seen.wait(lambda items: kinds <= {received.key for received in items})
    assert command_key("rf") not in {received.key for received in seen.items}
    # Who is there is told by a get and to a subscriber, in sessions of their own: one's answers
    # may help another.
    expected = {SERVICE_TOKEN, leg_token("rf")}
    tokens.wait(lambda items: expected <= {key for key, alive in items if alive})
    assert SERVICE_TOKEN in guarded.user("viewer").alive(everything)
    # A session without a name of the set may say that it is there, and nobody is told.
    stranger = guarded.user("viewer")
    stranger.token("robot/made-up")
    assert "robot/made-up" not in guarded.user("viewer").alive("robot/**")
    assert guarded.served.stop() == 0


def logged(level: str, code: str, *args: object) -> str:
    """What a program, and Zenoh in it, says at a level of Zenoh's log."""
    with closing(Program("-c", code, *args, env={**os.environ, "RUST_LOG": level})) as program:
        assert program.wait(600) == 0, program.lines[-5:]
    return "\n".join(program.lines)


@pytest.mark.e2e
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl")
def test_zenohs_own_log_holds_no_key_of_an_endpoint(certificates: Path) -> None:
    parts = {
        "root_ca_certificate": "ca.pem",
        "listen_certificate": "service.pem",
        "listen_private_key": "service.key",
        "connect_private_key": "client.key",
        "connect_certificate": "client.pem",
    }
    coded = {
        name: base64.b64encode((certificates / file).read_bytes()).decode()
        for name, file in parts.items()
    }
    code = (
        "import sys\n"
        "from adaptive_contact.service.link import Link, client_settings, router_settings\n"
        "listen, connect = sys.argv[1:]\n"
        "with Link.open(router_settings(['tls/127.0.0.1:0#' + listen])) as router:\n"
        "    where = router.endpoints[0].partition('#')[0] + '#' + connect\n"
        "    with Link.open(client_settings([where])) as client: assert client.is_connected()"
    )
    options = [
        ";".join(f"{k}_base64={v}" for k, v in coded.items() if k.startswith(("root", side)))
        for side in ("listen", "connect")
    ]
    for level in ("debug", "trace"):
        log = logged(level, code, *options)
        assert "DEBUG" in log
        for name in ("listen_private_key", "connect_private_key"):
            assert coded[name][40:80] not in log, name


@pytest.mark.e2e
def test_no_key_is_logged_where_a_connection_fails() -> None:
    """Nor where an address cannot be listened on: both are warnings of Zenoh's."""
    code = (
        "import socket, sys\n"
        "from adaptive_contact.errors import LinkError\n"
        "from adaptive_contact.service.link import Link, client_settings, router_settings\n"
        "taken = socket.create_server(('127.0.0.1', 0))\n"
        "where = f'tls/127.0.0.1:{taken.getsockname()[1]}#'\n"
        "key = sys.argv[1]\n"
        "client = client_settings([f'{where}connect_private_key_base64={key}'], wait=False)\n"
        "router = router_settings([f'{where}listen_private_key_base64={key}'])\n"
        "for settings in (client, router):\n"
        "    try: Link.open(settings)\n"
        "    except LinkError: print('failed')"
    )
    key = base64.b64encode(b"a key that nobody may see").decode()
    for level in ("error", "warn", "trace"):
        log = logged(level, code, key)
        assert log.count("failed") == 2, log[-500:]
        assert key not in log, level


@pytest.mark.e2e
def test_zenohs_own_log_holds_no_password(users: Any) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from adaptive_contact.service.link import Link, NoRouterError\n"
        "from adaptive_contact.service.link import client_settings, router_settings\n"
        "service, robot, stranger = map(Path, sys.argv[1:])\n"
        "with Link.open(router_settings(['127.0.0.1:0'], zenoh_config=service)) as router:\n"
        "    with Link.open(client_settings(router.endpoints, zenoh_config=robot)): pass\n"
        "    try: Link.open(client_settings(router.endpoints, wait=False, zenoh_config=stranger))\n"
        "    except NoRouterError as refused: print(refused)"
    )
    for level in ("debug", "trace"):
        log = logged(level, code, users.service, users.robot, users.stranger)
        assert "DEBUG" in log
        assert "refused: " in log
        assert not [line[:300] for line in log.splitlines() for one in SECRETS if one in line]


@pytest.mark.e2e
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes certificates with openssl")
def test_mutual_tls_lets_in_who_has_a_certificate(certificates: Path) -> None:
    tmp_path = certificates

    def config(name: str, text: str) -> Path:
        path = tmp_path / f"{name}.json5"
        path.write_text(text.replace("/etc/adaptive-contact", str(tmp_path)))
        return path

    service, client = config("tls", TLS_SERVICE), config("tls_client", TLS_CLIENT)
    without = re.sub(r"connect_\w+: .*\n", "", TLS_CLIENT)
    with Link.open(router_settings(["tls/0.0.0.0:0"], zenoh_config=service)) as router:
        endpoint = router.endpoints[0].replace("0.0.0.0", "127.0.0.1")
        settings = client_settings([endpoint], wait=False, zenoh_config=client)
        with Link.open(settings) as joined:
            assert joined.is_connected()
        with pytest.raises(NoRouterError, match="refused"):
            Link.open(
                client_settings([endpoint], wait=False, zenoh_config=config("without", without))
            )
    # What the endpoint says would hold over the file: Zenoh would ask nobody.
    with pytest.raises(ConfigurationError, match="says enable_mtls after '#'"):
        Link.open(router_settings(["tls/0.0.0.0:0#enable_mtls=false"], zenoh_config=service))
    opened = router_settings(
        ["tls/0.0.0.0:0#enable_mtls=false"], zenoh_config=service, insecure=True
    )
    with Link.open(opened) as router:
        endpoint = shown(router.endpoints[0]).replace("0.0.0.0", "127.0.0.1")
        plain = config("plain", without.replace("enable_mtls: true,", ""))
        stranger = client_settings([endpoint], wait=False, zenoh_config=plain)
        with Link.open(stranger) as joined:
            assert joined.is_connected()
    # A lock on one door is none on the other.
    with pytest.raises(ConfigurationError, match="would let anybody on that network in"):
        Link.open(router_settings(["tls/0.0.0.0:0", "tcp/0.0.0.0:0"], zenoh_config=service))


@pytest.mark.parametrize(
    "text",
    [
        '{transport: {auth: {usrpwd: {user: "svc", password: "hunter2" x: 1}}}}',
        '{transport: {auth: {usrpwd: {user: "svc", password: "hunter2", more: 1}}}}',
        '{transport: {auth: {usrpwd: "hunter2"}}}',
        '{transport: {auth: {usrpwd: {user: "svc",\npassword: "hunter2\n}}}}',
        '{transport: {link: {tls: {connect_private_key_base64: 3, listen_private_key: "hunter2',
        '{mode: "hunter2"}',
        '{transport: {auth: {usrpwd: {password: "hunter2"}}}}',
        '{connect: {endpoints: ["tls/1#k=hunter2"]}, transport: {auth: {usrpwd: {user: "svc"}}}}',
    ],
)
def test_errors_of_a_configuration_do_not_quote_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match="not a usable Zenoh configuration") as caught:
        Link.open(router_settings(zenoh_config=path))
    assert "hunter2" not in str(caught.value)


def test_keys_in_endpoints_are_not_shown() -> None:
    secret = "tls/0.0.0.0:7447#listen_private_key_base64=c2VjcmV0"
    assert shown(secret) == "tls/0.0.0.0:7447"
    with pytest.raises(ConfigurationError) as caught:
        Link.open(router_settings([secret]))
    assert "c2VjcmV0" not in str(caught.value)
    for wrong in ("xyz/1:2#key=c2VjcmV0", "tls/a:b:c#key=c2VjcmV0", "tls/1.2.3.4:99999#c2VjcmV0"):
        with pytest.raises(ConfigurationError) as caught:
            client_settings([wrong])
        assert "c2VjcmV0" not in str(caught.value)
    closed = client_settings(["tls/127.0.0.1:1#connect_private_key_base64=c2VjcmV0"], wait=False)
    with pytest.raises(NoRouterError) as refused:
        Link.open(closed)
    assert "c2VjcmV0" not in str(refused.value)


def test_the_lines_in_the_document_are_the_real_ones() -> None:
    with pytest.raises(ConfigurationError) as caught:
        Link.open(router_settings(["tcp/0.0.0.0:7447"]))
    assert f"adaptive-contact: {caught.value}\n" in TEXT
