"""Import of MCAP files written by `export_mcap`, without loss."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from pydantic import ValidationError

from dextouch.bridges.mcap.messages import MessageCodec, Sent
from dextouch.bridges.mcap.records import records
from dextouch.bridges.mcap.writing import ABOUT, ATTRIBUTES_FILE, BRIDGE_VERSION, COUNTS
from dextouch.episodes import EpisodeStore, EpisodeWriter, Kind, WriteOptions
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
    kind: Kind = "episode" if isinstance(attributes, EpisodeAttributes) else "recording"
    # A killed import is repeated from its file; a partial one must not look like a recovered take.
    options = WriteOptions(recoverable=False)
    with store.writer(kind=kind, attributes=attributes, options=options) as writer:
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
    if isinstance(attributes, EpisodeAttributes):
        return attributes.episode_id
    return attributes.recording_id


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
            f"{path}: holds no attachment {ATTRIBUTES_FILE!r} of DexTouch; only files that "
            "`dextouch export --format mcap` wrote can be imported"
        )
    if len(text) > MAX_ATTRIBUTES_BYTES:
        raise CorruptDataError(f"{path}: {ATTRIBUTES_FILE} has {len(text)} bytes")
    model = EpisodeAttributes if kind == "episode" else RecordingAttributes
    try:
        return model.model_validate_json(text), counts
    except ValidationError as error:
        raise CorruptDataError(f"{path}: {ATTRIBUTES_FILE} is invalid ({error})") from error


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
