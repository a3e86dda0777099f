"""Log lines go where they can; where they cannot, the service goes on."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import structlog

from adaptive_contact.service.logs import configure_logs


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("as_json", [True, False])
def test_a_full_disk_ends_nobody(as_json: bool) -> None:
    full = Path("/dev/full").open("w", buffering=1)  # noqa: SIM115 - what is closed badly
    configure_logs(json=as_json, stream=full)
    for level in ("info", "warning", "error", "critical"):
        getattr(structlog.get_logger(), level)("disk is full", leg="rf")
    structlog.get_logger().error("a fault", exc_info=ValueError("once"))
    with pytest.raises(OSError, match="No space left"):
        full.close()  # its buffer is full of lines


def test_a_stack_is_plain_and_shows_no_values() -> None:
    """A local variable may be anybody's secret, and drawing them all takes a fifth of a second."""
    stream = io.StringIO()
    configure_logs(stream=stream)
    try:
        secret = "".join(("hush", "-", "hush"))
        raise ValueError(len(secret))
    except ValueError as fault:
        structlog.get_logger().error("a fault", leg="rf", exc_info=fault)
    text = stream.getvalue()
    assert "a fault" in text
    assert "ValueError: 9" in text
    assert "Traceback (most recent call last)" in text
    assert "hush-hush" not in text


def test_a_reader_that_is_gone_ends_nobody() -> None:
    stream = io.StringIO()
    configure_logs(json=True, stream=stream)
    structlog.get_logger().warning("told", leg="rf")
    assert json.loads(stream.getvalue())["message"] == "told"
    stream.close()
    structlog.get_logger().warning("not told")


@pytest.mark.parametrize("as_json", [True, False])
def test_a_line_shows_what_a_terminal_would_obey(as_json: bool) -> None:
    """Values, the event itself, and the message of an exception, whose text may be of the wire."""
    hostile = "\x1b[31mred\x07 \x9b2J\u202e \x7f\r\nall is well"
    stream = io.StringIO()
    configure_logs(json=as_json, stream=stream)
    structlog.get_logger().info("refused", key=hostile, many=[hostile])
    structlog.get_logger().error(hostile, exc_info=ValueError(hostile))
    text = stream.getvalue()
    assert not set(text) & set("\x1b\x07\x9b\u202e\x7f\r")
    assert "\\u001b[31mred" in text
    if as_json:
        lines = [json.loads(line) for line in text.splitlines()]
        assert [line["message"] for line in lines] == ["refused", hostile]
        assert lines[0]["key"] == hostile
