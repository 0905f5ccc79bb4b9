"""Storage design: one MCAP file with JPEG payloads, as robot loggers write."""

import importlib.util
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from benchmarks.store.designs import OpenStore, StreamStore
from benchmarks.store.workload import JPEG_QUALITY, WINDOW_IMAGES, Workload

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
