"""`state show` and `state reset`: what a service has learned and kept."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from adaptive_contact.service.state import Identity, Record, StateStore


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A folder with states of two legs."""
    folder = tmp_path / "kept"
    with closing(StateStore.open(folder, "mini")) as store:
        for leg in ("lf", "rf"):
            who = Identity("mini", leg, "servo", "0123456789abcdef")
            state = {"saved_ns": 1, "package": "", "model_version": 3, "run": None, "seq": 4}
            store.save(Record(identity=who, body={"data": bytes(1000)}, **state))
    return folder


def test_what_is_kept_is_listed(ours: Any, kept: Path) -> None:
    done = ours("state", "show", "--state", kept, "--json")
    assert (done.code, done.err) == (0, "")
    rows = json.loads(done.out)
    names = ("robot", "leg", "model_version", "refused")
    assert [[row[name] for name in names] for row in rows] == [
        ["mini", "lf", 3, None],
        ["mini", "rf", 3, None],
    ]
    damaged, whole = (Path(row["file"]) for row in rows)
    damaged.write_bytes(damaged.read_bytes()[:-9])
    out = ours("state", "show", "--state", kept).out
    assert out.startswith(f"in {kept}\n")
    assert out.count(" mini ") + out.count("\nmini ") == 1
    assert f"{damaged.name}: damaged: " in out
    assert (out.count(" refused "), out.count(" sound ")) == (1, 1)
    # What the learner refused is no state to go on from, whole as it may be.
    whole.rename(whole.with_name(f"{whole.name}.refused"))
    assert "state.refused" in ours("state", "show", "--state", kept, "--leg", "rf").out


def test_a_leg_is_forgotten_unless_a_service_uses_it(ours: Any, kept: Path) -> None:
    with closing(StateStore.open(kept, "mini")):
        done = ours("state", "reset", "--state", kept, "--yes")
    assert (done.code, "in use by another service" in done.err) == (2, True)
    done = ours("state", "reset", "--state", kept, "--leg", "zz", "--yes")
    assert (done.code, "nothing of leg 'zz' is kept in" in done.err) == (2, True)
    # What saves that were killed have left; `.old` is all that was learned.
    for path in kept.glob("*/*.state"):
        path.with_suffix(".new").write_bytes(b"half of a st")
        path.with_suffix(".old").write_bytes(path.read_bytes())
    done = ours("state", "reset", "--state", kept, "--leg", "rf", "--yes")
    assert (done.code, done.out.startswith("forgot")) == (0, True)
    assert not list(kept.glob("*/rf-*"))
    assert {path.suffix for path in kept.glob("*/lf-*")} >= {".new", ".old"}
