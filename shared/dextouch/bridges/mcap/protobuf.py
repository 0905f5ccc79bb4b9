"""Minimal proto3 encoder and decoder, driven by tables of message fields.

Supports only what our messages need: numbers, strings, bytes, packed arrays and nested messages
(https://protobuf.dev/programming-guides/encoding). The tables describe themselves: the
`FileDescriptorSet` that an MCAP schema carries is encoded by the same code.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dextouch.errors import CorruptDataError, InvalidInputError

Scalar = Literal["double", "float", "int64", "int32", "fixed32", "sfixed64", "string", "bytes"]
Values = dict[str, object]

# Numbers of FieldDescriptorProto.Type, and how each is written.
_TYPE_NUMBERS = {
    "double": 1,
    "float": 2,
    "int64": 3,
    "int32": 5,
    "fixed32": 7,
    "string": 9,
    "bytes": 12,
    "sfixed64": 16,
}
_MESSAGE_TYPE = 11
_OPTIONAL, _REPEATED = 1, 3
_FIXED = {"double": "<f8", "float": "<f4", "fixed32": "<u4", "sfixed64": "<i8"}
_STRUCTS = {"double": "<d", "float": "<f", "fixed32": "<I", "sfixed64": "<q"}
_VARINT, _WIRE_64, _BYTES, _WIRE_32 = 0, 1, 2, 5
_MAX_VARINT_BYTES = 10


@dataclass(frozen=True)
class Field:
    """One field of a message; `kind` is a scalar or the full name of a message in the table."""

    number: int
    name: str
    kind: str
    repeated: bool = False


Table = Mapping[str, tuple[Field, ...]]


def _varint(number: int) -> bytes:
    number &= (1 << 64) - 1
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _delimited(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | _BYTES) + _varint(len(data)) + data


def _encode_one(table: Table, field: Field, value: object) -> bytes:
    number, kind = field.number, field.kind
    if kind in table and isinstance(value, Mapping):
        return _delimited(number, encode(table, kind, value))
    if kind == "bytes" and isinstance(value, bytes):
        return _delimited(number, value)
    if kind == "string" and isinstance(value, str):
        return _delimited(number, value.encode())
    if kind in {"int32", "int64"} and isinstance(value, int):
        return _varint(number << 3 | _VARINT) + _varint(value)
    if kind in _STRUCTS and isinstance(value, int | float):
        wire = _WIRE_32 if kind in {"float", "fixed32"} else _WIRE_64
        return _varint(number << 3 | wire) + struct.pack(_STRUCTS[kind], value)
    raise InvalidInputError(f"field {field.name}: got {type(value).__name__}, expected {kind}")


def encode(table: Table, message: str, values: Mapping[str, object]) -> bytes:
    """Bytes of one message.

    Args:
        table: all messages by full name.
        message: which of them.
        values: by field name; a missing field is omitted, repeated numbers are arrays,
            repeated messages lists of mappings.

    Raises:
        InvalidInputError: a value that does not fit its field.
    """
    parts = []
    for field in table[message]:
        if field.name not in values:
            continue
        value = values[field.name]
        if not field.repeated:
            parts.append(_encode_one(table, field, value))
        elif field.kind in _FIXED:
            packed = np.ascontiguousarray(value, dtype=_FIXED[field.kind]).tobytes()
            parts.append(_delimited(field.number, packed))
        elif isinstance(value, list | tuple):
            parts.extend(_encode_one(table, field, item) for item in value)
        else:
            raise InvalidInputError(f"field {field.name}: got {type(value).__name__}, expected []")
    return b"".join(parts)


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    number = 0
    for index, byte in enumerate(data[at : at + _MAX_VARINT_BYTES]):
        number |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return number & ((1 << 64) - 1), at + index + 1
    raise CorruptDataError(f"protobuf: number at byte {at} of {len(data)} is not terminated")


def _signed(number: int) -> int:
    return number - (1 << 64) if number >> 63 else number


def _take(data: bytes, at: int) -> tuple[int, int, int | bytes, int]:
    """Field number, wire type, raw value and offset of the next field."""
    key, at = _read_varint(data, at)
    number, wire = key >> 3, key & 7
    if wire == _VARINT:
        value, at = _read_varint(data, at)
        return number, wire, value, at
    if wire == _BYTES:
        size, at = _read_varint(data, at)
    elif wire in {_WIRE_32, _WIRE_64}:
        size = 4 if wire == _WIRE_32 else 8
    else:
        raise CorruptDataError(f"protobuf: wire type {wire} at byte {at}, expected 0, 1, 2 or 5")
    if at + size > len(data):
        raise CorruptDataError(
            f"protobuf: field {number} wants {size} bytes at {at}, {len(data) - at} are left"
        )
    return number, wire, data[at : at + size], at + size


def _decode_one(table: Table, field: Field, wire: int, raw: int | bytes) -> object:
    kind = field.kind
    if isinstance(raw, int):
        if kind in {"int32", "int64"}:
            return _signed(raw)
    elif kind in _FIXED and field.repeated and wire == _BYTES:
        if len(raw) % np.dtype(_FIXED[kind]).itemsize == 0:
            return np.frombuffer(raw, dtype=_FIXED[kind])
    elif kind in _STRUCTS and wire in {_WIRE_32, _WIRE_64}:
        if struct.calcsize(_STRUCTS[kind]) == len(raw):
            return struct.unpack(_STRUCTS[kind], raw)[0]
    elif wire == _BYTES:
        return _decode_bytes(table, field, raw)
    raise CorruptDataError(f"protobuf: field {field.name!r} has wire type {wire}, expected {kind}")


def _decode_bytes(table: Table, field: Field, raw: bytes) -> object:
    if field.kind in table:
        return decode(table, field.kind, raw)
    if field.kind == "bytes":
        return raw
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise CorruptDataError(f"protobuf: field {field.name!r} is not text") from error


def decode(table: Table, message: str, data: bytes) -> Values:
    """Decode the fields that are present, by name; unknown ones are skipped.

    Raises:
        CorruptDataError: bytes that are not a valid message.
    """
    fields = {field.number: field for field in table[message]}
    values: Values = {}
    at = 0
    while at < len(data):
        number, wire, raw, at = _take(data, at)
        if number not in fields:
            continue
        field = fields[number]
        value = _decode_one(table, field, wire, raw)
        if field.repeated and not isinstance(value, np.ndarray):
            items = values.setdefault(field.name, [])
            if isinstance(items, list):
                items.append(value)
        else:
            values[field.name] = value
    return values


_DESCRIPTORS: Table = {
    "FileDescriptorSet": (Field(1, "file", "FileDescriptorProto", repeated=True),),
    "FileDescriptorProto": (
        Field(1, "name", "string"),
        Field(2, "package", "string"),
        Field(3, "dependency", "string", repeated=True),
        Field(4, "message_type", "DescriptorProto", repeated=True),
        Field(12, "syntax", "string"),
    ),
    "DescriptorProto": (
        Field(1, "name", "string"),
        Field(2, "field", "FieldDescriptorProto", repeated=True),
    ),
    "FieldDescriptorProto": (
        Field(1, "name", "string"),
        Field(3, "number", "int32"),
        Field(4, "label", "int32"),
        Field(5, "type", "int32"),
        Field(6, "type_name", "string"),
    ),
}


def _file_name(message: str) -> str:
    package, name = message.rsplit(".", 1)
    stem = name.lower() if package == "google.protobuf" else name
    return f"{package.replace('.', '/')}/{stem}.proto"


def _field_values(table: Table, field: Field) -> Values:
    values: Values = {
        "name": field.name,
        "number": field.number,
        "label": _REPEATED if field.repeated else _OPTIONAL,
    }
    if field.kind in table:
        return {**values, "type": _MESSAGE_TYPE, "type_name": f".{field.kind}"}
    return {**values, "type": _TYPE_NUMBERS[field.kind]}


def descriptor_set(table: Table, message: str) -> bytes:
    """A `FileDescriptorSet` of one message and all that it needs, each in a file of its own."""
    files: dict[str, Values] = {}

    def add(name: str) -> None:
        if name in files:
            return
        needed = sorted({field.kind for field in table[name] if field.kind in table})
        for other in needed:
            add(other)
        package, short = name.rsplit(".", 1)
        fields = [_field_values(table, field) for field in table[name]]
        files[name] = {
            "name": _file_name(name),
            "package": package,
            "dependency": [_file_name(other) for other in needed],
            "message_type": [{"name": short, "field": fields}],
            "syntax": "proto3",
        }

    add(message)
    return encode(_DESCRIPTORS, "FileDescriptorSet", {"file": list(files.values())})
