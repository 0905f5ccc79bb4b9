"""MCAP files that Foxglove displays: export of an episode or recording, and its exact import.

Files are untrusted: they are read record by record, with bounded allocations.
"""

import heapq
import json
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Final

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from mcap.writer import CompressionType, Writer
from pydantic import ValidationError

from dextouch import __version__
from dextouch.bridges.export_files import (
    Block,
    Reader,
    TouchPictures,
    blocks,
    exported_samples,
    new_file,
    touch_side,
    wall_offset_ns,
)
from dextouch.bridges.formats import FILE_SIGNATURES
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
from dextouch.geometry import distortion_of
from dextouch.images import encode_jpeg
from dextouch.schemas import EpisodeAttributes, RecordingAttributes, first_problems, json_ready
from dextouch.streams import ENCODED_UNITS, StreamDescriptor, encoded_values

PROFILE: Final = "dextouch"
# Files of version 1 have joints and actions as arrays, and messages on the item's own clock.
BRIDGE_VERSION: Final = "2"
READ_VERSIONS: Final = ("1", BRIDGE_VERSION)
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
# Enough to watch. Chosen: 30 a second cost 16 % of the time of an export with small images.
TOUCH_IMAGE_HZ: Final = 10
TIME_OFFSET: Final = "time_offset_ns"
_INT64: Final = range(-(2**63), 2**63)
_WANTED = (Attachment, Channel, DataEnd, Message, Metadata, Schema)


def export_mcap(
    reader: Reader,
    path: Path,
    *,
    overwrite: bool = False,
    jpeg_quality: int | None = None,
    touch_images: bool = True,
) -> int:
    """Write one episode or recording as MCAP and return the number of messages.

    Times of messages are Unix time where `wall_offset_ns` knows it, otherwise the item's own;
    `publish_time` is the device's stamp where there is one. Encoded images are copied unchanged;
    `jpeg_quality` 1 … 100 encodes `rgb8` images as JPEG, which is lossy, None keeps raw pixels.
    `touch_images` adds pictures of touch, at most 10 a second of each hand, beside the numbers.

    Raises:
        ConflictError: the file exists, and is not to be overwritten.
        InvalidInputError: a quality outside 1 … 100.
        StorageError: the write failed.
    """
    if jpeg_quality is not None and not 1 <= jpeg_quality <= 100:
        raise InvalidInputError(f"JPEG quality: got {jpeg_quality}, expected 1 … 100")
    with new_file(path, overwrite=overwrite) as partial, partial.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        return _Export(reader, writer, jpeg_quality).run(touch_images=touch_images)


def has_wall_times(about: Attributes) -> bool:
    """Whether it is known when an item began, so that an export has Unix times."""
    return wall_offset_ns(about) is not None


# Log time, order of the channel among equal ones, publish time, counter and bytes of a message.
_Timed = tuple[int, int, int, int, bytes]


