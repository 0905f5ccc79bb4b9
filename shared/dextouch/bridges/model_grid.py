"""What importers and exporters share.

Importers write episodes whose streams have one row per step, as other formats hold them; exporters
iterate over samples in bounded memory, and write a file that appears whole.
"""

import os
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8

from dextouch.episodes import (
    GOP_IMAGES,
    EpisodeReader,
    EpisodeStore,
    EpisodeWriter,
    RecordingReader,
    disk_errors,
    is_keyframe,
)
from dextouch.errors import ConflictError
from dextouch.schemas import EpisodeAttributes
from dextouch.streams import (
    ENCODED_UNITS,
    H264_UNIT,
    NO_DEVICE_TIME,
    NO_SEQUENCE,
    StreamDescriptor,
    StreamKind,
    encoded_values,
)
from dextouch.tactile.layout import SIDES

ImageUnit = Literal["h264", "jpeg", "rgb8"]
BLOCK_IMAGES: Final = 32
Reader = EpisodeReader | RecordingReader
BLOCK_SECONDS: Final = 1.0


@dataclass(frozen=True)
class GridNumbers:
    """Values of a stream at the steps; `keep` says at which it has one (None: at all)."""

    kind: StreamKind
    unit: str
    values: Shaped[np.ndarray, "n ..."]
    keep: Bool[np.ndarray, " n"] | None = None


@dataclass(frozen=True)
class GridImages:
    """Images of a camera, one per step.

    Attributes:
        shape: [height, width, 3].
        t_ref_ns: of each image. A stamp that comes twice is one image, the nearest to two steps.
        read: decodes the images one by one.
        read_units: copies them as H.264 access units; None where that is not possible.
    """

    shape: tuple[int, ...]
    t_ref_ns: Int64[np.ndarray, " n"]
    read: Callable[[], Iterator[UInt8[np.ndarray, "h w 3"]]]
    read_units: Callable[[], list[bytes] | None]


@dataclass(frozen=True)
class GridEpisode:
    """An episode on the model grid: times of the steps, and streams by name."""

    t_ref_ns: Int64[np.ndarray, " n"]
    numbers: Mapping[str, GridNumbers]
    cameras: Mapping[str, GridImages]


def tactile_numbers(
    kpa: Float32[np.ndarray, "n 2 320"], valid: Bool[np.ndarray, "n 2"]
) -> dict[str, GridNumbers]:
    """The touch of the hands that were sensed at any step."""
    return {
        f"tactile_{side}": GridNumbers("tactile", "kPa", kpa[:, hand], keep=valid[:, hand])
        for hand, side in enumerate(SIDES)
        if valid[:, hand].any()
    }


def store_episode(
    store: EpisodeStore, attributes: EpisodeAttributes, episode: GridEpisode, images: ImageUnit
) -> None:
    """Write an episode into the store, atomically.

    Args:
        store: destination.
        attributes: of the episode, without streams; the model rate is that of the steps.
        episode: its streams.
        images: unit of the camera streams. Video that is H.264 in the store's groups already is
            copied into `h264` streams; everything else is decoded and encoded again.

    Raises:
        CorruptDataError: damaged images.
        ConflictError: the id exists.
        NonFiniteError: NaN or infinity among the numbers.
    """
    with store.writer(attributes=attributes) as writer:

        def add(name: str, **properties: object) -> None:
            known = {"name": name, "nominal_rate_hz": attributes.model_rate_hz, **properties}
            writer.add_stream(StreamDescriptor.model_validate(known))

        for name, found in episode.numbers.items():
            keep = slice(None) if found.keep is None else found.keep
            shape, dtype = found.values.shape[1:], str(found.values.dtype)
            add(name, kind=found.kind, shape=shape, dtype=dtype, unit=found.unit)
            writer.append(name, values=found.values[keep], t_ref_ns=episode.t_ref_ns[keep])
        for name, camera in episode.cameras.items():
            add(name, kind="image", shape=camera.shape, dtype="uint8", unit=images)
            _store_images(writer, name, camera, images)


