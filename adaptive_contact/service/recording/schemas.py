"""Defines schemas of the messages of every key, for other programs.

Protobuf descriptors are made from the structs of the wire; fields are numbered in their order.  A
map is a repeated message of ``key`` and ``value``, which has the same bytes and which every reader
takes; a list in a list is a repeated message of ``values``.  A file is read by the descriptors that
it carries, field by field by name, so that a contract with more fields reads an older file.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from types import UnionType
from typing import TYPE_CHECKING, Any, Final, Literal, Union, get_args, get_origin, get_type_hints

import msgspec
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import DescriptorProto
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.message import DecodeError

from adaptive_contact.status import ServiceStatus
from adaptive_contact.wire import (
    LEG_MESSAGES,
    BodyPose,
    BridgeStatus,
    Drift,
    Heartbeat,
    LegTrace,
    Mark,
    Message,
)

if TYPE_CHECKING:
    from google.protobuf.descriptor import Descriptor, FieldDescriptor
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

# Key without its namespace -> its message.  A leg's trace is left out: it answers a query, so no
# recording has it, and viewers cannot draw a list of ticks.
_OF_LEG: Final = {name: kind for name, kind in LEG_MESSAGES.items() if kind is not LegTrace}
_KEY: Final = re.compile(
    rf"(?:^|/)robot/(?:leg/[^/]+/(?P<leg>{'|'.join(_OF_LEG)})"
    r"|(?P<bridge>bridge/[^/]+/status)|(?P<service>service/status)|(?P<heartbeat>service)"
    r"|(?P<drift>sim/drift)|(?P<body>sim/body)|(?P<mark>mark))\Z"
)
_OTHERS: Final[dict[str, type[Message]]] = {
    "bridge": BridgeStatus,
    "service": ServiceStatus,
    "heartbeat": Heartbeat,
    "drift": Drift,
    "mark": Mark,
    "body": BodyPose,
}
KINDS: Final[tuple[type[Message], ...]] = (*_OF_LEG.values(), *_OTHERS.values())
_PACKAGE: Final = "adaptive_contact"
_SCALARS: Final = {
    bool: Field.TYPE_BOOL,
    int: Field.TYPE_INT64,
    float: Field.TYPE_DOUBLE,
    str: Field.TYPE_STRING,
}


@functools.lru_cache(maxsize=4096)
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
    """Split a type into its parts.

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
    # A pair is a list in the schema.
    return list if origin is tuple else origin, get_args(annotation), False


# -- protobuf --------------------------------------------------------------------------------------

# Turns a value of a struct's field into what a protobuf message takes, and back.
_Convert = Callable[[Any], Any]


@functools.cache
def protobuf_class(kind: type[Message]) -> tuple[bytes, Callable[[Message], bytes]]:
    """Make the protobuf form of a message.

    Returns:
        The binary FileDescriptorSet, and a function that turns a message into bytes; that raises
        ValueError for what the form cannot say: an integer of more than 64 bits, and an empty list
        where None is allowed.
    """
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}/{kind.__name__}.proto", package=_PACKAGE, syntax="proto3"
    )
    convert = _add_message(file.message_type.add(name=kind.__name__), kind, f".{_PACKAGE}")
    described = descriptor_pb2.FileDescriptorSet(file=[file])
    made = _message_class(described, kind)

    def to_bytes(message: Message) -> bytes:
        encoded: bytes = made(**convert(message)).SerializeToString()
        return encoded

    return described.SerializeToString(), to_bytes


def protobuf_reader(kind: type[Message], descriptors: bytes) -> Callable[[bytes], bytes]:
    """Make a function that turns protobuf into the msgpack of the wire.

    Args:
        kind: the message.
        descriptors: the FileDescriptorSet of the file; what it lacks is left out of the message.

    Raises:
        ValueError: they describe no such message; also from the function, for other bytes.
    """
    try:
        described = descriptor_pb2.FileDescriptorSet.FromString(descriptors)
        made = _message_class(described, kind)
        convert = _reverse(kind, made.DESCRIPTOR)
    except _BAD as error:
        raise ValueError(str(error)) from error

    def to_msgpack(payload: bytes) -> bytes:
        try:
            held = convert(made.FromString(payload))
            return msgspec.msgpack.encode({"v": kind.__struct_config__.tag, **held})
        except _BAD as error:
            raise ValueError(str(error)) from error

    return to_msgpack


