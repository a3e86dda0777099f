"""Pages of text, in Markdown or HTML, from templates."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from adaptive_contact.errors import ConfigurationError, MissingExtraError
from adaptive_contact.files import cannot_write, write_file

__all__ = ["render", "write_page"]

_TEMPLATES: Final = Path(__file__).with_name("templates")


def render(template: str, filters: Mapping[str, Callable[..., Any]] = {}, **given: Any) -> str:
    """Fill a template; what it has no value for is a mistake of its own.

    Args:
        template: its file, such as ``report.html``; in one of HTML texts are escaped.
        filters: functions that it may use besides jinja's own.
        given: its values.

    Raises:
        MissingExtraError: jinja2 is not installed.
    """
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ModuleNotFoundError as error:
        raise MissingExtraError("a page", "studies") from error
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=template.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"cell": _cell, "inline": _inline, "picture": _picture, **filters}
    return environment.get_template(template).render(given)


def write_page(path: Path, text: str | bytes, advice: str) -> None:
    """Write a page or its picture, whole or not at all, into a folder that is made if need be.

    Args:
        path: where to.
        text: of the page, or bytes of the picture.
        advice: what to do where it cannot be written.

    Raises:
        ConfigurationError: it cannot be written there.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(cannot_write(path, error, advice)) from error
    write_file(path, text, advice=advice)


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
