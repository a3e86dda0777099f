"""Schemas of the messages of every key, for programs that know nothing of this project.

JSON Schema follows what Foxglove's parser (and Lichtblick's, its free successor) reads: one object
without ``$ref`` and ``anyOf``, each field with one ``type``, no list in a list, ``properties`` in
every object.  What it cannot describe (``preview``) is left out of the schema, not of the message.

Protobuf descriptors are made from the same structs; fields are numbered in their order.  A map is a
repeated message of ``key`` and ``value``, which has the same bytes and which every reader takes.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from types import UnionType
from typing import TYPE_CHECKING, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from adaptive_contact.errors import needs
from adaptive_contact.service.status import ServiceStatus
from adaptive_contact.wire import (
    LEG_MESSAGES,
    BridgeStatus,
    Drift,
    Heartbeat,
    LegTrace,
    Message,
)

if TYPE_CHECKING:
    from google.protobuf.descriptor_pb2 import DescriptorProto

# Key, behind any namespace -> its message.  A leg's trace has none: it answers a question, so no
# recording has it, and a column that is a list of ticks could not be drawn.  Foxglove gets its
# ticks one by one (:class:`~adaptive_contact.service.foxglove_live.JudgedTick`).
_OF_LEG: Final = {name: kind for name, kind in LEG_MESSAGES.items() if kind is not LegTrace}
_KEY: Final = re.compile(
    rf"(?:^|/)robot/(?:leg/[^/]+/(?P<leg>{'|'.join(_OF_LEG)})"
    r"|(?P<bridge>bridge/[^/]+/status)|(?P<service>service/status)|(?P<heartbeat>service)|(?P<drift>sim/drift))\Z"
)
_OTHERS: Final[dict[str, type[Message]]] = {
    "bridge": BridgeStatus,
    "service": ServiceStatus,
    "heartbeat": Heartbeat,
    "drift": Drift,
}
KINDS: Final[tuple[type[Message], ...]] = (*_OF_LEG.values(), *_OTHERS.values())
_PACKAGE: Final = "adaptive_contact"


def kind_of_key(key: str) -> type[Message] | None:
    """Return the message of a key, under any namespace; None where the contract has no such key."""
    match = _KEY.search(key)
    if match is None:
        return None
    leg = match["leg"]
    return _OF_LEG[leg] if leg else _OTHERS[str(match.lastgroup)]


def schema_name(kind: type[Message]) -> str:
    """Name of a message for MCAP."""
    return f"{_PACKAGE}.{kind.__name__}"


def parts_of(annotation: Any) -> tuple[Any, tuple[Any, ...], bool]:
    """Take a type apart.

    Returns:
        Its origin (``list``, ``dict``, ``Literal`` or the type itself), the arguments of that, and
        whether it may be None.
    """
    if get_origin(annotation) in (Union, UnionType):
        others = [part for part in get_args(annotation) if part is not type(None)]
        origin, arguments, _ = parts_of(others[0])
        return origin, arguments, True
    origin = get_origin(annotation)
    if origin is None:
        return annotation, (), False
    # A pair is a list in every schema.
    return list if origin is tuple else origin, get_args(annotation), False


# -- JSON Schema -----------------------------------------------------------------------------------

_JSON_TYPES: Final = {bool: "boolean", int: "integer", float: "number", str: "string"}


def json_schema(kind: type[Message]) -> bytes:
    """Return the JSON Schema of a message, as Foxglove reads it."""
    schema = _json_object(kind)
    version = {"v": {"type": "integer", "description": "version of the contract"}}
    schema["properties"] = version | schema["properties"]
    schema["required"].insert(0, "v")
    return msgspec.json.encode(schema)


def _json_object(struct: type[msgspec.Struct]) -> dict[str, Any]:
    hints = get_type_hints(struct)
    fields = msgspec.structs.fields(struct)
    shown = {f.name: _json_type(hints[f.name]) for f in fields}
    return {
        "title": struct.__name__,
        "description": " ".join((struct.__doc__ or "").split()),
        "type": "object",
        "properties": {name: part for name, part in shown.items() if part is not None},
        "required": [f.name for f in fields if f.required and shown[f.name]],
    }


def _json_type(annotation: Any) -> dict[str, Any] | None:
    """None for a list in a list."""
    origin, arguments, _ = parts_of(annotation)
    if origin is list:
        items = None if parts_of(arguments[0])[0] is list else _json_type(arguments[0])
        return None if items is None else {"type": "array", "items": items}
    if origin is dict:
        return {
            "type": "object",
            "properties": {},
            "additionalProperties": _json_type(arguments[1]),
        }
    if origin is Literal:
        return {"type": "string", "enum": sorted(arguments)}
    if origin in _JSON_TYPES:
        return {"type": _JSON_TYPES[origin]}
    return _json_object(origin)


# -- protobuf --------------------------------------------------------------------------------------

# Turns a value of a struct's field into what a protobuf message takes.
_Convert = Callable[[Any], Any]


@functools.cache
def protobuf_class(kind: type[Message]) -> tuple[bytes, Callable[[Message], bytes]]:
    """Make the protobuf form of a message.

    Returns:
        The binary FileDescriptorSet, and a function that turns a message into bytes; that raises
        ValueError for an integer of more than 64 bits.

    Raises:
        MissingExtraError: protobuf is not installed.
    """
    with needs("export --to protobuf", "export"):
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}/{kind.__name__}.proto", package=_PACKAGE, syntax="proto3"
    )
    convert = _add_message(file.message_type.add(name=kind.__name__), kind, f".{_PACKAGE}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name(kind)))

    def to_bytes(message: Message) -> bytes:
        encoded: bytes = made(**convert(message)).SerializeToString()
        return encoded

    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), to_bytes


def _add_message(proto: DescriptorProto, struct: type[msgspec.Struct], scope: str) -> _Convert:
    """Describe a struct, and what it is made of inside it."""
    scope = f"{scope}.{proto.name}"
    hints = get_type_hints(struct)
    converters: list[tuple[str, _Convert]] = []
    for number, field in enumerate(msgspec.structs.fields(struct), 1):
        converters.append(
            (field.name, _add_field(proto, field.name, number, hints[field.name], scope))
        )

    def convert(value: Any) -> dict[str, Any]:
        found = ((name, getattr(value, name), change) for name, change in converters)
        return {name: change(part) for name, part, change in found if part is not None}

    return convert


def _add_field(
    proto: DescriptorProto, name: str, number: int, annotation: Any, scope: str
) -> _Convert:
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field

    scalars = {
        bool: Field.TYPE_BOOL,
        int: Field.TYPE_INT64,
        float: Field.TYPE_DOUBLE,
        str: Field.TYPE_STRING,
    }
    origin, arguments, optional = parts_of(annotation)
    field = proto.field.add(name=name, number=number, label=Field.LABEL_OPTIONAL)
    field.json_name = name
    many = origin in (list, dict)
    if many:
        field.label = Field.LABEL_REPEATED
    item = arguments[0] if origin is list else origin
    inner = parts_of(item)[0]
    if origin is dict or inner is list:
        part = proto.nested_type.add(name=f"{name.title().replace('_', '')}Entry")
        below = f"{scope}.{part.name}"
        field.type, field.type_name = Field.TYPE_MESSAGE, below
        if origin is dict:
            key = _add_field(part, "key", 1, arguments[0], below)
            value = _add_field(part, "value", 2, arguments[1], below)
            return lambda held: [{"key": key(k), "value": value(v)} for k, v in held.items()]
        rows = _add_field(part, "values", 1, item, below)
        return lambda held: [{"values": rows(row)} for row in held]
    if inner in scalars or inner is Literal:
        field.type = scalars.get(inner, Field.TYPE_STRING)
        if optional and not many:
            field.proto3_optional = True
            field.oneof_index = len(proto.oneof_decl)
            proto.oneof_decl.add(name=f"_{name}")
        return lambda held: held
    if inner.__name__ not in {nested.name for nested in proto.nested_type}:
        convert = _add_message(proto.nested_type.add(name=inner.__name__), inner, scope)
    else:  # another field of the same type
        from google.protobuf.descriptor_pb2 import DescriptorProto

        convert = _add_message(DescriptorProto(name=inner.__name__), inner, scope)
    field.type, field.type_name = Field.TYPE_MESSAGE, f"{scope}.{inner.__name__}"
    return (lambda held: [convert(part) for part in held]) if many else convert