def _store_images(writer: EpisodeWriter, name: str, camera: GridImages, unit: ImageUnit) -> None:
    fresh = np.diff(camera.t_ref_ns, prepend=camera.t_ref_ns[0] - 1) > 0
    units = camera.read_units() if unit == "h264" and fresh.all() else None
    # The store's video is in closed groups of pictures.
    if units and all(is_keyframe(u) == (k % GOP_IMAGES == 0) for k, u in enumerate(units)):
        writer.append(name, values=encoded_values(units), t_ref_ns=camera.t_ref_ns)
        return
    images = (image for image, wanted in zip(camera.read(), fresh, strict=True) if wanted)
    stamps = camera.t_ref_ns[fresh]
    for start in range(0, len(stamps), BLOCK_IMAGES):
        block = np.stack(list(islice(images, BLOCK_IMAGES)))
        writer.append(name, values=block, t_ref_ns=stamps[start : start + BLOCK_IMAGES])
    # Exhausts the reader, so that a file that is too short is refused.
    for _ in images:
        pass


@dataclass(frozen=True)
class Block:
    """Consecutive samples of one stream.

    `t_ns` is t_ref_ns of an episode or t_host_ns of a recording; `values` are rows of the stream,
    or for encoded images an object array of bytes.
    """

    t_ns: Int64[np.ndarray, " n"]
    t_device_ns: Int64[np.ndarray, " n"]
    sequence: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]

    def __len__(self) -> int:
        return len(self.t_ns)


def exported_samples(reader: Reader, name: str) -> Int64[np.ndarray, " kept"]:
    """Indices of a stream's samples without damaged images; of H.264 whole groups are left out."""
    damaged, unit = reader.damaged_images(name), reader.streams[name].unit
    indices = np.arange(reader.num_samples(name), dtype=np.int64)
    size = GOP_IMAGES if unit == H264_UNIT else 1
    return indices[np.isin(indices // size, damaged // size, invert=True)]


def blocks(reader: Reader, name: str) -> Iterator[Block]:
    """Iterate over a stream in order, about one second per block; encoded images stay encoded.

    Only `exported_samples` are among them.
    """
    descriptor, t_ns = reader.streams[name], reader.stamps_ns(name)
    t_device_ns, sequence = np.full_like(t_ns, NO_DEVICE_TIME), np.full_like(t_ns, NO_SEQUENCE)
    if isinstance(reader, RecordingReader):
        stamps = reader.stamps(name)
        t_device_ns, sequence = stamps.t_device_ns, stamps.sequence
    kept = np.isin(np.arange(len(t_ns)), exported_samples(reader, name))
    each = max(1, round(descriptor.nominal_rate_hz * BLOCK_SECONDS))
    for start in range(0, len(t_ns), each):
        stop = min(start + each, len(t_ns))
        if descriptor.unit in ENCODED_UNITS:
            values = encoded_values(reader.encoded_images(name, start, stop))
        else:
            values = reader.values(name, start, stop)
        part = np.flatnonzero(kept[start:stop])
        if len(part):
            rows = start + part
            yield Block(t_ns[rows], t_device_ns[rows], sequence[rows], values[part])


@contextmanager
def new_file(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """Context manager with a temporary path, renamed to `path` when the block succeeds.

    Args:
        path: of the finished file; its folder is created.
        overwrite: whether an existing file is replaced.

    Raises:
        ConflictError: `path` exists and `overwrite` is false.
        StorageError: the write failed.
    """
    if path.is_dir() or (path.exists() and not overwrite):
        raise ConflictError(
            f"{path}: exists already; choose another path"
            + ("" if path.is_dir() else " or allow overwriting (--force)")
        )
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    with disk_errors(f"write {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