# Exceptions of protobuf on invalid descriptors and bytes.
_BAD: Final = (DecodeError, TypeError, ValueError, KeyError, AttributeError, RecursionError)


def _message_class(described: FileDescriptorSet, kind: type[Message]) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in described.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema_name(kind)))


def _add_message(proto: DescriptorProto, struct: type[msgspec.Struct], scope: str) -> _Convert:
    """Describe a struct, and the types of its fields."""
    scope = f"{scope}.{proto.name}"
    hints = get_type_hints(struct)
    converters = [
        (field.name, _add_field(proto, field.name, number, hints[field.name], scope))
        for number, field in enumerate(msgspec.structs.fields(struct), 1)
    ]

    def convert(value: Any) -> dict[str, Any]:
        found = ((name, getattr(value, name), change) for name, change in converters)
        return {
            name: change(part) if change else part
            for name, part, change in found
            if part is not None
        }

    return convert


def _add_field(
    proto: DescriptorProto, name: str, number: int, annotation: Any, scope: str
) -> _Convert | None:
    """Add a field; return how to convert its values, None if protobuf takes them as they are."""
    origin, arguments, optional = parts_of(annotation)
    field = proto.field.add(name=name, number=number, label=Field.LABEL_OPTIONAL, json_name=name)
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
            _add_field(part, "key", 1, arguments[0], below)
            value = _add_field(part, "value", 2, arguments[1], below)
            return lambda held: [
                {"key": k, "value": value(v) if value else v} for k, v in held.items()
            ]
        rows = _add_field(part, "values", 1, item, below)
        return _filled(
            lambda held: [{"values": rows(row) if rows else row} for row in held], optional
        )
    if inner in _SCALARS or inner is Literal:
        field.type = _SCALARS.get(inner, Field.TYPE_STRING)
        if optional and not many:
            field.proto3_optional = True
            field.oneof_index = len(proto.oneof_decl)
            proto.oneof_decl.add(name=f"_{name}")
        return _filled(list, optional) if many and optional else None
    if inner.__name__ not in {nested.name for nested in proto.nested_type}:
        convert = _add_message(proto.nested_type.add(name=inner.__name__), inner, scope)
    else:  # another field of the same type
        convert = _add_message(DescriptorProto(name=inner.__name__), inner, scope)
    field.type, field.type_name = Field.TYPE_MESSAGE, f"{scope}.{inner.__name__}"
    return (lambda held: [convert(part) for part in held]) if many else convert


def _filled(convert: _Convert, optional: bool) -> _Convert:
    """Refuse an empty list where None is allowed, which has the same bytes."""

    def checked(held: Any) -> Any:
        if optional and not held:
            raise ValueError("an empty list")
        return convert(held)

    return checked


def _reverse(struct: type[msgspec.Struct], described: Descriptor) -> _Convert:
    """Turn a protobuf message into the map of a struct."""
    hints = get_type_hints(struct)
    fields: list[tuple[str, _Convert | None, bool, bool]] = []
    for field in msgspec.structs.fields(struct):
        there = described.fields_by_name.get(field.name)
        if there is not None:
            optional = parts_of(hints[field.name])[2]
            change = _reverse_field(hints[field.name], there)
            fields.append((field.name, change, optional, there.has_presence))

    def convert(message: Any) -> dict[str, Any]:
        made: dict[str, Any] = {}
        for name, change, optional, presence in fields:
            held = getattr(message, name)
            if optional and not (message.HasField(name) if presence else held):
                made[name] = None  # also in a field that has no default
            else:
                made[name] = change(held) if change else held
        return made

    return convert


def _reverse_field(annotation: Any, there: FieldDescriptor) -> _Convert | None:
    origin, arguments, _ = parts_of(annotation)
    if origin is dict:
        value = _reverse_field(arguments[1], there.message_type.fields_by_name["value"])
        return lambda held: {e.key: value(e.value) if value else e.value for e in held}
    if origin is list:
        inner = parts_of(arguments[0])[0]
        if inner is list:
            rows = _reverse_field(arguments[0], there.message_type.fields_by_name["values"])
            return lambda held: [(rows or list)(row.values) for row in held]
        if isinstance(inner, type) and issubclass(inner, msgspec.Struct):
            each = _reverse(inner, there.message_type)
            return lambda held: [each(part) for part in held]
        return list
    if isinstance(origin, type) and issubclass(origin, msgspec.Struct):
        return _reverse(origin, there.message_type)
    return None
