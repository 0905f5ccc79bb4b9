"""MCAP files that Foxglove displays: export of an episode or recording, and its exact import.

Files are untrusted: they are read record by record, with bounded allocations.
"""

import heapq
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, Final

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from dextouch import __version__
from dextouch.bridges.exporting import Reader, blocks, exported_samples, new_file
from dextouch.bridges.mcap_messages import (
    CALIBRATION,
    MessageCodec,
    Sent,
    calibration_message,
    descriptor_set,
    raw_encoding,
)
from dextouch.episodes import (
    Attributes,
    EpisodeReader,
    EpisodeStore,
    EpisodeWriter,
    attributes_id,
    disk_errors,
    kind_of,
)
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    LimitExceededError,
    NotFoundError,
    StorageError,
)
from dextouch.images import encode_jpeg
from dextouch.schemas import EpisodeAttributes, RecordingAttributes, first_problems, json_ready
from dextouch.streams import ENCODED_UNITS, HEAD_CAMERA, StreamDescriptor, encoded_values

PROFILE: Final = "dextouch"
BRIDGE_VERSION: Final = "1"
ABOUT: Final = "dextouch"
COUNTS: Final = "dextouch.num_samples"
NOTES: Final = "dextouch.notes"
ATTRIBUTES_FILE: Final = "attributes.json"
CALIBRATION_FILE: Final = "calibration.json"
CHUNK_BYTES: Final = 1 << 20
_SEQUENCE_BITS = 0xFFFF_FFFF
MAX_ATTRIBUTES_BYTES: Final = 1 << 24
_BLOCK_BYTES: Final = 1 << 24
MAX_RECORD_BYTES: Final = 1 << 28
MAGIC: Final = b"\x89MCAP0\r\n"
_WANTED = (Attachment, Channel, DataEnd, Message, Metadata, Schema)


def export_mcap(
    reader: Reader, path: Path, *, overwrite: bool = False, jpeg_quality: int | None = None
) -> int:
    """Write one episode or recording as MCAP and return the number of messages.

    `log_time` is t_ref_ns (episode) or t_host_ns (recording), `publish_time` the device's stamp
    where there is one. Encoded images are copied unchanged; `jpeg_quality` 1 … 100 encodes `rgb8`
    images as JPEG, which is lossy, None keeps raw pixels.

    Raises:
        ConflictError: the file exists, and is not to be overwritten.
        InvalidInputError: a quality outside 1 … 100.
        StorageError: the write failed.
    """
    if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
        raise InvalidInputError(f"JPEG quality: got {jpeg_quality}, expected 1 … 100")
    with new_file(path, overwrite=overwrite) as partial, partial.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        return _Export(reader, writer, jpeg_quality).run()