class _Export:
    def __init__(self, reader: Reader, writer: Writer, jpeg_quality: int | None) -> None:
        self._reader, self._writer, self._quality = reader, writer, jpeg_quality
        self._is_episode = isinstance(reader, EpisodeReader)
        self._sources = list(reader.attributes.streams)
        self._streams = [self._as_sent(stream) for stream in self._sources]
        self._counts = {s.name: len(exported_samples(reader, s.name)) for s in self._streams}
        self._clock, self._offset_ns = self._time()
        self._schema_ids: dict[str, int] = {}
        self._channel_ids: list[int] = []

    def _time(self) -> tuple[str, int]:
        """The clock of the messages' times, and what is added to the item's own to get them."""
        stamps = [self._reader.stamps_ns(name) for name, count in self._counts.items() if count]
        first_ns = min((int(one[0]) for one in stamps), default=0)
        last_ns = max((int(one[-1]) for one in stamps), default=0)
        offset_ns = wall_offset_ns(self._reader.attributes)
        # A clock that was never set, or is wrong by centuries, is none.
        if offset_ns is not None and 0 <= first_ns + offset_ns <= last_ns + offset_ns < 2**63:
            return "unix", offset_ns
        # MCAP's times cannot be negative.
        return "episode" if self._is_episode else "host", max(0, -first_ns)

    def _as_sent(self, stream: StreamDescriptor) -> StreamDescriptor:
        is_raw = stream.kind == "image" and stream.unit not in ENCODED_UNITS
        to_jpeg = self._quality is not None and is_raw and raw_encoding(stream) == "rgb8"
        return stream.model_copy(update={"unit": "jpeg"}) if to_jpeg else stream

    def run(self, *, touch_images: bool) -> int:
        self._writer.start(profile=PROFILE, library=f"dextouch {__version__}")
        self._write_about()
        channels = [self._open_pictures(s) if touch_images else None for s in self._sources]
        sources = [self._messages(*one) for one in enumerate(channels)]
        num_messages = self._write_calibrations()
        for log_time, order, publish_time, sequence, data in heapq.merge(*sources):
            channel = self._channel_ids[order]
            self._writer.add_message(channel, log_time, data, publish_time, sequence)
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
            "id": reader.item_id,
            "content_sha256": reader.content_sha256,
            "clock": self._clock,
            TIME_OFFSET: str(self._offset_ns),
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

    def _write_calibrations(self) -> int:
        """One message for each camera with a matrix and an image; returns their number."""
        known, count = self._calibration(), 0
        for stream in self._streams:
            camera = stream.name.removeprefix("camera_")
            K = known.get(f"K_{camera}")
            if stream.kind != "image" or K is None or not self._counts[stream.name]:
                continue
            log_time = int(self._reader.stamps_ns(stream.name)[0]) + self._offset_ns
            height_px, width_px = stream.shape[:2]
            data = calibration_message(
                np.array(K),
                distortion_of(known, camera),
                t_ns=log_time,
                frame=stream.frame or stream.name,
                shape_px=(height_px, width_px),
            )
            self._writer.add_message(
                channel_id=self._channel(f"/{stream.name}/calibration", CALIBRATION, {}),
                log_time=log_time,
                publish_time=log_time,
                data=data,
            )
            count += 1
        return count

    def _open_pictures(self, stream: StreamDescriptor) -> "_Pictures | None":
        """A channel for pictures of a tactile stream; None if it cannot be drawn."""
        if stream.kind != "tactile" or touch_side(stream) is None:
            return None
        pictures = TouchPictures(self._reader, stream)
        about = {"name": stream.name, "kind": "image", "dtype": "uint8", "unit": "rgb8"}
        picture = StreamDescriptor.model_validate(
            about | {"shape": pictures.shape, "nominal_rate_hz": TOUCH_IMAGE_HZ}
        )
        codec, order = MessageCodec(picture), len(self._channel_ids)
        shown = {"unit": stream.unit, "black": "0", "brightest": f"{pictures.full_scale:g}"}
        shown |= {"scale": "square root", "layout": stream.tactile_layout.name}
        self._channel_ids.append(self._channel(f"/{stream.name}/image", codec.message, shown))
        return _Pictures(pictures, codec, order)

    def _messages(self, order: int, pictures: "_Pictures | None") -> Iterator[_Timed]:
        stream = self._streams[order]
        codec = MessageCodec(stream)
        to_jpeg = stream.unit != self._sources[order].unit
        for block in blocks(self._reader, stream.name):
            drawn = {} if pictures is None else pictures.of(block)
            columns = (block.t_ns.tolist(), block.t_device_ns.tolist(), block.sequence.tolist())
            rows = zip(*columns, block.values, strict=True)
            for row, (t_ns, t_device_ns, number, value) in enumerate(rows):
                if to_jpeg:
                    value = encode_jpeg(value, quality=self._quality or 1)  # noqa: PLW2901
                log_time = t_ns + self._offset_ns
                sent = Sent(log_time, t_device_ns, number, value)
                publish_time = t_device_ns if t_device_ns >= 0 else log_time
                sequence = number & _SEQUENCE_BITS if number >= 0 else 0
                data = codec.encode(sent, with_device=not self._is_episode)
                yield log_time, order, publish_time, sequence, data
                if pictures is not None and row in drawn:
                    data = pictures.encode(drawn[row], log_time)
                    yield log_time, pictures.order, log_time, 0, data


