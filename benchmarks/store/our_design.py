"""Storage design: an episode of our store, through its public writer and reader."""

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.store.designs import OpenStore, StreamStore
from benchmarks.store.workload import WINDOW_IMAGES, TimedStream, Workload
from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import EpisodeAttributes, StoredAnchor, matrix_rows
from dextouch.streams import StreamDescriptor, StreamKind

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
            return "module av (pip install 'dextouch-wm[store]')"
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
