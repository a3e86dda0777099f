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

# Turns a value of a struct's field into what a protobuf message takes, or back.
_Convert = Callable[[Any], Any]
# Both ways; None where protobuf has the same value.
_Ways = tuple[_Convert | None, _Convert | None]


@functools.cache
def protobuf_class(kind: type[Message]) -> tuple[bytes, Callable[[Message], bytes]]:
    """Make the protobuf form of a message.

    Returns:
        The binary FileDescriptorSet, and a function that turns a message into bytes; that raises
        ValueError for what the form cannot say: an integer of more than 64 bits, and an empty list
        where None is allowed.
    """
    described, convert, _ = _described(kind)
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
    except _BAD as error:
        raise ValueError(str(error)) from error

    convert = _described(kind)[2]

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


@functools.cache
def _described(kind: type[Message]) -> tuple[FileDescriptorSet, _Convert, _Convert]:
    """Describe a message; return its file, and what turns it into the form and back."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{_PACKAGE}/{kind.__name__}.proto", package=_PACKAGE, syntax="proto3"
    )
    ways = _add_message(file.message_type.add(name=kind.__name__), kind, f".{_PACKAGE}")
    return descriptor_pb2.FileDescriptorSet(file=[file]), *ways


def _add_message(
    proto: DescriptorProto, struct: type[msgspec.Struct], scope: str
) -> tuple[_Convert, _Convert]:
    """Describe a struct, and the types of its fields."""
    scope = f"{scope}.{proto.name}"
    hints = get_type_hints(struct)
    fields: list[tuple[str, bool, bool, _Convert | None, _Convert | None]] = []
    for number, name in enumerate(struct.__struct_fields__, 1):
        origin, _, optional = parts_of(hints[name])
        ways = _add_field(proto, name, number, hints[name], scope)
        fields.append((name, optional, origin in (list, dict), *ways))

    def to_form(value: Any) -> dict[str, Any]:
        found = ((name, getattr(value, name), change) for name, _, _, change, _ in fields)
        return {
            name: change(part) if change else part
            for name, part, change in found
            if part is not None
        }

    def back(message: Any) -> dict[str, Any]:
        made: dict[str, Any] = {}
        for name, optional, many, _, change in fields:
            held = getattr(message, name, None)
            if held is None:  # an older contract lacks the field
                continue
            if optional and not (held if many else message.HasField(name)):
                made[name] = None  # also in a field that has no default
            else:
                made[name] = change(held) if change else held
        return made

    return to_form, back


def _add_field(
    proto: DescriptorProto, name: str, number: int, annotation: Any, scope: str
) -> _Ways:
    """Add a field; return how to convert its values."""
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
            to, back = _add_field(part, "value", 2, arguments[1], below)
            return (
                lambda held: [{"key": k, "value": to(v) if to else v} for k, v in held.items()],
                lambda held: {e.key: back(e.value) if back else e.value for e in held},
            )
        to, back = _add_field(part, "values", 1, item, below)
        rows = _filled(lambda held: [{"values": to(r) if to else r} for r in held], optional)
        return rows, lambda held: [back(row.values) if back else row.values for row in held]
    if inner in _SCALARS or inner is Literal:
        field.type = _SCALARS.get(inner, Field.TYPE_STRING)
        if optional and not many:
            field.proto3_optional = True
            field.oneof_index = len(proto.oneof_decl)
            proto.oneof_decl.add(name=f"_{name}")
        return _filled(list, optional) if many and optional else None, list if many else None
    if inner.__name__ not in {nested.name for nested in proto.nested_type}:
        described = proto.nested_type.add(name=inner.__name__)
    else:  # another field of the same type
        described = DescriptorProto(name=inner.__name__)
    one_to, one_back = _add_message(described, inner, scope)
    field.type, field.type_name = Field.TYPE_MESSAGE, f"{scope}.{inner.__name__}"
    if not many:
        return one_to, one_back
    return lambda held: [one_to(p) for p in held], lambda held: [one_back(p) for p in held]


def _filled(convert: _Convert, optional: bool) -> _Convert:
    """Refuse an empty list where None is allowed, which has the same bytes."""

    def checked(held: Any) -> Any:
        if optional and not held:
            raise ValueError("an empty list")
        return convert(held)

    return checked