class _Pictures:
    """Pictures of a tactile stream: of the first sample of each tenth of a second."""

    def __init__(self, pictures: TouchPictures, codec: MessageCodec, order: int) -> None:
        self._pictures, self._codec, self.order = pictures, codec, order
        self._last: int | None = None

    def of(self, block: Block) -> dict[int, np.ndarray]:
        """Pictures of some samples of a block, by their rows; blocks come in order."""
        bins = block.t_ns // (1_000_000_000 // TOUCH_IMAGE_HZ)
        before = bins[0] - 1 if self._last is None else self._last
        rows = np.flatnonzero(np.diff(bins, prepend=before))
        self._last = int(bins[-1])
        return dict(zip(rows.tolist(), self._pictures.draw(block.values[rows]), strict=True))

    def encode(self, picture: np.ndarray, t_ns: int) -> bytes:
        return self._codec.encode(Sent(t_ns, -1, -1, picture), with_device=False)


def import_mcap(path: Path, store: EpisodeStore) -> str:
    """Import an MCAP file of `export_mcap` into a store, under the id that it had; returns the id.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not an MCAP file, or not written by DexTouch.
        CorruptDataError: truncated or damaged; the store is unchanged.
        LimitExceededError: a record exceeds the size limit.
        ConflictError: the id is in the store already.
    """
    attributes, counts, version, offset_ns = _about(path)
    kind = kind_of(attributes)
    with store.writer(kind=kind, attributes=attributes) as writer:
        streams = {
            f"/{stream.name}": _Stream(
                MessageCodec(stream, named=version != "1"),
                writer,
                is_episode=kind == "episode",
                offset_ns=offset_ns,
            )
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


def _about(path: Path) -> tuple[Attributes, dict[str, int], str, int]:
    """Attributes, the number of samples of each stream, the version, and the times' offset."""
    kind, text, counts, version, offset_ns = "", None, {}, "", 0
    for record in records(path):
        if isinstance(record, Metadata) and record.name == ABOUT:
            version = record.metadata.get("bridge_version", "")
            if version not in READ_VERSIONS:
                raise StorageError(
                    f"{path}: got bridge version {version!r}, expected one of {READ_VERSIONS}; "
                    "read it with the release that wrote it"
                )
            offset_ns = _count(path, record.metadata.get(TIME_OFFSET, "0"), signed=True)
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
        return model.model_validate_json(text), counts, version, offset_ns
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: {ATTRIBUTES_FILE} is invalid ({first_problems(error)})"
        ) from error


def _count(path: Path, text: str, *, signed: bool = False) -> int:
    digits = text.removeprefix("-") if signed else text
    if not digits.isdecimal() or len(digits) > 19:
        raise CorruptDataError(f"{path}: its metadata say {text!r}, expected a whole number")
    return int(text)


class _Stream:
    """One stream of an import, with samples that are written together."""

    def __init__(
        self, codec: MessageCodec, writer: EpisodeWriter, *, is_episode: bool, offset_ns: int
    ) -> None:
        self.codec, self._writer, self._is_episode = codec, writer, is_episode
        self._offset_ns = offset_ns
        self.num_samples = self._num_bytes = 0
        self._sent: list[Sent] = []

    def add(self, data: bytes) -> None:
        sent = self.codec.decode(data)
        t_ns = sent.t_ns - self._offset_ns
        if t_ns not in _INT64:
            raise CorruptDataError(
                f"{self.codec.descriptor.name}: got a message of {t_ns} ns, expected 64 bits"
            )
        self._sent.append(replace(sent, t_ns=t_ns))
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
        if file.read(len(FILE_SIGNATURES["mcap"])) != FILE_SIGNATURES["mcap"]:
            raise InvalidInputError(f"{path}: is not an MCAP file (wrong magic bytes)")
        file.seek(0)
        try:
            yield from _records(file, path)
        except EOFError as error:
            raise CorruptDataError(
                f"{path}: is truncated ({error}); copy it again, or see what `mcap recover` saves"
            ) from error
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
            yield from _inside(_opened(record, path))
        elif isinstance(record, _WANTED):
            yield record


def _inside(chunk: Chunk) -> Iterator[McapRecord]:
    """Records of an unpacked chunk, one at a time: a list of them takes many times its bytes."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        opcode, length = stream.read1(), stream.read8()
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


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
