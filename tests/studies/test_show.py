"""The one layer of figures and pages."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact_studies.show.figures import needs_matplotlib, new_figure, save, styled
from adaptive_contact_studies.show.pages import (
    render,
    write_page,
)


def test_a_page_that_cannot_be_written_says_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(ConfigurationError, match="give another"):
        write_page(tmp_path / "file" / "page.md", "text")


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from adaptive_contact.cli.paper import paper

    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(MissingExtraError, match="a page needs the extra 'studies'"):
        render("adaptation.md")
    with pytest.raises(MissingExtraError, match="extra 'studies'"):
        paper(out=tmp_path / "out")
    assert not (tmp_path / "out").exists()  # said before any work
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match="a figure needs the extra 'plot'"):
        needs_matplotlib("a figure", "plot")


def test_a_style_ends_with_its_figure_and_files_are_the_same_each_time(tmp_path: Path) -> None:
    mpl = pytest.importorskip("matplotlib")
    before = mpl.rcParams["font.size"]

    @styled({"font.size": before + 3}, "a figure")
    def draw(path: Path) -> bytes:
        assert mpl.rcParams["font.size"] == before + 3
        figure = new_figure(2.0, 1.0)
        figure.subplots().plot([0, 1], [1, 0])
        save(figure, path)
        return path.read_bytes()

    first = draw(tmp_path / "first.png")
    assert first.startswith(b"\x89PNG")
    assert draw(tmp_path / "second.png") == first
    assert mpl.rcParams["font.size"] == before
