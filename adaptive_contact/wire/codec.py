"""Encodes and decodes messages, as msgpack or JSON.

Decoding is two steps: ``msgpack`` (with limits on every length, so that a hostile payload
cannot make it allocate) or JSON (whose values are no longer than their text, and whose lists and
maps are counted first) parse the bytes, then ``msgspec`` converts and checks types.
A payload that does not fit gives a :class:`Rejected` with the reason and the field, never an
exception.
"""

from __future__ import annotations

import enum
import re
from typing import Final, NamedTuple, TypeVar

import msgpack
import msgspec

from adaptive_contact.wire.messages import Message, ServoSample

MSGPACK: Final = "application/msgpack"
JSON: Final = "application/json"

# The largest honest payload is a ModelReport of a 3-joint leg, about 30 kB.
MAX_PAYLOAD_BYTES: Final = 256 * 1024
# Samples come fifty times a second from every leg, and a hostile one costs half a microsecond per
# byte.  The largest honest one, 16 joints with the longest preview as JSON, is 21 kB.
MAX_SAMPLE_BYTES: Final = 32 * 1024
_MAP_BEGINS: Final = frozenset(bytes([byte]) for byte in (*range(0x80, 0x90), 0xDE, 0xDF))
# What programs write for a float that JSON lacks, outside of texts.
_NO_JSON: Final = re.compile(rb"[:\[,]\s*-?(?:nan|inf(?:inity)?)\s*[,\]}]", re.IGNORECASE)
# Of a list or map in msgpack; of lists and maps together in JSON.  Ten times what that report has.
_MAX_ITEMS: Final = 4096

M = TypeVar("M", bound=Message)


class Reject(enum.StrEnum):
    """Names why a payload or a sample was not used; the values are the keys of ``rejects``."""

    MALFORMED = "malformed"
    TOO_LARGE = "too_large"
    MISSING_FIELD = "missing_field"
    WRONG_TYPE = "wrong_type"
    VERSION = "version"
    NOT_FINITE = "not_finite"
    WRONG_JOINTS = "wrong_joints"
    OUT_OF_RANGE = "out_of_range"
    IMPLAUSIBLE = "implausible"
    UNKNOWN_LEG = "unknown_leg"
    TIME_BACKWARDS = "time_backwards"
    DUPLICATE_SEQ = "duplicate_seq"
    SEQ_JUMP = "seq_jump"
    OTHER_PUBLISHER = "other_publisher"
    OVERFLOW = "overflow"


class Rejected(NamedTuple):
    """Describes a payload that was not used: the reason, and one line naming the field."""

    reason: Reject
    detail: str


def encode(message: Message, encoding: str = MSGPACK) -> bytes:
    """Serialise a message.

    Args:
        message: any of the wire's messages.
        encoding: :data:`MSGPACK` or :data:`JSON`.
    """
    if encoding == JSON:
        return msgspec.json.encode(message)
    return msgspec.msgpack.encode(message)


def decode(payload: bytes, kind: type[M], encoding: str = MSGPACK) -> M | Rejected:
    """Parse and check a payload.

    Args:
        payload: the bytes received.
        kind: the message expected on that key.
        encoding: the Zenoh encoding; a payload that begins with ``{`` is JSON whatever it says.

    Returns:
        The message, or why it was refused.
    """
    limit = MAX_SAMPLE_BYTES if kind is ServoSample else MAX_PAYLOAD_BYTES
    if len(payload) > limit:
        return Rejected(Reject.TOO_LARGE, f"more than {limit} bytes")
    parsed = _parse(payload, encoding)
    if isinstance(parsed, Rejected):
        return parsed
    if not isinstance(parsed, dict):
        return Rejected(Reject.WRONG_TYPE, f"expected a map, found {type(parsed).__name__}")
    if "v" not in parsed:  # msgspec lets a missing tag pass
        return Rejected(Reject.MISSING_FIELD, "missing required field `v`")
    try:
        return msgspec.convert(parsed, kind, strict=True)
    except msgspec.ValidationError as error:
        return _classify(str(error))
    except (RecursionError, OverflowError) as error:
        return Rejected(Reject.MALFORMED, type(error).__name__)


def is_json(payload: bytes, encoding: str) -> bool:
    """Return whether a payload is JSON: as it begins with ``{``, or by its encoding.

    A message is a map: no map of msgpack begins with the byte ``{``, and no JSON with those that
    begin a map of msgpack.  So a client that declares another encoding, or none, is understood.
    """
    begins = json_text(payload)[:16].lstrip(b" \t\r\n")[:1]
    if begins in _MAP_BEGINS:
        return False
    return begins == b"{" or encoding.startswith((JSON, "text/json"))


def json_text(payload: bytes) -> bytes:
    """Return JSON without the mark of byte order (UTF-8) that some programs put before it."""
    return payload.removeprefix(b"\xef\xbb\xbf")


def _parse(payload: bytes, encoding: str) -> object:
    try:
        if is_json(payload, encoding):
            nested = payload.count(b"[") + payload.count(b"{")
            if nested > _MAX_ITEMS:
                why = f"{nested} lists and maps, at most {_MAX_ITEMS}"
                return Rejected(Reject.MALFORMED, why)
            return msgspec.json.decode(json_text(payload))
        return msgpack.unpackb(
            payload,
            raw=False,
            strict_map_key=True,
            max_str_len=_MAX_ITEMS,
            max_bin_len=_MAX_ITEMS,
            max_array_len=_MAX_ITEMS,
            max_map_len=_MAX_ITEMS,
            max_ext_len=0,
        )
    # msgpack documents ValueError and its own subclasses of it (and UnpackException for
    # truncated input); deep nesting raises RecursionError or StackError, unhashable or absurd keys
    # of a map TypeError or OverflowError.
    except (
        ValueError,
        msgpack.UnpackException,
        msgspec.DecodeError,
        RecursionError,
        TypeError,
        OverflowError,
    ) as error:
        if isinstance(error, msgspec.DecodeError) and _NO_JSON.search(payload):
            return Rejected(Reject.MALFORMED, "NaN or infinity, which JSON has no words for")
        return Rejected(Reject.MALFORMED, f"{type(error).__name__}: {_one_line(str(error))}")


def _classify(text: str) -> Rejected:
    detail = _one_line(text)
    if text.startswith("Invalid enum value") and text.endswith("`$.phase`"):
        detail += '; expected "swing" or "stance"'
    if "missing required field" in text:
        return Rejected(Reject.MISSING_FIELD, detail)
    if re.search(r"at `\$\.v`", text):
        return Rejected(Reject.VERSION, detail)
    return Rejected(Reject.WRONG_TYPE, detail)


def _one_line(text: str) -> str:
    return " ".join(text.split())[:200]
