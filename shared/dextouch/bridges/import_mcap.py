"""Import of MCAP files that other tools wrote: Foxglove in JSON or protobuf, and ROS 2.

Files are untrusted: they are read record by record, with bounded allocations.
"""

import contextlib
import io
import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from dextouch.bridges.export_files import SEQUENCE
from dextouch.bridges.import_messages import (
    CALIBRATIONS,
    Plain,
    camera_model,
    items_of,
    schema_name,
)
from dextouch.bridges.import_recording import ImportAttributes, ImportReport
from dextouch.bridges.import_streams import Reading, Survey, import_readings
from dextouch.bridges.mcap import ABOUT, ATTRIBUTES_FILE, import_mcap, records
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, DexTouchError, InvalidInputError, LimitExceededError

MAX_MESSAGE_BYTES: Final = 1 << 26
MAX_SCHEMA_BYTES: Final = 1 << 20
MAX_CHANNELS: Final = 4096
# Of a message in JSON.
MAX_JSON_VALUES: Final = 1 << 20
_MAX_NS: Final = (1 << 63) - 1
_OF_EXPORTS: Final = (ABOUT, ATTRIBUTES_FILE)
# What parsers of schemas raise for those that are not valid.
_SCHEMA_ERRORS = (AttributeError, LookupError, NameError, RuntimeError, TypeError, ValueError)
Decoder = Callable[[bytes], Plain]


class OwnExportError(InvalidInputError):
    """The file is an export of ours, which is imported exactly by `import_mcap`."""


def import_any_mcap(path: Path, store: EpisodeStore, about: ImportAttributes) -> ImportReport:
    """Import an MCAP file: an export of ours as it was, another one as a recording.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not an MCAP file, nothing in it can be imported, or the mapping does not
            fit it.
        CorruptDataError: truncated or damaged; the store is unchanged, and the message says where,
            and how much was readable.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: the id is in the store already.
    """
    decoders: dict[tuple[str, int], Decoder | str] = {}
    try:
        return import_readings(
            path, store, about, lambda survey: _Readings(path, survey, decoders).run(), form="mcap"
        )
    except OwnExportError:
        # The prefix is of what has no id of its own.
        plain = ImportAttributes(id_prefix=about.id_prefix)
        flags = {"mapping": "map"}
        given = [flags.get(n, n) for n, v in vars(plain).items() if getattr(about, n) != v]
        if given:
            raise InvalidInputError(
                f"{path}: is an export of DexTouch, which comes back as it was; leave "
                f"{', '.join(f'--{name}' for name in given)} out"
            ) from None
    return ImportReport(import_mcap(path, store), path.name)


