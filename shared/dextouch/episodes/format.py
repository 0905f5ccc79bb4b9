"""Episode format v2: file names, Zarr v3 metadata and the commit record."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final, Generic, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError

from dextouch.errors import CorruptDataError, InvalidInputError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ID_PATTERN, EpisodeAttributes, RecordingAttributes, StreamContent
from dextouch.streams import H264_UNIT, JPEG_UNIT, StreamDescriptor

Kind = Literal["episode", "recording"]
KINDS: tuple[Kind, ...] = ("episode", "recording")
Codec = Literal["zstd", "jpeg", "h264"]
Attributes = EpisodeAttributes | RecordingAttributes
ATTRIBUTES: Mapping[Kind, type[EpisodeAttributes] | type[RecordingAttributes]] = {
    "episode": EpisodeAttributes,
    "recording": RecordingAttributes,
}
# What parsing foreign JSON raises; the ValidationError of pydantic is a ValueError.
MALFORMED = (ValueError, KeyError, TypeError, RecursionError)
M = TypeVar("M", bound=FrozenModel)
FORMAT_VERSION: Final = 2
COMMIT_FILE = "commit.json"
METADATA_FILE = "zarr.json"
ATTRIBUTES_KEY = "dextouch"
# Maximum size of a numeric storage chunk, which otherwise holds half a second of samples.
CHUNK_SECONDS = 0.5
CHUNK_BYTES = 1 << 20
ZSTD_LEVEL = 1
# Images per closed group of pictures, which is one storage chunk.
GOP_IMAGES = 8
# Names under which zarr-python finds the image codecs (dextouch.episodes.zarr_codecs).
ZARR_CODECS: Mapping[Codec, str] = {"jpeg": "dextouch.jpeg", "h264": "dextouch.h264"}
# Far above any real array; a forged one must not overflow later arithmetic.
MAX_ROWS = 1 << 40
Size = Annotated[int, Field(ge=0, le=MAX_ROWS)]
STAMPS: Mapping[Kind, tuple[str, ...]] = {
    "episode": ("t_ref_ns",),
    "recording": ("t_host_ns", "t_device_ns", "sequence"),
}


class ArrayEntry(FrozenModel):
    """Entry of one array in the commit record.

    `sha256` covers the decoded bytes; for image codecs, the concatenated encoded storage chunks.
    `encoder` names the encoder of the images and its settings.
    """

    dtype: Literal["uint8", "uint16", "int64", "float32", "float64"]
    shape: tuple[Size, ...] = Field(min_length=1)
    chunk_rows: int = Field(ge=1, le=MAX_ROWS)
    codec: Codec = "zstd"
    encoder: str | None = None
    dimension_names: tuple[str, ...]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class CommitRecord(FrozenModel):
    """Manifest of an episode or a recording; without it the group is not committed."""

    format_version: Literal[2] = FORMAT_VERSION
    kind: Kind
    id: str
    attributes_sha256: str
    arrays: dict[str, ArrayEntry]


class _GroupAttributes(BaseModel, Generic[M]):
    dextouch: M


class _GroupMetadata(BaseModel, Generic[M]):
    """`zarr.json` of a group; what other programs put beside our attributes is ignored."""

    attributes: _GroupAttributes[M]


def check_id(text: str, *, kind: str = "id") -> str:
    """Validate and return an id: lower-case letters, digits, `-` and `_`.

    Raises InvalidInputError for any other character, including path separators and dots.
    """
    if not re.fullmatch(ID_PATTERN, text):
        raise InvalidInputError(
            f"{kind}: got {text!r}, expected 1 … 128 characters of a-z 0-9 - _, "
            "the first a letter or digit"
        )
    return text


def attributes_id(attributes: Attributes) -> str:
    """The episode or recording id of attributes."""
    if isinstance(attributes, EpisodeAttributes):
        return attributes.episode_id
    return attributes.recording_id


def kind_of(attributes: Attributes) -> Kind:
    """The kind of group that attributes describe."""
    return "episode" if isinstance(attributes, EpisodeAttributes) else "recording"


def group_attributes(metadata: bytes, model: type[M]) -> M:
    """Inverse of `group_metadata`; raises MALFORMED."""
    # One pass over the text: most of it is calibration, 60 kB an item.
    return _GroupMetadata[model].model_validate_json(metadata).attributes.dextouch  # type: ignore[valid-type]


def with_rows(entry: ArrayEntry, num_rows: int) -> ArrayEntry:
    """A copy of the entry with another number of rows."""
    return entry.model_copy(update={"shape": (num_rows, *entry.shape[1:])})


def codec_of(descriptor: StreamDescriptor) -> Codec:
    """Codec of a stream's values, by its unit.

    There is no default for images: who makes the stream (a driver, the twin, an import) names it.
    """
    units: Mapping[str, Codec] = {JPEG_UNIT: "jpeg", H264_UNIT: "h264"}
    return units.get(descriptor.unit, "zstd")


def stream_arrays(descriptor: StreamDescriptor, kind: Kind) -> dict[str, ArrayEntry]:
    """The empty arrays of a stream in a group, values first."""
    name, codec = descriptor.name, codec_of(descriptor)
    half_second = max(1, round(descriptor.nominal_rate_hz * CHUNK_SECONDS))
    rows = min(half_second, max(1, CHUNK_BYTES // descriptor.sample_bytes()))
    # A whole number of the values' storage chunks.
    stamp_rows = half_second // rows * rows if codec == "zstd" else GOP_IMAGES
    time, no_hash = f"{name}_time", "0" * 64
    axes = (f"{name}_axis{axis}" for axis in range(1, 1 + len(descriptor.shape)))
    values = ArrayEntry(
        dtype=descriptor.dtype,
        shape=(0, *descriptor.shape),
        chunk_rows={"zstd": rows, "jpeg": 1, "h264": GOP_IMAGES}[codec],
        codec=codec,
        dimension_names=(time, *axes),
        sha256=no_hash,
    )
    stamps = ArrayEntry(
        dtype="int64", shape=(0,), chunk_rows=stamp_rows, dimension_names=(time,), sha256=no_hash
    )
    return {name: values} | {f"{name}_{stamp}": stamps for stamp in STAMPS[kind]}


def stream_content(num_samples: int, digests: Iterable[str]) -> StreamContent:
    """Digest of a stream of a recording, from the sha256 of its arrays."""
    return StreamContent(num_samples=num_samples, sha256=sha256_hex(" ".join(digests).encode()))


def canonical_json(value: object) -> bytes:
    """JSON with sorted keys and no spaces: equal values give equal bytes."""
    text = json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return text.encode()


def sha256_hex(data: bytes) -> str:
    """Hexadecimal sha256."""
    return hashlib.sha256(data).hexdigest()


def group_metadata(attributes: Mapping[str, Any]) -> bytes:
    """`zarr.json` of the group, with the attributes under one key."""
    return canonical_json(
        {"zarr_format": 3, "node_type": "group", "attributes": {ATTRIBUTES_KEY: attributes}}
    )


def array_metadata(entry: ArrayEntry) -> bytes:
    """`zarr.json` of an array: one shard of storage chunks."""
    rows = entry.chunk_rows
    shard_rows = max(1, -(-entry.shape[0] // rows)) * rows
    row_shape = list(entry.shape[1:])
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    compress = {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}
    checksum = {"name": "crc32c"}
    plain = {"name": "bytes"} if entry.dtype == "uint8" else little
    pack = [plain, compress] if entry.codec == "zstd" else [{"name": ZARR_CODECS[entry.codec]}]
    sharding = {
        "chunk_shape": [rows, *row_shape],
        "codecs": [*pack, checksum],
        "index_codecs": [little, checksum],
        "index_location": "end",
    }
    return canonical_json(
        {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(entry.shape),
            "data_type": entry.dtype,
            "chunk_grid": {
                "name": "regular",
                "configuration": {"chunk_shape": [shard_rows, *row_shape]},
            },
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": 0,
            "codecs": [{"name": "sharding_indexed", "configuration": sharding}],
            "attributes": {} if entry.encoder is None else {"encoder": entry.encoder},
            "dimension_names": list(entry.dimension_names),
        }
    )


def shard_path(num_dimensions: int) -> str:
    """Path of an array's single shard file, relative to the array's folder."""
    return "/".join(["c", *(["0"] * num_dimensions)])


def encode_commit(record: CommitRecord) -> tuple[bytes, str]:
    """Bytes of `commit.json` and the record's sha256, which is the content hash of the group."""
    plain = record.model_dump(mode="json")
    digest = sha256_hex(canonical_json(plain))
    return canonical_json({"record": plain, "sha256": digest}), digest


def decode_commit(data: bytes, *, what: str) -> tuple[CommitRecord, str]:
    """Inverse of `encode_commit`; raises CorruptDataError, or StorageError for another version."""
    try:
        outer = json.loads(data)
        plain, digest = outer["record"], outer["sha256"]
        version = plain["format_version"]
        whole = sha256_hex(canonical_json(plain)) == digest
    except MALFORMED as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is damaged ({error})") from error
    if not whole:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} does not match its own sha256")
    if version != FORMAT_VERSION:
        raise StorageError(
            f"{what}: {COMMIT_FILE} has format version {version!r}, expected {FORMAT_VERSION}; "
            "read it with the release that wrote it",
            format_version=version,
        )
    try:
        return CommitRecord.model_validate(plain), digest
    except ValidationError as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is not a commit record ({error})") from error
