"""The banner: what needs a person, and what to do."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from views import S, service, status

from adaptive_contact.service.attention import Attention, remedy_of
from adaptive_contact.service.watch import LegView, View
from adaptive_contact.status import ServiceStatus
from adaptive_contact.wire import LearnerStatus

OPERATING = Path(__file__).parents[2] / "docs" / "operating.md"


def view(of: ServiceStatus | None, *statuses: LearnerStatus, **fields: Any) -> View:
    legs = [LegView(leg=s.leg, status=s.status, note=s.note) for s in statuses]
    return View(legs=legs, service=of, **{"alive": True, **fields})


def look(of: View, *statuses: LearnerStatus) -> list[tuple[str, list[str], str, str]]:
    found = Attention().list_findings(of, {s.leg: s for s in statuses}, 0)
    return [(f.level, f.legs, f.what, f.remedy) for f in found]


def notes_of_the_page() -> list[str]:
    table = OPERATING.read_text("utf-8").split("### What the note of a leg asks for")[1]
    table = table.split("\n#")[0]  # other tables of the page follow
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    assert len(rows) > 10
    return [note for row in rows for note in re.findall(r"`([^`]+)`", row.split(" | ")[0])]


@pytest.mark.parametrize("note", notes_of_the_page())
def test_each_note_of_the_page_has_a_remedy(note: str) -> None:
    remedy = remedy_of(note)
    assert remedy.endswith(".")


def test_all_is_well() -> None:
    legs = status(leg="lf"), status(leg="rf")
    assert look(view(service(), *legs), *legs) == []


@pytest.mark.parametrize(
    ("of", "what"),
    [
        (view(service(), connected=False), "the router is lost"),
        (view(None, alive=False), "no service is running here"),
        (view(service(), alive=False), "the service is gone: no contact is reported"),
    ],
)
def test_what_is_not_there_is_the_only_entry(of: View, what: str) -> None:
    (entry,) = look(of)
    assert entry[0] == "error"
    assert entry[2] == what
    assert "adaptive-contact serve" in entry[3]


SILENT = {"status": "silent", "note": "no sample for 4.0 s"}
CAUGHT = "the foot came 40 % of its command's way, 3 swings in a row: caught, or no strength"
LOST = "lifts have been 3.1 times as far from the model as they should for 40 swings: x"


@pytest.mark.parametrize(
    ("legs", "whose", "what", "remedy"),
    [
        (
            {"lf": SILENT, "rf": SILENT},
            ["lf", "rf"],
            "no sample",
            "Start the bridge or the controller",
        ),
        (
            {"lf": {}, "rf": {"status": "ambiguous", "note": CAUGHT, "doubt": "held"}},
            ["rf"],
            "the foot came",
            "Free the foot.",
        ),
        (
            {leg: {"status": "ambiguous", "note": LOST} for leg in ("lf", "lm", "rf", "rm")},
            ["lf", "lm", "rf", "rm"],
            "no leg moves as its model predicts",
            "signs",
        ),
    ],
)
def test_a_cause_of_one_leg_or_of_several_is_an_entry_with_its_remedy(
    legs: dict[str, dict[str, Any]], whose: list[str], what: str, remedy: str
) -> None:
    statuses = [status(leg=leg, **fields) for leg, fields in legs.items()]
    (entry,) = look(view(service(), *statuses), *statuses)
    assert entry[1] == whose
    assert what in entry[2]
    assert remedy in entry[3]


def test_a_count_is_shown_when_it_grows_and_for_a_minute() -> None:
    attention = Attention()
    of_old = view(service(events_lost=3))
    assert attention.list_findings(of_old, {}, 0) == [], "nothing is to be done about it now"
    (grown,) = attention.list_findings(view(service(events_lost=4)), {}, S)
    assert grown.what == "4 contact events were lost: held up for too long, or the link was closed"
    assert len(attention.list_findings(view(service(events_lost=4)), {}, 60 * S)) == 1
    assert attention.list_findings(view(service(events_lost=4)), {}, 62 * S) == []
    assert attention.list_findings(view(service(events_lost=0)), {}, 63 * S) == [], "it began again"


def test_the_services_own_words_are_shown() -> None:
    found = look(view(service(note="another service runs here", strays={"rf/servo": "did you?"})))
    assert [entry[2] for entry in found] == ["another service runs here", "nobody reads rf/servo"]
    assert found[1][3] == "Did you?"
