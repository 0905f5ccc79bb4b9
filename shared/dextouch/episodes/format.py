"""Episode formats v3 and v2: file names, Zarr v3 metadata and the commit record."""

import hashlib
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Annotated, Any, Final, Generic, Literal, TypeVar, get_args

from pydantic import BaseModel, Field, ValidationError

from dextouch.errors import CorruptDataError, InvalidInputError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import ID_PATTERN, EpisodeAttributes, RecordingAttributes, StreamContent
from dextouch.streams import H264_UNIT, JPEG_UNIT, StreamDescriptor

Kind = Literal["episode", "recording"]
KINDS: tuple[Kind, ...] = ("episode", "recording")
# How a storage chunk is encoded; `jpeg` and `h264` are those of format v2.
Codec = Literal["zstd", "bytes", "jpeg", "h264"]
Version = Literal[2, 3]
ImageCodec = Literal["jpeg", "h264"]
Attributes = EpisodeAttributes | RecordingAttributes
ATTRIBUTES: Mapping[Kind, type[EpisodeAttributes] | type[RecordingAttributes]] = {
    "episode": EpisodeAttributes,
    "recording": RecordingAttributes,
}
# What parsing foreign JSON raises; the ValidationError of pydantic is a ValueError.
MALFORMED = (ValueError, KeyError, TypeError, RecursionError)
M = TypeVar("M", bound=FrozenModel)
FORMAT_VERSION: Final = 3
COMMIT_FILE = "commit.json"
METADATA_FILE = "zarr.json"
ATTRIBUTES_KEY = "dextouch"
# Maximum size of a numeric storage chunk, which otherwise holds half a second of samples.
CHUNK_SECONDS = 0.5
CHUNK_BYTES = 1 << 20
ZSTD_LEVEL = 1
# Smallest and largest storage chunk of encoded images, which lie end to end in an array of bytes.
IMAGE_CHUNK_BYTES = (1 << 12, 1 << 16)
# Columns of the index of encoded images.
INDEX_COLUMNS = ("first byte", "end byte", "crc32c")
_IMAGE_CODECS: Mapping[str, ImageCodec] = {JPEG_UNIT: "jpeg", H264_UNIT: "h264"}
# Images per closed group of pictures.
GOP_IMAGES = 8
# Images that are decoded independently of all others.
GROUP_IMAGES: Mapping[ImageCodec, int] = {"jpeg": 1, "h264": GOP_IMAGES}
# Names under which zarr-python finds the image codecs of v2 (dextouch.episodes.zarr_codecs).
ZARR_CODECS: Mapping[Codec, str] = {"jpeg": "dextouch.jpeg", "h264": "dextouch.h264"}
# Units by which xarray takes numbers for times (CF conventions), and converts them.
_CF_TIMES = ("days", "hours", "minutes", "seconds", "milliseconds", "microseconds", "nanoseconds")
# Far above any real array; a forged one must not overflow later arithmetic.
MAX_ROWS = 1 << 40
# Of an id that gets a number: room for that.
MAX_STEM = 112
Size = Annotated[int, Field(ge=0, le=MAX_ROWS)]
STAMPS: Mapping[Kind, tuple[str, ...]] = {
    "episode": ("t_ref_ns",),
    "recording": ("t_host_ns", "t_device_ns", "sequence"),
}
_STAMP_ATTRIBUTES: Mapping[str, dict[str, str]] = {
    "t_ref_ns": {"long_name": "time on the reference clock", "units": "ns"},
    "t_host_ns": {"long_name": "arrival time on the clock of the station", "units": "ns"},
    "t_device_ns": {"long_name": "time on the clock of the device, -1 if unknown", "units": "ns"},
    "sequence": {"long_name": "number that the device gave the sample, -1 if unknown"},
}


class ArrayEntry(FrozenModel):
    """Entry of one array in the commit record.

    `sha256` covers the decoded bytes; for encoded images their groups (`pack_group`) end to end.
    `encoder` names the encoder of the images and its settings. `crc32c` are the checksums of the
    storage chunks, as base64 of u32, so that those of another array of the same size are refused;
    it is absent in v2 and of encoded images, whose checksums are in their index.
    """

    dtype: Literal["uint8", "uint16", "int64", "float32", "float64"]
    shape: tuple[Size, ...] = Field(min_length=1)
    chunk_rows: int = Field(ge=1, le=MAX_ROWS)
    codec: Codec = "zstd"
    encoder: str | None = None
    dimension_names: tuple[str, ...]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    crc32c: str | None = None
    attributes: dict[str, str] = Field(default={})


class CommitRecord(FrozenModel):
    """Manifest of an episode or a recording; without it the group is not committed."""

    format_version: Version = FORMAT_VERSION
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


