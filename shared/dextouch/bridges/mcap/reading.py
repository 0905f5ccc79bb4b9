"""Import of MCAP files written by `export_mcap`, without loss."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from pydantic import ValidationError

from dextouch.bridges.mcap.messages import MessageCodec, Sent
from dextouch.bridges.mcap.records import records
from dextouch.bridges.mcap.writing import ABOUT, ATTRIBUTES_FILE, BRIDGE_VERSION, COUNTS
from dextouch.episodes import EpisodeStore, EpisodeWriter, WriteOptions
from dextouch.errors import CorruptDataError, InvalidInputError, StorageError
from dextouch.schemas import EpisodeAttributes, RecordingAttributes
from dextouch.streams import ENCODED_UNITS, encoded_values

MAX_ATTRIBUTES_BYTES: Final = 1 << 24
_BLOCK_BYTES: Final = 1 << 24


Attributes = EpisodeAttributes | RecordingAttributes


def import_mcap(path: Path, store: EpisodeStore) -> str:
    """Import an MCAP file written by `export_mcap` into a store.

    Args:
        path: of the file; it may come from anywhere.
        store: where the episode or recording appears under the id that it had.

    Returns:
        The id.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not an MCAP file, or not written by DexTouch.
        CorruptDataError: truncated or damaged; the store is unchanged.
        LimitExceededError: a record exceeds the size limit.
        ConflictError: the id is in the store already.
    """
    attributes, counts = _about(path)
    if attributes is None:
        raise InvalidInputError(
            f"{path}: holds no attachment {ATTRIBUTES_FILE!r} of DexTouch; only files that "
            "`dextouch export --format mcap` wrote can be imported"
        )
    if isinstance(attributes, EpisodeAttributes):
        with store.writer(attributes=attributes) as writer:
            _Import(path, attributes, writer).run(counts)
        return attributes.episode_id
    # A killed import is repeated from its file; a partial one must not look like a recovered take.
    options = WriteOptions(recoverable=False)
    with store.writer(kind="recording", attributes=attributes, options=options) as writer:
        _Import(path, attributes, writer).run(counts)
    return attributes.recording_id


def _about(path: Path) -> tuple[Attributes | None, dict[str, int]]:
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
        return None, counts
    return _attributes(path, kind, text), counts


def _count(path: Path, text: str) -> int:
    if not text.isdecimal() or len(text) > 18:
        raise CorruptDataError(f"{path}: metadata {COUNTS!r} says {text!r}, expected a number")
    return int(text)


def _attributes(path: Path, kind: str, text: bytes) -> Attributes:
    if len(text) > MAX_ATTRIBUTES_BYTES:
        raise CorruptDataError(f"{path}: {ATTRIBUTES_FILE} has {len(text)} bytes")
    try:
        if kind == "episode":
            return EpisodeAttributes.model_validate_json(text)
        return RecordingAttributes.model_validate_json(text)
    except ValidationError as error:
        raise CorruptDataError(f"{path}: {ATTRIBUTES_FILE} is invalid ({error})") from error


class _Pending:
    """Buffered samples of one stream, written together."""

    def __init__(self, codec: MessageCodec, writer: EpisodeWriter, *, is_episode: bool) -> None:
        self.codec, self._writer, self._is_episode = codec, writer, is_episode
        self.num_samples = 0
        self._sent: list[Sent] = []
        self._num_bytes = 0

    def add(self, data: bytes) -> None:
        """Add one message."""
        self._sent.append(self.codec.decode(data))
        self.num_samples += 1
        self._num_bytes += len(data)
        if self._num_bytes >= _BLOCK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the buffered samples."""
        sent, descriptor = self._sent, self.codec.descriptor
        self._sent, self._num_bytes = [], 0
        if not sent:
            return
        if descriptor.unit in ENCODED_UNITS:
            values = encoded_values([s.value for s in sent if isinstance(s.value, bytes)])
        else:
            values = np.stack([np.asarray(s.value) for s in sent])
        t_ns = np.array([s.t_ns for s in sent], dtype=np.int64)
        if self._is_episode:
            self._writer.append(descriptor.name, values=values, t_ref_ns=t_ns)
            return
        self._writer.append(
            descriptor.name,
            values=values,
            t_host_ns=t_ns,
            t_device_ns=np.array([s.t_device_ns for s in sent], dtype=np.int64),
            sequence=np.array([s.sequence for s in sent], dtype=np.int64),
        )


class _Import:
    """Import of one file into a writer."""

    def __init__(self, path: Path, attributes: Attributes, writer: EpisodeWriter) -> None:
        self._path = path
        is_episode = isinstance(attributes, EpisodeAttributes)
        self._pending = {
            f"/{stream.name}": _Pending(MessageCodec(stream), writer, is_episode=is_episode)
            for stream in attributes.streams
        }
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, _Pending | None] = {}

    def run(self, counts: Mapping[str, int]) -> None:
        """Read all messages, then check the number of samples of each stream."""
        for record in records(self._path):
            self._take(record)
        for topic, pending in self._pending.items():
            pending.flush()
            expected = counts.get(pending.codec.descriptor.name)
            if pending.num_samples != expected:
                raise CorruptDataError(
                    f"{self._path}: {topic} holds {pending.num_samples} messages, expected "
                    f"{expected}; the file was cut or filtered after the export"
                )

    def _take(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = self._known(record)
        elif isinstance(record, Message):
            if record.channel_id not in self._channels:
                raise CorruptDataError(
                    f"{self._path}: a message of channel {record.channel_id}, which does not exist"
                )
            pending = self._channels[record.channel_id]
            if pending is not None:
                pending.add(record.data)

    def _known(self, channel: Channel) -> _Pending | None:
        """The stream of a channel; None for channels added by other tools."""
        pending = self._pending.get(channel.topic)
        if pending is None:
            return None
        schema = self._schemas.get(channel.schema_id)
        name = schema.name if schema else None
        if (channel.message_encoding, name) != ("protobuf", pending.codec.message):
            raise CorruptDataError(
                f"{self._path}: {channel.topic} has messages {channel.message_encoding!r} "
                f"{name!r}, expected 'protobuf' {pending.codec.message!r}"
            )
        return pending
