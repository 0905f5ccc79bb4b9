"""Storage designs under comparison, each of which writes a take and reads windows."""

import importlib.util
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import simplejpeg
from jaxtyping import Float32, UInt8, UInt16

from benchmarks.store.workload import (
    IMAGE_SHAPE,
    JPEG_QUALITY,
    WINDOW_IMAGES,
    WINDOW_TACTILE,
    TimedStream,
    Workload,
)
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.hands.actions import AnchorPoses
from dextouch.installation import install_command
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor, StreamKind


@dataclass(frozen=True)
class StoreWindow:
    """17 images of one camera with the touch and actions of the same interval."""

    images: UInt8[np.ndarray, "17 480 640 3"]
    tactile_left: UInt16[np.ndarray, "34 360"]
    tactile_right: UInt16[np.ndarray, "34 360"]
    actions: Float32[np.ndarray, "17 67"]


class OpenStore(ABC):
    """A written take, open for reading.

    `window` may be called concurrently for different cameras, never for the same one.
    """

    @abstractmethod
    def window(self, camera: str, start: int) -> StoreWindow:
        """The window that starts at image `start` of a camera; only that camera is decoded."""

    def windows(self, cameras: Sequence[str], start: int, *, threaded: bool) -> list[StoreWindow]:
        """The same span of several cameras, sequentially or in one thread each.

        A design may override it with a faster implementation.
        """
        if not threaded:
            return [self.window(camera, start) for camera in cameras]
        with ThreadPoolExecutor(len(cameras)) as threads:
            return list(threads.map(lambda camera: self.window(camera, start), cameras))


class StreamStore(OpenStore):
    """An open store whose streams are read one by one, so touch also without images."""

    @abstractmethod
    def images(self, camera: str, start: int) -> np.ndarray:
        """The images of a window."""

    @abstractmethod
    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        """Samples of a numeric stream."""

    def touch(self, start: int) -> tuple[np.ndarray, np.ndarray]:
        """34 samples of the left and of the right hand, those of the window at image `start`."""
        left, right = (
            self.numbers(name, 2 * start, WINDOW_TACTILE)
            for name in ("tactile_left", "tactile_right")
        )
        return left, right

    def window(self, camera: str, start: int) -> StoreWindow:
        """From single streams."""
        images = self.images(camera, start)
        left, right = self.touch(start)
        return StoreWindow(images, left, right, self.numbers("action", start, WINDOW_IMAGES))


@runtime_checkable
class Design(Protocol):
    """A storage design."""

    @property
    def name(self) -> str:
        """Short, unique name for `--designs` and tables."""

    @property
    def reads(self) -> str | None:
        """Name of the design whose files this one reads; None if it writes its own."""

    def missing(self) -> str | None:
        """Missing dependency (package or codec); None if the design is available."""

    def write(self, workload: Workload, folder: Path) -> None:
        """Write the take into a new folder as a station would, image by image in order of time."""

    def open(self, folder: Path) -> OpenStore:
        """Open the files of `write`."""


EPISODE_ID = "take"
Block = tuple[str, np.ndarray, np.ndarray]
_NUMERIC_KINDS: dict[str, tuple[StreamKind, str]] = {
    "tactile": ("tactile", "counts"),
    "keypoints": ("keypoints", "m"),
    "wrist": ("pose", "pose_m_wxyz"),
    "head": ("pose", "pose_m_wxyz"),
    "action": ("robot_state", "action"),
}


@dataclass(frozen=True)
class OurDesign:
    """Our store with default options and one camera unit."""

    unit: Literal["jpeg", "h264"]
    reads: str | None = None

    @property
    def name(self) -> str:
        """`ours-` and the unit."""
        return f"ours-{self.unit}"

    def missing(self) -> str | None:
        """The package for H.264, if it is not installed."""
        if self.unit == "h264" and importlib.util.find_spec("av") is None:
            return f"module av ({install_command('store')})"
        return None

    def write(self, workload: Workload, folder: Path) -> None:
        """Append the take as it arrives: image by image, numbers in batches in between."""
        attributes = episode_attributes(descriptors(workload, self.unit))
        with EpisodeStore(folder).writer(attributes=attributes) as writer:
            for name, values, t_ref_ns in arrivals(workload):
                writer.append(name, values=values, t_ref_ns=t_ref_ns)

    def open(self, folder: Path) -> OpenStore:
        """The episode's reader."""
        return _OpenOurs(EpisodeStore(folder).open(EPISODE_ID))