class _Export:
    def __init__(self, reader: Reader, writer: Writer, jpeg_quality: int | None) -> None:
        self._reader, self._writer, self._quality = reader, writer, jpeg_quality
        self._is_episode = isinstance(reader, EpisodeReader)
        self._sources = list(reader.attributes.streams)
        self._streams = [self._as_sent(stream) for stream in self._sources]
        counts = {s.name: len(exported_samples(reader, s.name)) for s in self._streams}
        self._counts = counts
        firsts = [int(reader.stamps_ns(name)[0]) for name, count in counts.items() if count]
        # MCAP's times cannot be negative; the messages' own stamps are unchanged.
        self._zero_ns = min([0, *firsts])
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: list[int] = []

    def _as_sent(self, stream: StreamDescriptor) -> StreamDescriptor:
        is_raw = stream.kind == "image" and stream.unit not in ENCODED_UNITS
        to_jpeg = self._quality is not None and is_raw and raw_encoding(stream) == "rgb8"
        return stream.model_copy(update={"unit": "jpeg"}) if to_jpeg else stream

    def run(self) -> int:
        """Write schemas, channels, attachments and messages, in this order."""
        self._writer.start(profile=PROFILE, library=f"dextouch {__version__}")
        self._write_about()
        sources = [self._messages(order) for order in range(len(self._streams))]
        num_messages = self._write_calibration()
        for log_time, order, publish_time, sequence, data in heapq.merge(*sources):
            self._writer.add_message(
                channel_id=self._channel_ids[order],
                log_time=log_time,
                publish_time=publish_time,
                sequence=sequence,
                data=data,
            )
            num_messages += 1
        finish: Callable[[], None] = self._writer.finish
        finish()
        return num_messages

    def _write_about(self) -> None:
        reader, attributes = self._reader, self._reader.attributes
        kept = attributes.model_copy(update={"streams": tuple(self._streams)})
        for name, value in (
            (ATTRIBUTES_FILE, json_ready(kept)),
            (CALIBRATION_FILE, self._calibration()),
        ):
            self._writer.add_attachment(
                create_time=0,
                log_time=0,
                name=name,
                media_type="application/json",
                data=json.dumps(value, sort_keys=True, indent=1).encode(),
            )
        about = {
            "bridge_version": BRIDGE_VERSION,
            "kind": "episode" if self._is_episode else "recording",
            "content_sha256": reader.content_sha256,
            "log_time_zero_ns": str(self._zero_ns),
            "task": attributes.task,
            "instruction": attributes.instruction,
        }
        self._writer.add_metadata(ABOUT, about)
        self._writer.add_metadata(COUNTS, {n: str(count) for n, count in self._counts.items()})
        if notes := reader.notes().notes:
            self._writer.add_metadata(NOTES, {str(n.number): n.model_dump_json() for n in notes})
        for stream in self._streams:
            message = MessageCodec(stream).message
            metadata = {"stream": stream.name, "unit": stream.unit, "kind": stream.kind}
            self._channel_ids.append(self._channel(f"/{stream.name}", message, metadata))

    def _calibration(self) -> dict[str, object]:
        about = self._reader.attributes
        if isinstance(about, EpisodeAttributes):
            return dict(about.matrices())
        return dict(about.calibration)

    def _channel(self, topic: str, message: str, metadata: dict[str, str]) -> int:
        if message not in self._schema_ids:
            self._schema_ids[message] = self._writer.register_schema(
                name=message, encoding="protobuf", data=descriptor_set(message)
            )
        return self._writer.register_channel(
            topic=topic,
            message_encoding="protobuf",
            schema_id=self._schema_ids[message],
            metadata=metadata,
        )

    def _write_calibration(self) -> int:
        K = self._calibration().get("K_head")
        camera = self._reader.streams.get(HEAD_CAMERA)
        if K is None or camera is None or not self._counts[HEAD_CAMERA]:
            return 0
        first_ns = int(self._reader.stamps_ns(HEAD_CAMERA)[0])
        height_px, width_px = camera.shape[:2]
        distortion = self._calibration().get("distortion_head", np.zeros((1, 5)))
        data = calibration_message(
            np.array(K),
            np.array(distortion, dtype=np.float64).ravel(),
            t_ns=first_ns,
            frame=camera.frame or HEAD_CAMERA,
            shape_px=(height_px, width_px),
        )
        log_time = first_ns - self._zero_ns
        self._writer.add_message(
            channel_id=self._channel(f"/{HEAD_CAMERA}/calibration", CALIBRATION, {}),
            log_time=log_time,
            publish_time=log_time,
            data=data,
        )
        return 1

    def _messages(self, order: int) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Log time, order of the channel among equal ones, publish time, counter and bytes."""
        stream = self._streams[order]
        codec = MessageCodec(stream)
        to_jpeg = stream.unit != self._sources[order].unit
        for block in blocks(self._reader, stream.name):
            columns = (block.t_ns.tolist(), block.t_device_ns.tolist(), block.sequence.tolist())
            for t_ns, t_device_ns, number, value in zip(*columns, block.values, strict=True):
                if to_jpeg:
                    value = encode_jpeg(value, quality=self._quality or 1)  # noqa: PLW2901
                sent = Sent(t_ns, t_device_ns, number, value)
                log_time = t_ns - self._zero_ns
                publish_time = t_device_ns if t_device_ns >= 0 else log_time
                sequence = number & _SEQUENCE_BITS if number >= 0 else 0
                data = codec.encode(sent, with_device=not self._is_episode)
                yield log_time, order, publish_time, sequence, data


def import_mcap(path: Path, store: EpisodeStore) -> str:
    """Import an MCAP file of `export_mcap` into a store, under the id that it had; returns the id.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not an MCAP file, or not written by DexTouch.
        CorruptDataError: truncated or damaged; the store is unchanged.
        LimitExceededError: a record exceeds the size limit.
        ConflictError: the id is in the store already.
    """
    attributes, counts = _about(path)
    kind = kind_of(attributes)
    with store.writer(kind=kind, attributes=attributes) as writer:
        streams = {
            f"/{stream.name}": _Stream(MessageCodec(stream), writer, is_episode=kind == "episode")
            for stream in attributes.streams
        }
        _read_messages(path, streams)
        for topic, stream in streams.items():
            stream.flush()
            expected = counts.get(stream.codec.descriptor.name)
            if stream.num_samples != expected:
                raise CorruptDataError(
                    f"{path}: {topic} holds {stream.num_samples} messages, expected {expected}; "
                    "the file was cut or filtered after the export"
                )
    return attributes_id(attributes)


def _about(path: Path) -> tuple[Attributes, dict[str, int]]:
    """What is needed before the samples: attributes, and the number of samples of each stream."""
    kind, text, counts = "", None, {}
    for record in records(path):
        if isinstance(record, Metadata) and record.name == ABOUT:
            version = record.metadata.get("bridge_version")
            if version != BRIDGE_VERSION:
                raise StorageError(
                    f"{path}: got bridge version {version!r}, expected {BRIDGE_VERSION!r}; "
                    "read it with the release that wrote it"
                )
            kind = record.metadata.get("kind", "")
        elif isinstance(record, Metadata) and record.name == COUNTS:
            counts = {name: _count(path, n) for name, n in record.metadata.items()}
        elif isinstance(record, Attachment) and record.name == ATTRIBUTES_FILE:
            text = record.data
    if text is None or kind not in {"episode", "recording"}:
        raise InvalidInputError(
            f"{path}: holds no attachment {ATTRIBUTES_FILE!r} of DexTouch; expected a file that "
            "`dextouch export --format mcap` wrote (`dextouch import` takes others, too)"
        )
    if len(text) > MAX_ATTRIBUTES_BYTES:
        raise CorruptDataError(f"{path}: {ATTRIBUTES_FILE} has {len(text)} bytes")
    model = EpisodeAttributes if kind == "episode" else RecordingAttributes
    try:
        return model.model_validate_json(text), counts
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: {ATTRIBUTES_FILE} is invalid ({first_problems(error)})"
        ) from error


def _count(path: Path, text: str) -> int:
    if not text.isdecimal() or len(text) > 18:
        raise CorruptDataError(f"{path}: metadata {COUNTS!r} says {text!r}, expected a number")
    return int(text)


class _Stream:
    """One stream of an import, with samples that are written together."""

    def __init__(self, codec: MessageCodec, writer: EpisodeWriter, *, is_episode: bool) -> None:
        self.codec, self._writer, self._is_episode = codec, writer, is_episode
        self.num_samples = self._num_bytes = 0
        self._sent: list[Sent] = []

    def add(self, data: bytes) -> None:
        self._sent.append(self.codec.decode(data))
        self.num_samples += 1
        self._num_bytes += len(data)
        if self._num_bytes >= _BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        sent, descriptor = self._sent, self.codec.descriptor
        self._sent, self._num_bytes = [], 0
        if not sent:
            return
        if descriptor.unit in ENCODED_UNITS:
            values = encoded_values([s.value for s in sent if isinstance(s.value, bytes)])
        else:
            values = np.stack([np.asarray(s.value) for s in sent])
        stamps = np.array([(s.t_ns, s.t_device_ns, s.sequence) for s in sent], dtype=np.int64)
        names = ("t_ref_ns",) if self._is_episode else ("t_host_ns", "t_device_ns", "sequence")
        columns = dict(zip(names, stamps.T, strict=False))
        self._writer.append(descriptor.name, values=values, **columns)


def _read_messages(path: Path, streams: Mapping[str, _Stream]) -> None:
    schemas: dict[int, str] = {}
    # None: channels added by other tools.
    channels: dict[int, _Stream | None] = {}
    for record in records(path):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            stream = channels[record.id] = streams.get(record.topic)
            got = (record.message_encoding, schemas.get(record.schema_id))
            if stream is not None and got != ("protobuf", stream.codec.message):
                raise CorruptDataError(
                    f"{path}: {record.topic} has messages {got[0]!r} {got[1]!r}, "
                    f"expected 'protobuf' {stream.codec.message!r}"
                )
        elif isinstance(record, Message):
            if record.channel_id not in channels:
                raise CorruptDataError(
                    f"{path}: a message of channel {record.channel_id}, which does not exist"
                )
            stream = channels[record.channel_id]
            if stream is not None:
                stream.add(record.data)


class _Bounded:
    """A file that never reads (and so never allocates) beyond its end."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size

    def read(self, size: int = -1) -> bytes:
        wanted = self._left if size < 0 else size
        if wanted > self._left:
            at = self._file.tell()
            raise EOFError(f"at byte {at}: {wanted} bytes requested, {self._left} are left")
        self._left -= wanted
        return self._file.read(wanted)


