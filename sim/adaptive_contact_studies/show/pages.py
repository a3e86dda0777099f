"""Pages of text, in Markdown or HTML, from templates."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from adaptive_contact.errors import ConfigurationError, needs
from adaptive_contact.files import cannot_write, write_file
from adaptive_contact_studies.show.numbers import FILTERS

_TEMPLATES: Final = Path(__file__).with_name("templates")
_PICTURE: Final = re.compile(r"!\[(.*)\]\((.*)\)")


class Table(NamedTuple):
    """A table of texts."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


class Section(NamedTuple):
    """A heading with its text (``**`` and backticks in it), tables, and pictures by caption."""

    title: str
    text: str
    tables: list[Table]
    pictures: dict[str, Path]


def render(template: str, filters: Mapping[str, Callable[..., Any]] = {}, **given: Any) -> str:
    """Fill a template; what it has no value for is a mistake of its own.

    Args:
        template: its file, such as ``report.html``; in one of HTML texts are escaped.
        filters: functions that it may use besides jinja's own.
        given: its values.

    Raises:
        MissingExtraError: jinja2 is not installed.
    """
    with needs("a page", "studies"):
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=template.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        **FILTERS,
        "cell": _cell,
        "inline": _inline,
        "listed": _listed,
        "one_line": _one_line,
        "picture": _picture,
        **filters,
    }
    return environment.get_template(template).render(given)


def write_page(path: Path, text: str | bytes, advice: str) -> None:
    """Write a page or its picture, whole or not at all, into a folder that is made if need be.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(cannot_write(path, error, advice)) from error
    write_file(path, text, advice=advice)


def unwrapped(text: str) -> str:
    """Markdown with every paragraph, and every row of a table, in a line of its own."""
    blocks = []
    for block in filter(None, map(str.strip, re.split(r"\n\s*\n", text))):
        lines = [line.strip() for line in block.splitlines()]
        if block.startswith("|"):
            blocks.append(re.sub(r"(?<!\|)\n", " ", "\n".join(lines)))
        else:
            blocks.append(" ".join(lines))
    return "\n\n".join(blocks)


def read_sections(text: str) -> list[Section]:
    """The sections of a document as :func:`unwrapped` leaves it."""
    found: list[Section] = []
    titled = ""
    for block in text.split("\n\n"):
        if block.startswith("#"):
            found.append(Section(block.lstrip("# "), "", [], {}))
        elif picture := _PICTURE.fullmatch(block):
            found[-1].pictures[picture[1]] = Path(picture[2])
        elif block.startswith("|"):
            header, _, *rows = map(_cells, block.splitlines())
            found[-1].tables.append(Table(titled, header, rows))
        elif block.startswith("**") and block.endswith("**"):
            titled = block[2:-2]
        elif not block.startswith("*") or block.startswith("**"):
            found[-1] = found[-1]._replace(text=f"{found[-1].text}\n\n{block}".strip())
    return found


def _cells(row: str) -> list[str]:
    """What the cells of a row hold."""
    return [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", row)[1:-1]]


def _one_line(text: str) -> str:
    """Without the breaks that keep a template readable."""
    return " ".join(filter(None, map(str.strip, text.splitlines())))


def _listed(text: str) -> str:
    """Lines as the items of a list in a sentence."""
    return "; ".join(filter(None, map(str.strip, text.splitlines())))


def _cell(text: object) -> str:
    """A cell of a Markdown table."""
    return str(text).replace("|", "\\|")


def _inline(text: str) -> Any:
    """Escaped for HTML, with ``**bold**`` and backticks."""
    from markupsafe import Markup, escape

    safe = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", str(escape(text)))
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", safe))


def _picture(path: Path) -> str:
    """A PNG within the page that shows it."""
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
