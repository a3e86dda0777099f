"""Which settings a JSON5 file holds, whatever its way of writing them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from adaptive_contact.errors import ConfigurationError
from adaptive_contact.service.settings import client_settings, router_settings
from adaptive_contact.service.transport import DEFAULTS, configure, keys_of


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("{}", set()),
        (" \ufeff// a\n{ /* b: 1, */ } // c", set()),
        ("{a: {b: 1, 'c': 2, \"d\": [{e: 1}, [2,],],},}", {"a", "a/b", "a/c", "a/d"}),
        ("{a:-1,b:+.5,d:null,e:true}", {"a", "b", "d", "e"}),
        ("{'a\\'b': '}', \"c\\u0064\": \"\\\"{\", e: 'x\\\ny'}", {"a'b", "cd", "e"}),
        ("{a: 'http://x', b: \"/* no */\"}", {"a", "b"}),
        ("[1]", set()),
        ("{a: 1", set()),
        ("{a 1}", set()),
        ("{a: 1} b", set()),
        ("", set()),
    ],
)
def test_keys_are_found(text: str, keys: set[str]) -> None:
    assert keys_of(text) == keys


def nested(path: str, value: object) -> dict[str, Any]:
    for name in reversed(path.split("/")):
        value = {name: value}
    return value


@pytest.mark.parametrize("path", DEFAULTS)
def test_a_file_holds_over_our_defaults_also_with_zenohs_own_value(
    path: str, tmp_path: Path
) -> None:
    theirs = zenoh.Config().get_json(path)
    file = tmp_path / "zenoh.json5"
    file.write_text(json.dumps(nested(path, json.loads(theirs))))
    assert configure(client_settings(zenoh_config=file))[0].get_json(path) == theirs
    file.write_text("{}")
    ours = configure(client_settings(zenoh_config=file))[0].get_json(path)
    asked = DEFAULTS[path]
    assert (
        asked.items() <= json.loads(ours).items()
        if isinstance(asked, dict)
        else (json.loads(ours) == asked)
    )


def test_a_file_in_yaml_holds_where_it_differs(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.yaml"
    file.write_text("transport:\n  link:\n    tx:\n      lease: 3456\n")
    config, _ = configure(router_settings(["127.0.0.1:0"], zenoh_config=file))
    assert json.loads(config.get_json("transport/link/tx/lease")) == 3456
    assert json.loads(config.get_json("timestamping/enabled")) is True


@pytest.mark.parametrize("text", ["{a:" * 100_000, "[" * 200_000, "#" * 1_000_000])
def test_a_text_that_would_end_zenoh_or_fill_memory_is_refused(tmp_path: Path, text: str) -> None:
    """Its parser overflows the stack where a text is nested deeply."""
    path = tmp_path / "zenoh.json5"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=f"^{path}: (nested|has) more than .*; give a"):
        configure(router_settings(zenoh_config=path))