@cache
def _metadata_model(model: type[M]) -> type[_GroupMetadata[M]]:
    # Pydantic forgets such classes, and making one takes longer than reading an item.
    return _GroupMetadata[model]  # type: ignore[valid-type]


def group_attributes(metadata: bytes, model: type[M]) -> M:
    """Inverse of `group_metadata`; raises MALFORMED."""
    # One pass over the text: most of it is calibration, 60 kB an item.
    return _metadata_model(model).model_validate_json(metadata).attributes.dextouch


def with_rows(entry: ArrayEntry, num_rows: int) -> ArrayEntry:
    """A copy of the entry with another number of rows."""
    return entry.model_copy(update={"shape": (num_rows, *entry.shape[1:])})


def image_codec(descriptor: StreamDescriptor) -> ImageCodec | None:
    """Codec of a stream's encoded images, by its unit; None of numbers and raw images.

    There is no default for images: who makes the stream (a driver, the twin, an import) names it.
    """
    return _IMAGE_CODECS.get(descriptor.unit)


def index_name(stream: str) -> str:
    """Name of the array with the index of a stream's encoded images."""
    return f"{stream}_index"


def stream_arrays(
    descriptor: StreamDescriptor, kind: Kind, version: Version = FORMAT_VERSION
) -> dict[str, ArrayEntry]:
    """The empty arrays of a stream in a group, values first."""
    name, codec = descriptor.name, image_codec(descriptor)
    half_second = max(1, round(descriptor.nominal_rate_hz * CHUNK_SECONDS))
    rows = min(half_second, max(1, CHUNK_BYTES // descriptor.sample_bytes()))
    # A whole number of the values' storage chunks.
    stamp_rows = half_second // rows * rows if codec is None else GOP_IMAGES
    # xarray takes an array that has the name of its dimension for its coordinate.
    time = f"{name}_time" if version == 2 else f"{name}_{STAMPS[kind][0]}"
    axes = (f"{name}_axis{axis}" for axis in range(1, 1 + len(descriptor.shape)))
    values = ArrayEntry(
        dtype=descriptor.dtype,
        shape=(0, *descriptor.shape),
        chunk_rows=rows if codec is None else GROUP_IMAGES[codec],
        codec=codec or "zstd",
        dimension_names=(time, *axes),
        sha256="0" * 64,
    )
    column = ArrayEntry(
        dtype="int64", shape=(0,), chunk_rows=stamp_rows, dimension_names=(time,), sha256="0" * 64
    )
    stamps = {f"{name}_{stamp}": column for stamp in STAMPS[kind]}
    if version == 2:
        return {name: values} | stamps
    stamps = {
        f"{name}_{stamp}": _described(column, **_STAMP_ATTRIBUTES[stamp]) for stamp in STAMPS[kind]
    }
    if codec is not None:
        return image_arrays(descriptor, codec, column) | stamps
    about = {"long_name": name.replace("_", " ")}
    if descriptor.unit not in _CF_TIMES and " since " not in descriptor.unit:
        about["units"] = descriptor.unit
    if others := " ".join(f"{name}_{stamp}" for stamp in STAMPS[kind][1:]):
        about["coordinates"] = others
    return {name: _described(values, **about)} | stamps


def image_chunk_bytes(descriptor: StreamDescriptor) -> int:
    """Bytes of a storage chunk of encoded images: a power of two, about an H.264 image or more.

    The last one of a file is filled up, so that small images have small ones.
    """
    least, most = IMAGE_CHUNK_BYTES
    height, width, _ = descriptor.shape
    return min(most, max(least, 1 << (height * width // 8).bit_length() - 1))


def image_arrays(
    descriptor: StreamDescriptor, codec: ImageCodec, column: ArrayEntry
) -> dict[str, ArrayEntry]:
    """Encoded images in v3: end to end in an array of bytes, and the index of the images."""
    name, (height, width, _) = descriptor.name, descriptor.shape
    title = f"{height} x {width} images of {name.replace('_', ' ')}, encoded as {codec}, end to end"
    data = ArrayEntry(
        dtype="uint8",
        shape=(0,),
        chunk_rows=image_chunk_bytes(descriptor),
        codec="bytes",
        dimension_names=(f"{name}_byte",),
        sha256=column.sha256,
        attributes={"long_name": title, "encoding": codec, "index": index_name(name)},
    )
    index = column.model_copy(
        update={
            "shape": (0, len(INDEX_COLUMNS)),
            "dimension_names": (*column.dimension_names, f"{name}_index_column"),
        }
    )
    title = f"{', '.join(INDEX_COLUMNS)} of each image in {name}"
    return {name: data, index_name(name): _described(index, long_name=title)}


def _described(entry: ArrayEntry, **attributes: str) -> ArrayEntry:
    return entry.model_copy(update={"attributes": attributes})


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


def group_metadata(
    attributes: Mapping[str, Any], arrays: Mapping[str, ArrayEntry] | None = None
) -> bytes:
    """`zarr.json` of the group: attributes under one key, and the metadata of all arrays (v3).

    These are consolidated as zarr-python does it, so that readers need not list the group.
    """
    plain = {"zarr_format": 3, "node_type": "group", "attributes": {ATTRIBUTES_KEY: attributes}}
    if arrays is not None:
        plain["consolidated_metadata"] = {
            "kind": "inline",
            "must_understand": False,
            "metadata": {name: _array_plain(entry) for name, entry in arrays.items()},
        }
    return canonical_json(plain)


def version_of_group(metadata: bytes) -> Version:
    """Format version of a group without a commit record, by its `zarr.json`; raises MALFORMED."""
    return 3 if "consolidated_metadata" in json.loads(metadata) else 2


def array_metadata(entry: ArrayEntry) -> bytes:
    """`zarr.json` of an array: one shard of storage chunks."""
    return canonical_json(_array_plain(entry))


def _array_plain(entry: ArrayEntry) -> dict[str, Any]:
    rows = entry.chunk_rows
    shard_rows = max(1, -(-entry.shape[0] // rows)) * rows
    row_shape = list(entry.shape[1:])
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    compress = {"name": "zstd", "configuration": {"level": ZSTD_LEVEL, "checksum": False}}
    checksum = {"name": "crc32c"}
    plain = {"name": "bytes"} if entry.dtype == "uint8" else little
    packs = {"zstd": [plain, compress], "bytes": [plain]}
    pack = packs.get(entry.codec) or [{"name": ZARR_CODECS[entry.codec]}]
    sharding = {
        "chunk_shape": [rows, *row_shape],
        "codecs": [*pack, checksum],
        "index_codecs": [little, checksum],
        "index_location": "end",
    }
    encoder = {} if entry.encoder is None else {"encoder": entry.encoder}
    return {
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
        "attributes": entry.attributes | encoder,
        "dimension_names": list(entry.dimension_names),
    }


def shard_path(num_dimensions: int) -> str:
    """Path of an array's single shard file, relative to the array's folder."""
    return "/".join(["c", *(["0"] * num_dimensions)])


def array_files(arrays: Mapping[str, "ArrayEntry"]) -> set[str]:
    """Paths of all files of arrays, relative to their group."""
    return {
        f"{name}/{file}"
        for name, entry in arrays.items()
        for file in (METADATA_FILE, shard_path(len(entry.shape)))
    }


def numbered_ids(item_id: str, word: str) -> Iterator[str]:
    """Ids `ID-WORD-1`, `ID-WORD-2` and so on, of a long id with its beginning."""
    return (f"{item_id[:MAX_STEM]}-{word}-{number}" for number in itertools.count(1))


def encode_commit(record: CommitRecord) -> tuple[bytes, str]:
    """Bytes of `commit.json` and the record's sha256, which is the content hash of the group."""
    plain = record.model_dump(mode="json")
    digest = sha256_hex(canonical_json(plain))
    return canonical_json({"record": plain, "sha256": digest}), digest


def stated_sha256(commit: bytes | None) -> str | None:
    """The content hash that a commit record states of itself; None if it is damaged."""
    try:
        outer = json.loads(commit or b"")
    except MALFORMED:
        return None
    found = outer.get("sha256") if isinstance(outer, dict) else None
    return found if isinstance(found, str) else None


def decode_commit(data: bytes, *, what: str) -> tuple[CommitRecord, str]:
    """Inverse of `encode_commit`; raises CorruptDataError, or StorageError for another version."""
    found = re.fullmatch(rb'\{"record":(\{.*\}),"sha256":"([0-9a-f]{64})"\}', data, re.DOTALL)
    if found and sha256_hex(found[1]) == found[2].decode():
        # As we write it, so that the record need not be brought into its canonical form.
        with suppress(ValidationError):
            return CommitRecord.model_validate_json(found[1]), found[2].decode()
    try:
        outer = json.loads(data)
        plain, digest = outer["record"], outer["sha256"]
        version = plain["format_version"]
        whole = sha256_hex(canonical_json(plain)) == digest
    except MALFORMED as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is damaged ({error})") from error
    if not whole:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} does not match its own sha256")
    if version not in get_args(Version):
        raise StorageError(
            f"{what}: {COMMIT_FILE} has format version {version!r}, expected 2 or 3; "
            "read it with the release that wrote it",
            format_version=version,
        )
    try:
        return CommitRecord.model_validate(plain), digest
    except ValidationError as error:
        raise CorruptDataError(f"{what}: {COMMIT_FILE} is not a commit record ({error})") from error
