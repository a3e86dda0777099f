"""The one layer of figures, tables, pages and progress."""

from __future__ import annotations

import io
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact_studies.show import progress as module
from adaptive_contact_studies.show.figures import needs_matplotlib, new_figure, save, styled
from adaptive_contact_studies.show.pages import (
    Section,
    Table,
    read_sections,
    render,
    unwrapped,
    write_page,
)

TEXT = """# T

from <here>

## A & B

with **weight**
and `code`

![a caption](pictures/drawn one.png)

*a caption*

**of `one` row**

| what\\|ever | `b` |
|---|---|
| <x>
  | **no** |
| a\\|b | yes |
"""


def test_a_page_of_markdown_is_read_as_its_sections() -> None:
    text = unwrapped(TEXT)
    assert "with **weight** and `code`" in text
    assert "| <x> | **no** |\n| a\\|b | yes |" in text
    first, section = read_sections(text)
    assert first == Section("T", "from <here>", [], {})
    assert (section.title, section.text) == ("A & B", "with **weight** and `code`")
    assert section.pictures == {"a caption": Path("pictures/drawn one.png")}
    header, rows = ["what|ever", "`b`"], [["<x>", "**no**"], ["a|b", "yes"]]
    assert section.tables == [Table("of `one` row", header, rows)]


def test_a_page_of_html_escapes_what_it_shows(tmp_path: Path) -> None:
    first, section = read_sections(unwrapped(TEXT))
    drawn = tmp_path / "drawn.png"
    drawn.write_bytes(b"picture")
    text = render("report.html", sections=[first, section._replace(pictures={"<c>": drawn})])
    assert "from &lt;here&gt;" in text
    assert "<td>&lt;x&gt;</td>" in text
    assert '<td class="no"><b>no</b></td>' in text
    assert "with <b>weight</b> and <code>code</code>" in text
    assert "A &amp; B" in text
    assert '<img alt="&lt;c&gt;" src="data:image/png;base64,' in text


def test_a_page_that_cannot_be_written_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ConfigurationError, match="give another"):
        write_page(tmp_path / "file" / "page.md", "text", "give another folder")


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match="a page needs the extra 'studies'"):
        render("report.html")
    with pytest.raises(MissingExtraError, match="a figure needs the extra 'plot'"):
        needs_matplotlib("a figure", "plot")


@pytest.mark.parametrize("absent", ["jinja2", "matplotlib"])
def test_the_paper_names_a_missing_extra_before_any_work(
    absent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from adaptive_contact.cli.paper import paper

    monkeypatch.setitem(sys.modules, absent, None)
    with pytest.raises(MissingExtraError, match="extra 'studies'"):
        paper(out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_style_ends_with_its_figure_and_files_are_the_same_each_time(tmp_path: Path) -> None:
    mpl = pytest.importorskip("matplotlib")
    before = mpl.rcParams["font.size"]

    @styled({"font.size": before + 3}, "a figure")
    def draw(path: Path, colours: int | None) -> bytes:
        assert mpl.rcParams["font.size"] == before + 3
        figure = new_figure(2.0, 1.0)
        figure.subplots().plot([0, 1], [1, 0])
        save(figure, path, colours)
        return path.read_bytes()

    for colours in (None, 16):
        first = draw(tmp_path / "first.png", colours)
        assert first.startswith(b"\x89PNG")
        assert draw(tmp_path / "second.png", colours) == first
    assert mpl.rcParams["font.size"] == before


def test_without_a_terminal_progress_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = iter((0.0, 6.0, 60.0, 61.0, 180.0))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(now_s)))
    out = io.StringIO()
    with module.progress(Console(file=out, width=100), "counting", 4.0) as tell:
        tell(0.5)  # too soon for a line
        tell(0.5)
        tell(1.0)
    assert out.getvalue().splitlines() == [
        "counting: 25 % in 1 min, about 3 to go",
        "counting: 180 s",
    ]