class _Readings:
    """One pass over a file; the first one has a survey, for what is no sample."""

    def __init__(
        self, path: Path, survey: Survey | None, decoders: dict[tuple[str, int], Decoder | str]
    ) -> None:
        self._path, self._survey = path, survey
        # By encoding and schema, each made for the first message of both passes.
        self._decoders = decoders
        self._schemas: dict[int, Schema] = {}
        # With the name of the schema, and why the channel is not read.
        self._channels: dict[int, tuple[Channel, str, str]] = {}
        self._schema_of: dict[str, str] = {}

    def run(self) -> Iterator[Reading]:
        for record in records(self._path):
            if isinstance(record, Message):
                if record.channel_id not in self._channels:
                    raise CorruptDataError(
                        f"{self._path}: a message of channel {record.channel_id}, which does not "
                        "exist"
                    )
                yield from self._read(record)
            elif isinstance(record, Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self._add_channel(record)
            elif isinstance(record, Attachment | Metadata) and record.name in _OF_EXPORTS:
                raise OwnExportError(f"{self._path}: is an export of DexTouch")
            elif isinstance(record, Attachment) and self._survey is not None:
                reason = "attachment; extract it with `mcap get attachment`"
                self._survey.refuse(record.name[:256], "attachment", reason)

    def _add_channel(self, channel: Channel) -> None:
        if channel.id in self._channels:
            return
        if len(self._channels) >= MAX_CHANNELS or len(channel.topic) > 1024:
            raise LimitExceededError(
                f"{self._path}: more than {MAX_CHANNELS} channels, or a topic of more than 1024 "
                "characters"
            )
        schema = self._schemas.get(channel.schema_id)
        name = "" if schema is None else schema_name(schema.name[:256])
        known = self._schema_of.setdefault(channel.topic, name)
        other = f"the topic has messages of {known!r}, too; give them a topic of their own"
        self._channels[channel.id] = (channel, name, "" if known == name else other)
        if self._survey is not None:
            self._survey.known.setdefault(channel.topic, name)

    def _read(self, message: Message) -> Iterator[Reading]:
        channel, schema, reason = self._channels[message.channel_id]
        decode = reason or self._decoder(channel)
        reading = Reading(channel.topic, schema, message.log_time, sequence=message.sequence or -1)
        if isinstance(decode, str):
            reason = decode
        elif len(message.data) > MAX_MESSAGE_BYTES:
            reason = f"message of more than {MAX_MESSAGE_BYTES} bytes"
        elif message.log_time > _MAX_NS:
            reason = "log time beyond the year 2262"
        else:
            try:
                plain = decode(message.data)
                if schema in CALIBRATIONS:
                    if self._survey is not None:
                        self._survey.note_camera(channel.topic, camera_model(plain))
                    return
                # Of an export of ours without its attachments; 0 in those of episodes.
                number = plain.get(SEQUENCE)
                if not (isinstance(number, int) and 0 < number <= _MAX_NS):
                    number = reading.sequence
                items = tuple(items_of(schema, plain, is_typed=channel.message_encoding != "json"))
                reading = replace(reading, items=items, sequence=number)
            except DexTouchError as error:
                reason = error.message
        yield replace(reading, reason=reason) if reason else reading

    def _decoder(self, channel: Channel) -> Decoder | str:
        key = (channel.message_encoding, channel.schema_id)
        if key not in self._decoders:
            schema = self._schemas.get(channel.schema_id)
            self._decoders[key] = _decoder_of(channel.message_encoding, schema)
        return self._decoders[key]


def _decoder_of(encoding: str, schema: "Schema | None") -> Decoder | str:
    """Function that decodes messages to plain values, or the reason why there is none."""
    if schema is not None and len(schema.data) > MAX_SCHEMA_BYTES:
        return f"schema of more than {MAX_SCHEMA_BYTES} bytes"
    try:
        if encoding == "json":
            return _from_json
        if encoding == "protobuf" and schema is not None and schema.encoding == "protobuf":
            return _protobuf_decoder(schema)
        if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
            return _ros_decoder(schema)
    except DexTouchError as error:
        return error.message
    kind = schema.encoding if schema is not None else "none"
    advice = {
        "ros1": "convert the bag to ROS 2 first (`rosbags-convert`)",
        "cdr": "record it with message definitions (`ros2msg`)",
    }.get(encoding, "expected JSON, protobuf or ROS 2 messages")
    return f"messages {encoding!r} with schema {kind!r}; {advice}"


def _from_json(data: bytes) -> Plain:
    # Base64 has none of these; an empty object takes 20 times its two bytes.
    if sum(map(data.count, (b",", b"{", b"["))) > MAX_JSON_VALUES:
        raise LimitExceededError(f"message of more than {MAX_JSON_VALUES} values")
    try:
        plain = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise CorruptDataError(f"not JSON ({error})") from error
    if isinstance(plain, dict):
        return plain
    return {"value": plain}


def _protobuf_decoder(schema: Schema) -> Decoder:
    try:
        files = {file.name: file for file in FileDescriptorSet.FromString(schema.data).file}
        pool: Any = DescriptorPool()
        for name in list(files):
            _add_file(pool, files, name)
        message_class: Any = GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (DecodeError, *_SCHEMA_ERRORS) as error:
        raise InvalidInputError(f"schema {schema.name[:256]!r} is not valid ({error})") from error

    def decode(data: bytes) -> Plain:
        message = message_class()
        try:
            message.MergeFromString(data)
            return _plain_protobuf(message)
        except (DecodeError, ValueError) as error:
            raise CorruptDataError(f"not a {schema.name[:256]} ({error})") from error

    return decode


def _add_file(pool: Any, files: dict[str, FileDescriptorProto], name: str) -> None:  # noqa: ANN401
    """Add a file of a schema to a pool, after those that it needs."""
    file = files.pop(name, None)
    if file is not None:
        for dependency in file.dependency:
            _add_file(pool, files, dependency)
        pool.Add(file)


def _plain_protobuf(message: Any) -> dict[str, Any]:  # noqa: ANN401 - made at run time
    """Fields by name; None where one that can be absent is."""
    plain: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        inner = field.message_type
        if field.is_repeated:
            if inner is None:
                is_number = field.cpp_type not in {FieldDescriptor.CPPTYPE_STRING}
                plain[field.name] = np.array(value) if is_number else list(value)
            elif inner.GetOptions().map_entry:
                plain[field.name] = {str(key): "map" for key in value}
            else:
                plain[field.name] = [_plain_protobuf(one) for one in value]
        elif field.has_presence and not message.HasField(field.name):
            plain[field.name] = None
        else:
            plain[field.name] = value if inner is None else _plain_protobuf(value)
    return plain


def _ros_decoder(schema: Schema) -> Decoder:
    # Only files of ROS 2 need it.
    from mcap_ros2._vendor.rosidl_adapter.parser import InvalidSpecification, InvalidValue
    from mcap_ros2.decoder import DecoderFactory

    try:
        # Its parser prints what it refuses.
        with contextlib.redirect_stderr(io.StringIO()):
            read = DecoderFactory().decoder_for("cdr", schema)
    except (
        InvalidSpecification,
        InvalidValue,
        McapError,
        ArithmeticError,
        *_SCHEMA_ERRORS,
    ) as error:
        raise InvalidInputError(
            f"schema {schema.name[:256]!r} is not valid ({type(error).__name__}: {error})"
        ) from error
    if read is None:
        raise InvalidInputError(f"schema {schema.name[:256]!r} has no decoder")

    def decode(data: bytes) -> Plain:
        # Plain CDR, big or little endian (DDS-RTPS 10.5); others align their fields otherwise.
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise CorruptDataError(f"encapsulation {data[:2].hex()}, expected plain CDR")
        try:
            return _plain_ros(read(data))
        except (struct.error, *_SCHEMA_ERRORS) as error:
            raise CorruptDataError(f"not a {schema.name[:256]} ({error})") from error

    return decode


def _plain_ros(message: Any) -> dict[str, Any]:  # noqa: ANN401 - made at run time
    return {name: _plain_value(getattr(message, name)) for name in message.__slots__}


def _plain_value(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, list):
        has_messages = bool(value) and hasattr(value[0], "__slots__")
        return [_plain_value(one) for one in value] if has_messages else value
    if isinstance(value, bytes):
        return np.frombuffer(value, dtype=np.uint8)
    return _plain_ros(value) if hasattr(value, "__slots__") else value
