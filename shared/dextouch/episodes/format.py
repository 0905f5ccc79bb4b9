"""Episode format v1: names of files, Zarr v3 metadata, and the commit record that makes it true."""

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dextouch.errors import CorruptDataError, InvalidInputError, StorageError
from dextouch.schemas.episodes import FORMAT_VERSION, ID_PATTERN
from dextouch.streams.checks import JPEG_UNIT
from dextouch.streams.descriptors import StreamDescriptor

Kind = Literal["episode", "recording"]
KINDS: tuple[Kind, ...] = ("episode", "recording")
COMMIT_FILE = "commit.json"
METADATA_FILE = "zarr.json"
ATTRIBUTES_KEY = "dextouch"
CHUNK_SECONDS = 0.5
ZSTD_LEVEL = 1
# JPEG bytes lie end to end in one array; its storage chunks are only the unit of checksums.
JPEG_CHUNK_BYTES = 1 << 16
JPEG_END_SUFFIX = "_end"
STAMPS: Mapping[Kind, tuple[str, ...]] = {
    "episode": ("t_ref_ns",),
    "recording": ("t_host_ns", "t_device_ns", "sequence"),
}


class ArrayEntry(BaseModel):
    """What the commit record says about one array; `sha256` is that of its decoded bytes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    dtype: Literal["uint8", "uint16", "int64", "float32", "float64"]
    shape: tuple[int, ...] = Field(min_length=1)
    chunk_rows: int = Field(ge=1)
    dimension_names: tuple[str, ...]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class CommitRecord(BaseModel):
    """The list of all that belongs to an episode or a recording; without it there is none."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: Literal[1] = FORMAT_VERSION
    kind: Kind
    id: str
    attributes_sha256: str
    arrays: dict[str, ArrayEntry]


def check_id(text: str, *, kind: str = "id") -> str:
    """The id itself, if it is one: lower-case letters, digits, `-` and `_`.

    Raises:
        InvalidInputError: anything else, path separators and dots included.
    """
    if not re.fullmatch(ID_PATTERN, text):
        raise InvalidInputError(
            f"{kind}: got {text!r}, expected 1 … 128 characters of a-z 0-9 - _, "
            "the first a letter or digit"
        )
    return text


def chunk_rows(descriptor: StreamDescriptor) -> int:
    """Samples a storage chunk: half a second."""
    return max(1, round(descriptor.nominal_rate_hz * CHUNK_SECONDS))


def array_names(descriptor: StreamDescriptor, kind: Kind) -> tuple[str, ...]:
    """Every array a stream occupies in a group."""
    suffixes = [f"_{stamp}" for stamp in STAMPS[kind]]
    if descriptor.unit == JPEG_UNIT:
        suffixes.append(JPEG_END_SUFFIX)
    return (descriptor.name, *(descriptor.name + suffix for suffix in suffixes))


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
    sharding = {
        "chunk_shape": [rows, *row_shape],
        "codecs": [plain, compress, checksum],
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
            "attributes": {},
            "dimension_names": list(entry.dimension_names),
        }
    )


def shard_path(num_dimensions: int) -> str:
    """The one shard file of an array, below the array's folder."""
    return "/".join(["c", *(["0"] * num_dimensions)])


def encode_commit(record: CommitRecord) -> tuple[bytes, str]:
    """Bytes of `commit.json`, and the record's sha256: the content hash of the whole."""
    plain = record.model_dump(mode="json")
    digest = sha256_hex(canonical_json(plain))
    return canonical_json({"record": plain, "sha256": digest}), digest


def decode_commit(data: bytes, *, what: str) -> tuple[CommitRecord, str]:
    """Inverse of `encode_commit`.

    Raises:
        StorageError: written by a newer version of the format.
        CorruptDataError: anything else that is no commit record.
    """
    try:
        outer = json.loads(data)
        plain, digest = outer["record"], outer["sha256"]
        version = plain["format_version"]
        whole = sha256_hex(canonical_json(plain)) == digest
    except (ValueError, KeyError, TypeError) as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is damaged ({error})") from error
    if not whole:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} does not match its own sha256")
    if version != FORMAT_VERSION:
        raise StorageError(
            f"{what}: got format version {version!r}, expected {FORMAT_VERSION}; "
            "read it with the release that wrote it"
        )
    try:
        return CommitRecord.model_validate(plain), digest
    except ValidationError as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is no commit record ({error})") from error
