"""Text from the wire is shown, never obeyed by a terminal."""

from __future__ import annotations

import io
import json
import unicodedata

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from adaptive_contact.printable import printable, printable_json, printable_lines
from adaptive_contact.service.watch import LegView, View
from adaptive_contact.service.watch_table import table

HOSTILE = "\x1b[31mred\x1b]0;title\x07 \x9b2J \u202eback [bold]markup[/] \x7f\r\n"


@given(st.text())
def test_no_control_character_is_left(text: str) -> None:
    shown = printable(text)
    assert not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in shown)
    assert not any(unicodedata.bidirectional(c) in _OVERRIDES for c in shown)
    assert printable(shown) == shown
    assert printable_lines(text).count("\n") == text.count("\n")


_OVERRIDES = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}


def test_ordinary_text_stays_as_it_is() -> None:
    text = "Bein µ 0.5° × 脚 ñ"
    assert printable(text) == text


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_json_keeps_its_value(text: str) -> None:
    assert json.loads(printable_json(json.dumps([text], ensure_ascii=False))) == [text]


def test_the_table_of_watch_sends_nothing_to_the_terminal() -> None:
    leg = LegView(leg=HOSTILE, note=HOSTILE, kind=HOSTILE, rejects={HOSTILE: 3}, status="valid")
    out = io.StringIO()
    Console(file=out, width=400, color_system=None).print(table(View(legs=[leg], alive=True)))
    text = out.getvalue()
    assert not set(text) & set("\x1b\x07\x9b\u202e\x7f\r")
    assert "[bold]markup[/]" in text
