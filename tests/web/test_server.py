"""The page's server against strangers: real sockets on loopback, requests byte by byte."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from adaptive_contact.web import WebSettings, server
from adaptive_contact.web.server import MOST_STREAMS
from waiting import until

from .running import FRAME, Running, answer_of, everything, read_until


@pytest.fixture
def running() -> Iterator[Running]:
    with closing(Running(WebSettings())) as site:
        yield site


@pytest.fixture(scope="module")
def shared() -> Iterator[Running]:
    with closing(Running(WebSettings())) as site:
        yield site


@pytest.fixture
def guarded() -> Iterator[Running]:
    with closing(Running(WebSettings(token="s3cret-token"))) as site:
        yield site


# -- what is served ------------------------------------------------------------------------------


SCRIPTS = [
    f"/{name}.js"
    for name in (
        *("page", "above", "charts", "data", "dom", "look", "marks", "panel", "plots"),
        *("recording", "stream", "table", "theme"),
    )
]


@pytest.mark.parametrize("path", ["/", *SCRIPTS, "/page.css", "/icon.svg"])
def test_a_page_comes_with_a_policy_that_lets_nothing_else_in(shared: Running, path: str) -> None:
    status, headers, body = shared.get(path)
    assert status == 200
    assert len(body) == int(headers["Content-Length"])
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "*" not in policy
    assert headers["X-Content-Type-Options"] == "nosniff"


def test_the_page_asks_for_nothing_from_elsewhere(shared: Running) -> None:
    texts = {path: shared.get(path)[2].decode() for path in ("/", *SCRIPTS, "/page.css")}
    for path, text in texts.items():
        for address in re.findall(r"(?:https?:)?//[\w.]+\.\w+", text):
            pytest.fail(f"{path} names {address}")
    html = texts["/"]
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|style=|<style", html), "nothing inline"
    for way in ("innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("):
        assert not [path for path, text in texts.items() if way in text]


def test_a_model_is_asked_for_by_the_id_of_a_leg_only(shared: Running) -> None:
    assert shared.get("/model?leg=rf")[::2] == (200, b'{"leg":"rf"}')
    assert shared.get("/model?leg=lf")[0] == 404
    before = len(shared.asked)
    for leg in ("*", "**", "a/b", "", "%2a", "%00", "x" * 33, "rf?x"):
        assert shared.get(f"/model?leg={leg}")[0] == 400
    assert len(shared.asked) == before, "no wildcard reaches the service"


# -- what can be done ----------------------------------------------------------------------------

OWN = "X-Adaptive-Contact: page"


@pytest.mark.parametrize("path", sorted(server.ACTIONS))
def test_what_is_done_needs_post_and_a_header_of_the_page(running: Running, path: str) -> None:
    assert running.get(f"{path}?t=7&label=a%20b", OWN, method="POST")[::2] == (200, b"{}")
    assert running.done == [(path, {"t": "7", "label": "a b"})]
    for headers, status in (
        ((), 403),
        (("Content-Type: text/plain",), 403),
        ((OWN, "Origin: http://evil.example"), 403),
        ((OWN, "Sec-Fetch-Site: cross-site"), 403),
        ((OWN, "Content-Length: 4"), 413),
    ):
        found, _, body = running.get(path, *headers, method="POST")
        assert (found, body.count(b"\n")) == (status, 1), headers
    found, answered, _ = running.get(path, OWN)
    assert (found, answered["Allow"]) == (405, "POST")
    # A script of another site asks before it sends a header of its own, and is told no.
    asks = ("Origin: http://evil.example", "Access-Control-Request-Headers: x-adaptive-contact")
    found, answered, _ = running.get(path, *asks, method="OPTIONS")
    assert found == 405
    assert not [name for name in answered if name.startswith("Access-Control")]
    assert len(running.done) == 1


def test_without_the_token_nothing_is_done(guarded: Running) -> None:
    for path in server.ACTIONS:
        assert guarded.get(f"{path}?token=s3cret-token", OWN, method="POST")[0] == 403
    assert not guarded.done
    cookie = f"Cookie: adaptive_contact_{guarded.port}=s3cret-token"
    assert guarded.get("/record/stop", OWN, cookie, method="POST")[0] == 200


# -- strangers -----------------------------------------------------------------------------------

ASKED = b" HTTP/1.1\r\nHost: {host}\r\n\r\n"
METHODS = (b"POST", b"HEAD", b"PUT", b"DELETE", b"OPTIONS", b"TRACE", b"CONNECT", b"get")
NOWHERE = (
    b"/../etc/passwd",
    b"/%2e%2e/%2e%2e/etc/passwd",
    b"/static/page.js",
    b"/server.py",
    b"/page.js/",
    b"/PAGE.JS",
    b"/page.js%00.html",
    b"http://evil.example/",
    b"*",
    b"/" + b"a" * 8000,
)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:{port}",
        "127.0.0.1.evil.example:{port}",
        "127.0.0.1:1",
        "127.0.0.1",
        "192.168.1.7:{port}",
        "[::1",
        "",
    ],
)
def test_a_name_that_leads_here_from_elsewhere_is_refused(shared: Running, host: str) -> None:
    request = "GET / HTTP/1.1\r\nHost: {}\r\n\r\n"
    status, _, body = shared.send(request.format(host.format(port=shared.port)).encode())
    assert status == 421
    assert b"not an address of this page" in body
    for own in ("127.0.0.1", "localhost", "LOCALHOST", "[::1]"):
        assert shared.send(request.format(f"{own}:{shared.port}").encode())[0] == 200


@pytest.mark.parametrize(
    "headers",
    [
        ("Origin: http://evil.example",),
        ("Origin: null",),
        ("Origin: https://{host}",),
        ("Origin: http://127.0.0.1:1",),
        ("Sec-Fetch-Site: cross-site",),
        ("Sec-Fetch-Site: same-site",),
        ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate"),
    ],
)
@pytest.mark.parametrize("path", ["/stream", "/page.js", "/model?leg=rf"])
def test_pages_of_other_sites_are_refused(
    shared: Running, path: str, headers: tuple[str, ...]
) -> None:
    given_ = [line.format(host=shared.host) for line in headers]
    assert shared.get(path, *given_)[::2] == (403, b"requests of other sites are refused\n")


def test_a_link_on_another_site_leads_to_the_page(shared: Running) -> None:
    headers = ("Sec-Fetch-Site: cross-site", "Sec-Fetch-Mode: navigate")
    assert shared.get("/", *headers)[0] == 200
    assert shared.get("/page.js", f"Origin: http://{shared.host}")[0] == 200


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nX: " + b"a" * 20_000 + b"\r\n\r\n", 431),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\n" + b"X: a\r\n" * 100 + b"\r\n", 431),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nHost: {host}\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\n folded: a\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nno colon\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost : {host}\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\n: a\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nX\xe9: a\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nContent-Length: 5\r\n\r\nhello", 413),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", 413),
        (b"GET / HTTP/2.0\r\nHost: {host}\r\n\r\n", 505),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 505),
        (b"GET /\r\n\r\n", 421),
        (b"GET / of HTTP/1.1\r\n\r\n", 400),
        (b"\x00\x01\x02 \xff HTTP/1.1\r\n\r\n", 405),
        (b"GET / HTTP/1.1\r\n\r\n", 421),
        (b"GET /?" + b"&".join(b"a%d=1" % i for i in range(100)) + ASKED, 400),
        *((b"GET " + path + ASKED, 404) for path in NOWHERE),
        *((method + b" /" + ASKED, 405) for method in METHODS),
    ],
)
def test_requests_that_get_nothing(shared: Running, request_: bytes, status: int) -> None:
    found, headers, body = shared.send(request_.replace(b"{host}", shared.host.encode()))
    assert found == status
    assert body.count(b"\n") == 1
    assert headers["Connection"] == "close"
    assert "Content-Security-Policy" in headers
    assert (headers.get("Allow") == "GET") is (body == b"GET only\n") is (status == 405)


def test_half_a_request_is_ended(running: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, running.connect() as one:
        patch.setattr(server, "HEAD_WITHIN_S", 0.2)
        one.sendall(b"GET / HTTP/1.1\r\nHost:")
        assert answer_of(everything(one))[0] == 408
    with running.connect() as one:
        one.sendall(b"GET / HT")
        one.shutdown(socket.SHUT_WR)
        assert answer_of(everything(one))[0] == 400
    with running.connect() as one:  # nothing at all gets nothing
        one.shutdown(socket.SHUT_WR)
        assert everything(one) == b""
    assert running.get("/")[0] == 200


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(junk=st.binary(max_size=400), line=st.sampled_from([b"", b"GET ", b"GET / HTTP/1.1\r\n"]))
def test_whatever_comes_is_answered_or_closed(shared: Running, junk: bytes, line: bytes) -> None:
    with shared.connect() as one:
        one.sendall(line + junk + b"\r\n\r\n")
        one.shutdown(socket.SHUT_WR)
        try:
            data = everything(one)
        except ConnectionResetError:
            data = b""
    if data:
        assert answer_of(data)[0] in (400, 403, 404, 405, 413, 421, 431, 505)
    assert not shared.faults


# -- beyond loopback -----------------------------------------------------------------------------


def test_without_the_token_nothing_is_shown(guarded: Running) -> None:
    for path in ("/", "/page.js", "/stream", "/model?leg=rf", "/?token=wrong", "/?token="):
        status, headers, _ = guarded.get(path)
        assert status == 403
        assert "Set-Cookie" not in headers
    name = f"adaptive_contact_{guarded.port}"
    for cookie in (
        f"{name}=wrong",
        f"{name}",
        f"other={guarded.site.url}",
        f"{name}=s3cret-tokenx",
    ):
        assert guarded.get("/", f"Cookie: {cookie}")[0] == 403


def test_the_token_of_the_link_becomes_a_cookie(guarded: Running) -> None:
    assert guarded.site.url.endswith("/?token=s3cret-token")
    status, headers, _ = guarded.get("/?token=s3cret-token")
    assert (status, headers["Location"]) == (303, "/")
    cookie, *flags = headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Lax"} <= set(flags)
    assert guarded.get("/", f"Cookie: a=b; {cookie}")[0] == 200


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2"], ids=["the owner's", "another"])
def test_strangers_without_the_token_keep_its_owner_out_at_no_time(
    guarded: Running, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    """Connections that say nothing, half a request, or one that is refused and never read."""
    monkeypatch.setattr(server, "MOST_WAITING", 32)
    cookie = f"Cookie: adaptive_contact_{guarded.port}=s3cret-token"
    request = f"GET /stream HTTP/1.1\r\nHost: {guarded.host}\r\n"
    guarded.push()
    strangers: list[socket.socket] = []
    try:
        with guarded.connect() as looking:
            looking.sendall(f"{request}{cookie}\r\n\r\n".encode())
            read_until(looking, FRAME)
            for _ in range(36):
                for said in ("", request, f"{request}\r\n"):
                    for _ in range(12):
                        to = ("127.0.0.1", guarded.port)
                        one = socket.create_connection(to, 20, source_address=(address, 0))
                        one.sendall(said.encode())
                        strangers.append(one)
                assert guarded.get("/", cookie)[0] == 200
                while len(strangers) > 200:
                    strangers.pop(0).close()
            guarded.push(b'{"t":2}')
            read_until(looking, b'{"t":2}')
        assert len(guarded.site.waiting) <= 32
    finally:
        for one in strangers:
            one.close()


def test_beyond_loopback_an_address_or_an_own_name_is_let_in() -> None:
    with closing(Running(WebSettings(host="0.0.0.0", token="t"))) as site:
        port = site.port
        for host, status in (
            (f"192.168.1.7:{port}", 403),
            (f"[fe80::1]:{port}", 403),
            (f"{socket.gethostname()}:{port}", 403),
            (f"evil.example:{port}", 421),
            ("192.168.1.7:1", 421),
        ):
            request = f"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()
            assert site.send(request)[0] == status, host


# -- streams -------------------------------------------------------------------------------------


def test_a_stream_begins_with_the_table_and_goes_on(running: Running) -> None:
    running.push(view=b'{"legs":[]}')
    with running.stream() as one:
        data = read_until(one, b'data: {"t":1}\n\n')
        status, headers, body = answer_of(data)
        assert status == 200
        assert headers["Content-Type"] == "text/event-stream"
        assert body.index(b"event: view") < body.index(b"id: ")
        running.push(b'{"t":2}')
        assert b'data: {"t":2}' in read_until(one, b"\n\n")
        running.push(b'{"t":3}', b'{"legs":[1]}')
        assert b"event: view" in read_until(one, b'{"legs":[1]}')


def test_a_stream_resumes_where_it_was(running: Running) -> None:
    for i in range(5):
        running.push(b'{"t":%d}' % i)
    session = running.site.history.session
    for after, first in ((f"{session}.2", 3), ("other.2", 0), ("", 0), (f"{session}.x", 0)):
        with running.stream(after) as one:
            times = re.findall(rb'"t":(\d)', read_until(one, b'{"t":4}\n\n'))
        assert times == [b"%d" % t for t in range(first, 5)], after
    with running.stream(f"{session}.99") as one:  # from the future: what comes next
        read_until(one, b"retry")
        until(lambda: running.push(b'{"t":5}') or running.site.streams == 1)
        assert set(re.findall(rb'"t":(\d)', read_until(one, b"}\n\n"))) == {b"5"}


def test_the_last_words_end_a_stream(running: Running) -> None:
    running.push()
    with running.stream() as one:
        until(lambda: running.site.streams == 1)
        running.site.history.end('over\n\nid: 1\ndata: "x"')
        body = answer_of(everything(one))[2]
    assert json.loads(body.split(b"event: end\ndata: ")[1].strip()) == 'over\n\nid: 1\ndata: "x"'
    until(lambda: running.site.streams == 0)


def test_one_browser_too_many_gets_a_line(running: Running) -> None:
    running.push()
    with ExitStack() as stack:
        streams = [stack.enter_context(running.stream()) for _ in range(MOST_STREAMS)]
        for one in streams:
            read_until(one, b"\n\n")
        until(lambda: running.site.streams == MOST_STREAMS)
        with running.stream() as one:
            status, _, body = answer_of(everything(one))
        assert status == 503
        assert body == b"%d browsers look already, as many as may; close one\n" % MOST_STREAMS
        assert running.get("/")[0] == 200, "the page itself is still there"
        streams.pop().close()
        until(lambda: running.push() or running.site.streams < MOST_STREAMS)
        with running.stream() as one:
            assert read_until(one, b"\n\n").startswith(b"HTTP/1.1 200 ")


def test_a_hundred_that_hang_hold_up_nobody(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They take no memory beyond their buffers, and are dropped."""
    monkeypatch.setattr(server, "HUNG_AFTER_S", 0.5)
    running.push(b'{"t":0}')
    with ExitStack() as hung:
        for _ in range(100):
            one = hung.enter_context(running.connect())
            one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            one.sendall(f"GET /stream HTTP/1.1\r\nHost: {running.host}\r\n\r\n".encode())
        until(lambda: running.site.streams == 100)
        with running.stream() as well:
            read_until(well, b'{"t":0}')
            for seen in range(400):
                frame = b'{"t":%d,"x":"%s"}' % (seen, b"x" * 20_000)
                running.push(frame)
                data = read_until(well, b"\n\n")
                while frame not in data:
                    data += read_until(well, b"\n\n")
                if running.site.streams == 1:
                    break
                time.sleep(0.01)
            assert running.site.streams == 1, "those that hang are still held"
            assert seen > 10
