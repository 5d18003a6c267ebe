"""Reads Protocol Buffers by the description that a file brings along, and shares no code with what
wrote them.

Numbers of descriptor.proto, wire types and kinds are typed from protobuf's own files.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOUBLE, INT64, INT32, FIXED32, STRING, MESSAGE, BYTES, UINT32, ENUM = 1, 3, 5, 7, 9, 11, 12, 13, 14
REPEATED = 3
ZERO: dict[int, Any] = {
    DOUBLE: 0.0,
    INT64: 0,
    INT32: 0,
    FIXED32: 0,
    STRING: "",
    MESSAGE: None,
    BYTES: b"",
    UINT32: 0,
    ENUM: 0,
}

# number -> name, kind, repeated, full name of what it holds
Fields = dict[int, tuple[str, int, bool, str]]


def varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80:
            return value, at


def raw(data: bytes) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and what stands there, unread."""
    at = 0
    while at < len(data):
        key, at = varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = varint(data, at)
            yield number, wire, value
        else:
            size = {1: 8, 5: 4}.get(wire)
            if size is None:
                assert wire == 2
                size, at = varint(data, at)
            assert at + size <= len(data)
            yield number, wire, data[at : at + size]
            at += size


def described(file_set: bytes) -> dict[str, Fields]:
    """The messages of a FileDescriptorSet by their full names; a file comes after those that it
    needs.
    """
    found: dict[str, Fields] = {}
    files: set[str] = set()
    for _, _, file in raw(file_set):
        texts = {
            number: value.decode()
            for number, wire, value in raw(file)
            if number in (1, 2, 12) and wire == 2
        }
        assert texts[12] == "proto3"
        needs = {value.decode() for number, _, value in raw(file) if number == 3}
        assert needs <= files
        files.add(texts[1])
        for message in [value for number, _, value in raw(file) if number == 4]:
            name = next(value.decode() for number, _, value in raw(message) if number == 1)
            found[f"{texts[2]}.{name}"] = dict(
                _field(value) for number, _, value in raw(message) if number == 2
            )
    return found


def _field(data: bytes) -> tuple[int, tuple[str, int, bool, str]]:
    known = {number: value for number, _, value in raw(data)}
    return known[3], (
        known[1].decode(),
        known[5],
        known[4] == REPEATED,
        known.get(6, b".").decode()[1:],
    )


def decoded(types: dict[str, Fields], name: str, data: bytes) -> dict[str, Any]:
    """A message by field; what it leaves out has its default, as viewers have it."""
    fields = types[name]
    found: dict[str, Any] = {
        field: [] if repeated else ZERO[kind] for field, kind, repeated, _ in fields.values()
    }
    for number, wire, value in raw(data):
        field, kind, repeated, of = fields[number]
        if repeated and kind == DOUBLE and wire == 2:
            found[field] += [one for (one,) in struct.iter_unpack("<d", value)]
        elif repeated:
            found[field].append(_value(types, kind, of, value))
        else:
            found[field] = _value(types, kind, of, value)
    return found


def _value(types: dict[str, Fields], kind: int, of: str, value: Any) -> Any:
    match kind:
        case 1:
            return struct.unpack("<d", value)[0]
        case 7:
            return struct.unpack("<I", value)[0]
        case 9:
            return value.decode()
        case 11:
            return decoded(types, of, value)
        case 3 | 5:
            return value - (1 << 64) if value >> 63 else value
    return value


def messages_of(path: Path, reader: Any) -> dict[str, list[tuple[str, int, Any]]]:
    """All messages of an MCAP file by topic: schema, time in ns, content. ``reader`` is the module
    `mcap.reader`.
    """
    found: dict[str, list[tuple[str, int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(
            file, validate_crcs=True
        ).iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            content = decoded(described(schema.data), schema.name, message.data)
            found.setdefault(channel.topic, []).append((schema.name, message.log_time, content))
    return found
