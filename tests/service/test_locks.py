"""What Zenoh's configuration must hold for a door to be locked, and who has none to lock."""

from __future__ import annotations

from pathlib import Path

import pytest

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.link import Link, NoRouterError, client_settings, router_settings
from adaptive_contact.service.transport import configure
from waiting import free_address


@pytest.mark.e2e
@pytest.mark.parametrize(
    "text",
    [
        # Zenoh 1.10 takes this list and asks nobody for a key.
        '{transport: {auth: {pubkey: {known_keys_file: "keys"}}}}',
        # It asks for no password where it has no user, neither of its own nor in the dictionary.
        '{transport: {auth: {usrpwd: {dictionary_file: "empty"}}}}',
        '{transport: {auth: {usrpwd: {dictionary_file: "blank"}}}}',
        # Mutual TLS where no TLS is spoken.
        "{transport: {link: {tls: {enable_mtls: true}}}}",
        "{}",
    ],
)
def test_what_asks_nobody_is_no_lock(tmp_path: Path, text: str) -> None:
    for name, content in (("keys", "k\n"), ("empty", ""), ("blank", "\n \n:\n")):
        (tmp_path / name).write_text(content)
        text = text.replace(f'"{name}"', f'"{tmp_path / name}"')
    config = tmp_path / "zenoh.json5"
    config.write_text(text)
    with pytest.raises(ConfigurationError, match="would let anybody on that network in"):
        Link.open(router_settings(["tcp/0.0.0.0:0"], zenoh_config=config))
    if "blank" in text:  # Zenoh does not read this one
        return
    with Link.open(router_settings(["0.0.0.0:0"], zenoh_config=config, insecure=True)) as router:
        endpoint = router.endpoints[0].replace("0.0.0.0", "127.0.0.1")
        with Link.open(client_settings([endpoint], wait=False)) as stranger:
            assert stranger.is_connected(), "this is why"


@pytest.mark.e2e
def test_one_user_in_the_dictionary_is_a_lock(tmp_path: Path) -> None:
    users = tmp_path / "users"
    config = tmp_path / "zenoh.json5"
    config.write_text(f'{{transport: {{auth: {{usrpwd: {{dictionary_file: "{users}"}}}}}}}}')
    with pytest.raises(ConfigurationError, match=r"users .* cannot be read: no such file"):
        Link.open(router_settings(["0.0.0.0:0"], zenoh_config=config))
    # Neither does Zenoh's own word for it come through on loopback, nor to a client.
    for settings in (
        router_settings(["127.0.0.1:0"], zenoh_config=config),
        client_settings(["127.0.0.1:1"], wait=False, zenoh_config=config),
    ):
        with pytest.raises(ConfigurationError, match=r"no such file.*; correct dictionary_file in"):
            Link.open(settings)
    users.write_text("robot:secret\n")
    with Link.open(router_settings(["0.0.0.0:0"], zenoh_config=config)) as router:
        endpoint = router.endpoints[0].replace("0.0.0.0", "127.0.0.1")
        with pytest.raises(NoRouterError, match="user and password"):
            Link.open(client_settings([endpoint], wait=False))


@pytest.mark.e2e
@pytest.mark.parametrize("where", ["udp/224.0.0.225:7498", "udp/[ff02::225]:7498#iface=lo"])
def test_multicast_is_a_door_without_a_lock_whatever_users_there_are(
    tmp_path: Path, where: str
) -> None:
    users = tmp_path / "users"
    users.write_text("robot:secret\n")
    auth = f'transport: {{auth: {{usrpwd: {{dictionary_file: "{users}"}}}}}}'
    config = tmp_path / "zenoh.json5"
    config.write_text(f"{{{auth}}}")
    listening = tmp_path / "listening.json5"
    listening.write_text(f'{{listen: {{endpoints: ["tcp/127.0.0.1:0", "{where}"]}}, {auth}}}')
    for settings in (
        router_settings([where], zenoh_config=config),
        router_settings(["127.0.0.1:0", where], zenoh_config=config),
        router_settings(zenoh_config=listening),
    ):
        with pytest.raises(ConfigurationError, match="is multicast, where Zenoh asks nobody"):
            configure(settings)
    configure(router_settings([where], zenoh_config=config, insecure=True))


@pytest.mark.e2e
def test_a_client_is_no_door_whatever_the_file_says(router: Link, tmp_path: Path) -> None:
    port = free_address().rpartition(":")[2]
    config = tmp_path / "zenoh.json5"
    config.write_text(f'{{listen: {{endpoints: ["tcp/0.0.0.0:{port}"]}}}}')
    joins = router_settings((), router.endpoints, zenoh_config=config)
    with Link.open(joins) as service:
        assert service.is_connected()
        with pytest.raises(NoRouterError, match="nobody listens"):
            Link.open(client_settings([f"tcp/127.0.0.1:{port}"], wait=False))
    # As a router it is one, and is asked for its lock.
    with pytest.raises(ConfigurationError, match="would let anybody on that network in"):
        Link.open(router_settings(zenoh_config=config))
