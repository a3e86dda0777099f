from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.settings import (
    LinkSettings,
    client_settings,
    endpoint,
    is_loopback,
    is_multicast,
    probe,
    router_settings,
    tcp_address,
)
from adaptive_contact.service.transport import configure


@pytest.mark.parametrize(
    ("typed", "full"),
    [
        ("127.0.0.1", "tcp/127.0.0.1:7447"),
        ("robot.local:8000", "tcp/robot.local:8000"),
        (" tcp/127.0.0.1:1 ", "tcp/127.0.0.1:1"),
        ("[::1]", "tcp/[::1]:7447"),
        ("tls/robot:7447?so_sndbuf=1", "tls/robot:7447?so_sndbuf=1"),
        ("unixsock-stream/tmp/z", "unixsock-stream/tmp/z"),
    ],
)
def test_endpoints_are_completed(typed: str, full: str) -> None:
    assert endpoint(typed) == full
    assert endpoint(full) == full


@pytest.mark.parametrize("typed", ["", "http/a:1", "tcp/a:b", "tcp/a:70000", "a:1:2", "tls/"])
def test_bad_endpoints_get_one_line(typed: str) -> None:
    with pytest.raises(ConfigurationError, match="endpoint"):
        endpoint(typed)


@given(st.text(max_size=30))
def test_any_text_is_an_endpoint_or_a_clear_refusal(text: str) -> None:
    try:
        full = endpoint(text)
    except ConfigurationError:
        return
    assert endpoint(full) == full


@pytest.mark.parametrize("name", ["", "/a", "a/", "a//b", "*", "a/**", "a b", "$x", "é", "@/x"])
def test_bad_namespaces(name: str) -> None:
    with pytest.raises(ConfigurationError, match="namespace"):
        client_settings(namespace=name)
    for good in ("hexapod1", "lab/hexapod1", "a.b-c_d/9"):
        assert client_settings(namespace=good).namespace == good


def test_the_service_listens_on_loopback_unless_it_only_joins() -> None:
    assert router_settings().listen == ("tcp/127.0.0.1:7447",)
    joined = router_settings(connect=["10.0.0.1"])
    assert (joined.mode, joined.listen) == ("client", ())
    both = router_settings(["127.0.0.1:1"], ["10.0.0.1"])
    assert (both.mode, both.connect) == ("router", ("tcp/10.0.0.1:7447",))


@pytest.mark.parametrize(
    ("locator", "loopback"),
    [
        ("tcp/127.0.0.1:1", True),
        ("tcp/[::1]:1", True),
        ("tcp/localhost:1", True),
        ("tcp/0.0.0.0:1", False),
        ("tcp/[::]:1", False),
        ("tls/192.168.1.2:1", False),
        ("tcp/robot:1", False),
        ("unixsock-stream//run/zenoh.sock", True),
        ("serial//dev/ttyUSB0", False),
    ],
)
def test_loopback(locator: str, loopback: bool) -> None:
    assert is_loopback(locator) is loopback


@pytest.mark.parametrize(
    ("locator", "multicast"),
    [
        ("udp/224.0.0.225:7498", True),
        ("udp/239.255.0.1:7498?rel=0#iface=lo", True),
        ("udp/[ff02::225]:7498#iface=lo", True),
        ("udp/[ff02::225%lo]:7498", True),
        ("udp/0xe00000e1:7498", True),  # 224.0.0.225, as Zenoh looks it up
        ("udp/192.168.1.2:7498", False),
        ("udp/[::]:7498", False),
        ("udp/a..b:7498", False),
        ("tcp/224.0.0.225:7498", False),
    ],
)
def test_multicast(locator: str, multicast: bool) -> None:
    assert is_multicast(locator) is multicast


def test_only_protocols_over_tcp_can_be_probed() -> None:
    assert tcp_address("tls/[::1]:7") == ("::1", 7)
    assert tcp_address("quic/a:7") is None


@pytest.mark.parametrize("host", ["192.168..7", f"{'a' * 64}.local"])
def test_a_name_that_none_can_be_is_one_line(host: str) -> None:
    finding = probe((f"tcp/{host}:7447",))
    assert finding.reach == "unreachable"
    assert f"the host name '{host}' of tcp/{host}:7447 is not known" in finding.line
    with pytest.raises(ConfigurationError, match="cannot listen on tcp/"):
        configure(router_settings([f"tcp/{host}:0"], insecure=True))


@pytest.mark.parametrize("make", [client_settings, router_settings])
@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_an_endpoint_that_zenoh_refuses_is_one_line_without_its_key(
    make: Callable[..., LinkSettings], host: str, tmp_path: Path
) -> None:
    secret = f"tls/{host}:17998?#connect_private_key_base64=it's TOPSECRET"
    with pytest.raises(ConfigurationError, match="Zenoh takes no such") as caught:
        configure(make([secret]))
    assert "TOPSECRET" not in str(caught.value)
    file = tmp_path / "zenoh.json5"
    file.write_text(f'{{connect: {{endpoints: ["{secret}"]}}}}')
    with pytest.raises(ConfigurationError, match="not a usable Zenoh configuration") as caught:
        configure(make(zenoh_config=file))
    assert "TOPSECRET" not in str(caught.value)


def test_settings_refuse_what_cannot_be() -> None:
    with pytest.raises(ConfigurationError, match="encoding"):
        LinkSettings(encoding="text/plain")
    with pytest.raises(ConfigurationError, match="does not listen"):
        LinkSettings(mode="client", listen=("tcp/127.0.0.1:1",))
