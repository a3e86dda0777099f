"""Defines what writer and reader share: the record, and the names of encodings.

Reference: the MCAP format, https://mcap.dev/spec, and its registry of message encodings.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from adaptive_contact.wire import JSON, MSGPACK

# Name of the metadata record that says what the recording is of.
ABOUT: Final = "adaptive-contact"
# Metadata of a channel: the Zenoh encoding, where MCAP's name of it says less.
ENCODING: Final = "zenoh_encoding"

# Of a channel, by MCAP's name, and of its schema.
PROTOBUF: Final = "protobuf"
TO_MCAP: Final = {MSGPACK: "msgpack", JSON: "json"}
TO_ZENOH: Final = {name: encoding for encoding, name in TO_MCAP.items()}


class Record(NamedTuple):
    """Holds one message of a recording."""

    key: str  # Zenoh key it was seen on
    payload: bytes  # the bytes as they were, or msgpack of a message that was kept as protobuf
    encoding: str  # Zenoh encoding, `application/msgpack` or `application/json` as a rule
    log_time_ns: int  # when it was recorded, on the recorder's clock
    publish_time_ns: int  # when it was published, where that was known, else the log time