class _OpenOurs(StreamStore):
    """Windows by `EpisodeReader`: images by index, numbers by time."""

    def __init__(self, reader: EpisodeReader) -> None:
        self._reader = reader

    def images(self, camera: str, start: int) -> np.ndarray:
        return self._reader.images(camera, start, start + WINDOW_IMAGES)

    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        stamps = self._reader.stamps_ns(name)
        first_ns, last_ns = int(stamps[start]), int(stamps[start + count - 1])
        return self._reader.read(name, first_ns, last_ns + 1).values


def arrivals(workload: Workload) -> Iterator[Block]:
    """The take in the order of time: stream, values, timestamps."""
    for index in range(workload.num_images):
        rows = slice(index, index + 1)
        for name, stream in workload.images.items():
            yield name, stream.values[rows], stream.t_ref_ns[rows]
        for name, stream in workload.numbers.items():
            rows = workload.arrived_with(name, index)
            yield name, stream.values[rows], stream.t_ref_ns[rows]


def descriptors(workload: Workload, unit: str) -> tuple[StreamDescriptor, ...]:
    """The streams of a take as our store describes them."""
    cameras = [
        _descriptor(name, stream, ("image", unit)) for name, stream in workload.images.items()
    ]
    numbers = [
        _descriptor(name, stream, _NUMERIC_KINDS[name.split("_")[0]])
        for name, stream in workload.numbers.items()
    ]
    return (*cameras, *numbers)


def _descriptor(name: str, stream: TimedStream, what: tuple[StreamKind, str]) -> StreamDescriptor:
    return StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": what[0],
            "unit": what[1],
            "shape": stream.values.shape[1:],
            "dtype": stream.values.dtype.name,
            "nominal_rate_hz": float(stream.rate_hz),
        }
    )


def episode_attributes(streams: tuple[StreamDescriptor, ...]) -> EpisodeAttributes:
    """Placeholder attributes of an episode."""
    return EpisodeAttributes(
        episode_id=EPISODE_ID,
        task="bench",
        instruction="measure the store",
        domain="robot",
        origin="recorded",
        model_rate_hz=30.0,
        anchor=StoredAnchor.from_poses(AnchorPoses(np.eye(4), np.eye(4), np.eye(4))),
        K_head=matrix_rows(np.eye(3)),
        streams=streams,
    )


STAMPS = "_t_ref_ns"
_ZSTD_LEVEL = 1


@dataclass(frozen=True)
class ZarrDesign:
    """zarr-python with images as `kind`; numbers and timestamps in chunks of one second.

    Images are written one by one as they arrive. Numbers are written at once at the end, which
    avoids zarr's slow small appends. The arrays have their final length from the start.
    """

    kind: Literal["jpeg", "jpeg-pool", "raw"]
    reads: str | None = None

    @property
    def name(self) -> str:
        """`zarr-` and the kind of its images."""
        return f"zarr-{self.kind}"

    def missing(self) -> str | None:
        """zarr-python, if it is not installed."""
        return None if importlib.util.find_spec("zarr") else "package zarr (pip install zarr)"

    def write(self, workload: Workload, folder: Path) -> None:
        """Write image by image, then all numbers."""
        import zarr

        group = zarr.open_group(str(folder), mode="w")
        cameras = {
            name: group.create_array(
                name,
                shape=stream.values.shape,
                chunks=(1, *IMAGE_SHAPE),
                dtype="uint8",
                **self._image_codec(),
            )
            for name, stream in workload.images.items()
        }
        for index in range(workload.num_images):
            for name, stream in workload.images.items():
                cameras[name][index] = stream.values[index]
        columns = {name: stream.values for name, stream in workload.numbers.items()}
        streams = {**workload.images, **workload.numbers}
        columns |= {name + STAMPS: stream.t_ref_ns for name, stream in streams.items()}
        for name, column in columns.items():
            rows = min(len(column), streams[name.removesuffix(STAMPS)].rate_hz)
            array = group.create_array(
                name, shape=column.shape, chunks=(rows, *column.shape[1:]), dtype=column.dtype
            )
            array[:] = column

    def open(self, folder: Path) -> OpenStore:
        """The group's arrays."""
        return _OpenZarr(folder)

    def _image_codec(self) -> dict[str, Any]:
        from zarr.codecs import ZstdCodec

        from benchmarks.store.zarr_codec import JpegCodec, PooledJpegCodec, register

        if self.kind == "raw":
            return {"compressors": ZstdCodec(level=_ZSTD_LEVEL)}
        register()
        codec = JpegCodec() if self.kind == "jpeg" else PooledJpegCodec()
        return {"serializer": codec, "compressors": None}


