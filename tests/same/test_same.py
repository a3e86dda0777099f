"""The comparison itself: what it calls the same, and that it sees what it is for."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from .compare import compare, known_fields
from .faults import FAULTS, Fault, find, planted
from .recordings import quick, write
from .trees import ROOT, Tree, of_revision, playing


def packed(*values: float) -> dict[str, Any]:
    return {"shape": [len(values)], "data": np.array(values, dtype="<f8").tobytes()}


def outcome() -> dict[str, Any]:
    """Of a leg with one event, one look and a snapshot."""
    event = {"leg": "rf", "seq": 7, "contact": True, "score": 1.5, "residual": [0.1, -0.2]}
    status = {"level": 1.25, "rejects": {}, "note": None}
    snapshot = {"format": 3, "factor": packed(1.0, 2.0), "counts": {"ticks": 9}}
    return {
        "events": [[7, "rf", event]],
        "looks": [[9, "rf", status, [100, 200]]],
        "end": {"rf": {"report": {"threshold": 18.0}, "snapshot": snapshot}},
        "fields": {"event": list(event), "status": list(status), "report": ["threshold"]},
    }


def changed(**at: Any) -> dict[str, Any]:
    """The outcome with one value changed, named by its path with ``__`` between."""
    of = outcome()
    for path, value in at.items():
        *way, last = [int(name) if name.isdigit() else name for name in path.split("__")]
        node: Any = of
        for name in way:
            node = node[name]
        node[last] = value
    return of


def test_an_outcome_equals_itself() -> None:
    of = outcome()
    of["events"][0][2]["score"] = math.nan
    assert compare(of, copy.deepcopy(of)).same


@pytest.mark.parametrize(
    ("path", "value", "kind"),
    [
        ("events__0__2__score", math.nextafter(1.5, 2.0), "event"),
        ("events__0__2__residual", [0.1, 0.2], "event"),
        ("events__0__2__residual", [0.1], "event"),
        ("events__0__2__seq", 7.0, "event"),
        ("looks__0__2__level", 1.0, "status"),
        ("looks__0__2__note", "late", "status"),
        ("looks__0__2__rejects", {"not_finite": 1}, "status"),
        ("looks__0__3", [100], "confirmed"),
        ("end__rf__report__threshold", -18.0, "report"),
        ("end__rf__report", None, "report"),
        ("end__rf__snapshot__factor", packed(1.0, 2.5), "snapshot"),
        ("end__rf__snapshot__factor", packed(1.0), "snapshot"),
        ("end__rf__snapshot__counts", {"ticks": 9, "contacts": 1}, "snapshot"),
        ("fault", "ValueError: no", "fault"),
    ],
)
def test_any_value_that_differs_is_found(path: str, value: Any, kind: str) -> None:
    before, after = outcome(), changed(**{path: value})
    for found in (compare(before, after), compare(after, before)):
        assert not found.same
        assert {d.kind for d in found.differences} == {kind}
        assert not found.new_fields


def test_zero_and_minus_zero_are_told_apart_bit_by_bit() -> None:
    before, after = changed(looks__0__2__level=0.0), changed(looks__0__2__level=-0.0)
    assert not compare(before, after).same
    assert compare(before, after, tolerance=1e-12).same


def test_a_decision_of_one_revision_is_a_flip_with_its_score() -> None:
    found = compare(outcome(), changed(events=[]))
    (flip,) = found.flips
    assert (flip.leg, flip.round, flip.seq, flip.contact) == ("rf", 7, 7, True)
    assert (flip.before, flip.after) == (1.5, None)
    assert found.events == (1, 0)


def test_a_decision_one_tick_later_is_two_flips_at_any_tolerance() -> None:
    of = outcome()
    later = changed(events=[[8, "rf", of["events"][0][2]]])
    assert len(compare(of, later, tolerance=1.0).flips) == 2


def test_the_tolerance_is_absolute_to_one_and_relative_beyond() -> None:
    near = changed(events__0__2__score=1.5 + 1.4e-9, end__rf__snapshot__factor=packed(1, 2 + 3e-9))
    found = compare(outcome(), near, tolerance=1e-9)
    assert [d.kind for d in found.differences] == ["snapshot"]
    assert found.largest == pytest.approx(1.5e-9, rel=1e-3)
    assert compare(outcome(), near, tolerance=2e-9).same
    assert not compare(outcome(), changed(events__0__2__seq=8), tolerance=10.0).same
    assert not compare(outcome(), changed(looks__0__2__level=math.nan), tolerance=1e9).same


def test_a_field_that_one_revision_lacks_is_named_once_and_is_no_difference() -> None:
    after = outcome()
    for event in (after["events"][0][2], after["events"][0][2]):
        event["cause"] = {"kind": "edge"}
    after["fields"]["event"] += ["cause", "cause.kind"]
    after["end"]["rf"]["snapshot"]["late"] = 4
    found = compare(outcome(), after)
    assert found.same
    assert found.new_fields == {"+ event.cause", "+ snapshot.late"}
    assert compare(after, outcome()).new_fields == {"- event.cause", "- snapshot.late"}


def test_a_key_that_only_this_recording_lacks_is_a_difference() -> None:
    whole, part = outcome(), outcome()
    del part["end"]["rf"]["snapshot"]["factor"]
    both = known_fields([whole, part])
    assert not compare(whole, part, fields=(both, both)).same


def test_snapshots_of_two_formats_are_not_compared_and_that_is_said() -> None:
    found = compare(outcome(), changed(end__rf__snapshot={"format": 4}))
    assert found.same
    assert found.notes == {"snapshots have formats 3 and 4: not compared"}


def test_what_may_differ_is_noted() -> None:
    after = changed(looks__0__2__note="late")
    found = compare(outcome(), after, ignore=frozenset({"status.note"}))
    assert found.same
    assert found.notes == {"status.note differs, as it may (IGNORE)"}


# -- with learners ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("same") / "quick.msgpack"
    write(quick(), path)
    return path


@pytest.fixture(scope="module")
def sound() -> Tree:
    """The working tree where it lies: of a copy, nothing would be compiled yet."""
    return Tree.at("working tree", ROOT)


def test_two_processes_give_the_same_to_the_last_bit(
    recording: Path, sound: Tree, tmp_path: Path
) -> None:
    outcomes = []
    for side in ("first", "second"):
        with playing(sound, {"quick": recording}, tmp_path / side) as one:
            outcomes += [outcome for _, outcome in one.done()]
    assert "fault" not in outcomes[0]
    assert len(outcomes[0]["events"]) > 10
    assert {look[2]["status"] for look in outcomes[0]["looks"]} >= {"valid", "adapting"}
    assert compare(*outcomes).same


# Processes of a planted tree compile a tick that no process has run: minutes on a busy machine.
pytestmark = pytest.mark.timeout(900)

QUICK = "sign of the onset's share"
COMPILED = (QUICK, "ticks before an onset", "forgetting")  # each compiles a tree for itself


def found(name: str, recording: Path, sound: Tree, folder: Path) -> str | None:
    """On what a planted fault shows, and how."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    with planted(fault, sound, folder) as tree:
        return find(fault, sound, tree, {"quick": recording}, folder / "outcomes")


def test_a_planted_fault_is_found(
    recording: Path, sound: Tree, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As plain Python: the compiler takes three times as long as both replays."""
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert found(QUICK, recording, sound, tmp_path) is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPILED)
def test_a_planted_fault_is_found_in_compiled_code(
    name: str, recording: Path, sound: Tree, tmp_path: Path
) -> None:
    assert found(name, recording, sound, tmp_path) is not None


def test_every_fault_can_be_planted_in_this_tree(sound: Tree, tmp_path: Path) -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 20
    for fault in FAULTS:
        with planted(fault, sound, tmp_path) as tree:
            assert tree.digest != sound.digest


def test_a_fault_whose_line_is_gone_fails_and_says_what_to_do(sound: Tree, tmp_path: Path) -> None:
    gone = Fault("gone", "detect/contact.py", "no such line", "", "walk-flat")
    with (
        pytest.raises(SystemExit, match=r"0 times .* adapt this fault"),
        planted(gone, sound, tmp_path),
    ):
        pass


def test_a_revision_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="found no revision 'nowhere'"):
        of_revision("nowhere", tmp_path)
