"""As much of Protocol Buffers as writing takes: values of a message to bytes, and messages described to whoever reads those bytes.

A message is a table of fields; the messages that describe messages (descriptor.proto) are such tables themselves, so that one encoder
does for both. Fields that hold their kind's zero are left out, as proto3 does. Source: protobuf.dev, "Encoding" and "Proto3 specification";
numbers of descriptor.proto from protobuf's own. Pure; knows no message but those that describe.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

Values = Mapping[str, Any]
VARINT, EIGHT_BYTES, COUNTED, FOUR_BYTES = 0, 1, 2, 5  # wire types
OPTIONAL, REPEATED = 1, 3  # FieldDescriptorProto.Label


class Kind(IntEnum):
    """FieldDescriptorProto.Type, as far as it is needed."""

    DOUBLE = 1
    INT64 = 3
    INT32 = 5
    FIXED32 = 7
    STRING = 9
    MESSAGE = 11
    BYTES = 12
    UINT32 = 13
    ENUM = 14


WIRE = {Kind.DOUBLE: EIGHT_BYTES, Kind.FIXED32: FOUR_BYTES, Kind.STRING: COUNTED, Kind.BYTES: COUNTED, Kind.MESSAGE: COUNTED}


@dataclass(frozen=True, slots=True)
class Choice:
    """An enumeration within a message: names to numbers."""

    name: str
    numbers: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Field:
    """A field of a message. ``of`` is the message or the enumeration that it holds; ``always``: written even where it is zero."""

    name: str
    number: int
    kind: Kind
    of: MessageType | Choice | None = None
    repeated: bool = False
    always: bool = False


@dataclass(frozen=True, slots=True)
class MessageType:
    """A message by its full name; each stands in a file of its own."""

    full_name: str
    fields: tuple[Field, ...]

    @property
    def package(self) -> str:
        """All before its name."""
        return self.full_name.rpartition(".")[0]

    @property
    def name(self) -> str:
        """Without its package."""
        return self.full_name.rpartition(".")[2]

    @property
    def file(self) -> str:
        """Where others find it; Google's own have small letters."""
        name = self.name.lower() if self.package == "google.protobuf" else self.name
        return f"{self.package.replace('.', '/')}/{name}.proto"


def encoded(kind: MessageType, values: Values) -> bytes:
    """The message with these ``values`` by field; what is missing has its default. Raises KeyError for a value that no field has.

    Fields go in the order of their numbers, as other encoders write them.
    """
    unknown = values.keys() - {field.name for field in kind.fields}
    if unknown:
        raise KeyError(f"{kind.full_name} has no {', '.join(sorted(unknown))}")
    in_order = sorted(kind.fields, key=lambda field: field.number)
    return b"".join(part for field in in_order if field.name in values for part in _field(field, values[field.name]))


def described(kind: MessageType) -> bytes:
    """A FileDescriptorSet with the message and all that it holds, each after what it needs."""
    files = [{"name": one.file, "package": one.package, **_contents(one)} for one in _with_needs(kind)]
    return encoded(FILE_SET, {"file": files})


def _field(field: Field, value: Any) -> Iterator[bytes]:
    if field.repeated and field.kind is Kind.DOUBLE:  # packed
        if value:
            yield _key(field.number, COUNTED) + _counted(struct.pack(f"<{len(value)}d", *value))
    elif field.repeated:
        yield from (_key(field.number, COUNTED) + _one(field, item) for item in value)
    elif value or field.always or field.kind is Kind.MESSAGE:
        yield _key(field.number, WIRE.get(field.kind, VARINT)) + _one(field, value)


def _one(field: Field, value: Any) -> bytes:
    match field.kind:
        case Kind.DOUBLE:
            return struct.pack("<d", value)
        case Kind.FIXED32:
            return struct.pack("<I", value)
        case Kind.STRING:
            return _counted(value.encode())
        case Kind.BYTES:
            return _counted(value)
        case Kind.MESSAGE if isinstance(field.of, MessageType):
            return _counted(encoded(field.of, value))
    return _varint(value)


def _key(number: int, wire: int) -> bytes:
    return _varint(number << 3 | wire)


def _counted(data: bytes) -> bytes:
    return _varint(len(data)) + data


def _varint(value: int) -> bytes:
    """Seven bits a byte, lowest first; negative numbers as 64-bit two's complement."""
    left, found = value & (1 << 64) - 1, bytearray()
    while left > 0x7F:
        found.append(left & 0x7F | 0x80)
        left >>= 7
    return bytes([*found, left])


def _with_needs(kind: MessageType) -> list[MessageType]:
    found: dict[str, MessageType] = {}
    for field in kind.fields:
        if isinstance(field.of, MessageType):
            found |= {one.full_name: one for one in _with_needs(field.of)}
    return [*found.values(), kind]


def _contents(kind: MessageType) -> Values:
    needs = sorted({field.of.file for field in kind.fields if isinstance(field.of, MessageType)})
    choices = [field.of for field in kind.fields if isinstance(field.of, Choice)]
    enums = [{"name": one.name, "value": [{"name": name, "number": n} for name, n in one.numbers.items()]} for one in choices]
    message = {"name": kind.name, "field": [_about(kind, field) for field in kind.fields], "enum_type": enums}
    return {"dependency": needs, "message_type": [message], "syntax": "proto3"}


def _about(kind: MessageType, field: Field) -> Values:
    label = REPEATED if field.repeated else OPTIONAL
    about = {"name": field.name, "number": field.number, "label": label, "type": int(field.kind), "json_name": _camel(field.name)}
    if isinstance(field.of, MessageType):
        return {**about, "type_name": f".{field.of.full_name}"}
    return {**about, "type_name": f".{kind.full_name}.{field.of.name}"} if field.of else about


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


def _described(name: str, *fields: Field) -> MessageType:
    return MessageType(f"google.protobuf.{name}", fields)


def _texts(name: str, number: int) -> Field:
    return Field(name, number, Kind.STRING)


def _messages(name: str, number: int, of: MessageType) -> Field:
    return Field(name, number, Kind.MESSAGE, of, repeated=True)


def _numbers(fields: Sequence[tuple[str, int]]) -> list[Field]:
    return [Field(name, number, Kind.INT32, always=True) for name, number in fields]


_NUMBERS_OF_FIELD = _numbers((("number", 3), ("label", 4), ("type", 5)))
FIELD = _described("FieldDescriptorProto", _texts("name", 1), *_NUMBERS_OF_FIELD, _texts("type_name", 6), _texts("json_name", 10))
ENUM_VALUE = _described("EnumValueDescriptorProto", _texts("name", 1), *_numbers([("number", 2)]))
ENUM = _described("EnumDescriptorProto", _texts("name", 1), _messages("value", 2, ENUM_VALUE))
MESSAGE = _described("DescriptorProto", _texts("name", 1), _messages("field", 2, FIELD), _messages("enum_type", 4, ENUM))
FILE = _described(
    "FileDescriptorProto", _texts("name", 1), _texts("package", 2), Field("dependency", 3, Kind.STRING, repeated=True),
    _messages("message_type", 4, MESSAGE), _texts("syntax", 12),
)  # fmt: skip
FILE_SET = _described("FileDescriptorSet", _messages("file", 1, FILE))