class _OpenZarr(StreamStore):
    """Windows by slices of arrays that are opened once."""

    def __init__(self, folder: Path) -> None:
        import zarr

        from benchmarks.store.zarr_codec import register

        register()
        self._arrays: dict[str, Any] = dict(zarr.open_group(str(folder), mode="r").arrays())

    def images(self, camera: str, start: int) -> np.ndarray:
        return self.numbers(camera, start, WINDOW_IMAGES)

    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        return np.asarray(self._arrays[name][start : start + count])


_FILE = "take.mcap"


@dataclass(frozen=True)
class McapDesign:
    """The `mcap` library with defaults: chunks of 1 MiB, zstd; one message per sample."""

    name: str = "mcap-jpeg"
    reads: str | None = None

    def missing(self) -> str | None:
        """The mcap library, if it is not installed."""
        return None if importlib.util.find_spec("mcap") else "package mcap (pip install mcap)"

    def write(self, workload: Workload, folder: Path) -> None:
        """All messages in the order of their arrival."""
        from mcap.writer import Writer

        folder.mkdir(parents=True)
        with (folder / _FILE).open("wb") as file:
            writer: Any = Writer(file)  # the library leaves part of it without types
            writer.start()
            channels = {
                name: writer.register_channel(
                    topic=name,
                    message_encoding="",
                    schema_id=0,
                    metadata={"dtype": stream.values.dtype.str},
                )
                for name, stream in {**workload.images, **workload.numbers}.items()
            }
            for name, payload, stamp_ns in _messages(workload):
                writer.add_message(
                    channels[name], log_time=stamp_ns, publish_time=stamp_ns, data=payload
                )
            writer.finish()

    def open(self, folder: Path) -> OpenStore:
        """The file's index."""
        return _OpenMcap(folder / _FILE)


class _OpenMcap(StreamStore):
    """Windows by time; all timestamps of a take are read when it is opened."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import SeekingReader

        self._path = path
        self._dtypes: dict[str, str] = {}
        stamps: dict[str, list[int]] = defaultdict(list)
        with path.open("rb") as file:
            for _, channel, message in SeekingReader(file).iter_messages():
                stamps[channel.topic].append(message.log_time)
                self._dtypes[channel.topic] = channel.metadata["dtype"]
        self._stamps = dict(stamps)

    def images(self, camera: str, start: int) -> np.ndarray:
        images = self._payloads(camera, start, WINDOW_IMAGES)
        return np.stack([simplejpeg.decode_jpeg(image) for image in images])

    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        content = b"".join(self._payloads(name, start, count))
        return np.frombuffer(content, self._dtypes[name]).reshape(count, -1)

    def _payloads(self, name: str, start: int, count: int) -> list[bytes]:
        from mcap.reader import SeekingReader

        stamps = self._stamps[name]
        # One reader per call, since threads must not share one.
        with self._path.open("rb") as file:
            found = SeekingReader(file).iter_messages(
                topics=[name], starting_at=stamps[start], ending_at=stamps[start + count - 1]
            )
            return [message.data for _, _, message in found]


def _messages(workload: Workload) -> Iterator[tuple[str, bytes, int]]:
    for index in range(workload.num_images):
        for name, stream in workload.images.items():
            image = np.ascontiguousarray(stream.values[index])
            payload = simplejpeg.encode_jpeg(image, quality=JPEG_QUALITY, colorsubsampling="420")
            yield name, payload, int(stream.t_ref_ns[index])
        for name, stream in workload.numbers.items():
            rows = workload.arrived_with(name, index)
            for row in range(rows.start, rows.stop):
                yield name, stream.values[row].tobytes(), int(stream.t_ref_ns[row])