def records(path: Path) -> Iterator[McapRecord]:
    """Schemas, channels, messages, attachments and metadata in the order of the file.

    Raises as `import_mcap`; InvalidInputError also for an unsupported compression.
    """
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file; expected an MCAP file")
    with disk_errors(f"read {path}"), path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InvalidInputError(f"{path}: is not an MCAP file (wrong magic bytes)")
        file.seek(0)
        try:
            yield from _records(file, path)
        except EOFError as error:
            raise CorruptDataError(f"{path}: is truncated ({error}); copy it again") from error
        except (McapError, ValueError, KeyError, struct.error, zstandard.ZstdError) as error:
            raise CorruptDataError(
                f"{path}: is damaged or truncated before byte {file.tell()} "
                f"({type(error).__name__}: {error}); copy it again, or see what `mcap recover` "
                "saves"
            ) from error


def _records(file: BinaryIO, path: Path) -> Iterator[McapRecord]:
    bounded = _Bounded(file, path.stat().st_size)
    reader = StreamReader(
        bounded,  # type: ignore[arg-type]
        emit_chunks=True,
        validate_crcs=True,
        record_size_limit=MAX_RECORD_BYTES,
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            for inner in breakup_chunk(_opened(record, path), validate_crc=True):
                if isinstance(inner, _WANTED):
                    yield inner
        elif isinstance(record, _WANTED):
            yield record


def _opened(chunk: Chunk, path: Path) -> Chunk:
    """Decompress a chunk after checking its declared size."""
    if chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise LimitExceededError(
            f"{path}: a chunk announces {chunk.uncompressed_size} bytes, expected at most "
            f"{MAX_RECORD_BYTES}; write it with smaller chunks"
        )
    if chunk.compression == "":
        data = chunk.data
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            # At most one byte more than declared, never an unbounded output.
            data = stream.read(chunk.uncompressed_size + 1)
    elif chunk.compression == "lz4":
        try:
            data = lz4.frame.LZ4FrameDecompressor().decompress(
                chunk.data, max_length=chunk.uncompressed_size + 1
            )
        except RuntimeError as error:
            raise CorruptDataError(f"{path}: a chunk cannot be decompressed ({error})") from error
    else:
        raise InvalidInputError(
            f"{path}: got chunks compressed as {chunk.compression!r}, expected 'zstd', 'lz4' or "
            "none; "
            "convert it with `mcap compress --compression zstd`"
        )
    if len(data) != chunk.uncompressed_size:
        raise CorruptDataError(
            f"{path}: a chunk decompresses to {len(data)} bytes or more, it announces "
            f"{chunk.uncompressed_size}"
        )
    chunk.data, chunk.compression = data, ""
    return chunk
