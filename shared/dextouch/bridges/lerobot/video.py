"""Muxing of H.264 access units into the mp4 files of a dataset."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.container import OutputContainer
from av.video.stream import VideoStream

from dextouch.bridges.lerobot.layout import VIDEO_FILE_MB, VIDEO_PATH, numbered_path
from dextouch.episodes import disk_errors, is_keyframe, parameter_sets
from dextouch.errors import CorruptDataError, ShapeError


@dataclass(frozen=True)
class VideoPlace:
    """Location of one episode's images: file number of the camera and seconds within it."""

    file_number: int
    from_timestamp_s: float
    to_timestamp_s: float


class CameraVideo:
    """The mp4 files of one camera, one episode after the other.

    Access units are muxed unchanged. A new file starts when the next episode would make the file
    too large, or was encoded with other parameter sets than the file's header holds.

    Args:
        folder: root of the dataset.
        key: feature of the camera.
        fps: images a second of the dataset.
        shape: [height, width, 3] of the images.
        file_bytes: size that a file should not exceed; one episode is never split.
    """

    def __init__(
        self,
        folder: Path,
        key: str,
        *,
        fps: int,
        shape: Sequence[int],
        file_bytes: int = VIDEO_FILE_MB << 20,
    ) -> None:
        self._folder, self._key, self._fps, self._shape = folder, key, fps, tuple(shape)
        self._file_bytes = file_bytes
        self._file_number = -1
        self._num_images = self._num_bytes = 0
        self._parameters = b""
        self._file: tuple[OutputContainer, VideoStream] | None = None

    def append(self, access_units: Sequence[bytes], *, where: str) -> VideoPlace:
        """Mux one episode.

        Args:
            access_units: one per image, the first an entry point; without B-frames.
            where: names the episode and camera in errors.

        Raises:
            CorruptDataError: the first image is not an entry point.
            ShapeError: images of another size.
            StorageError: the write failed.
        """
        parameters = parameter_sets(access_units[0]) if access_units else b""
        if not parameters:
            raise CorruptDataError(f"{where}: does not begin with an IDR image and its headers")
        size = sum(map(len, access_units))
        full = self._num_bytes + size > self._file_bytes
        if self._file is None or full or parameters != self._parameters:
            self._file = self._new_file(access_units[0], where=where)
            self._parameters = parameters
        output, stream = self._file
        first = self._num_images
        with disk_errors(f"write {where}"):
            for data in access_units:
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, Fraction(1, self._fps)
                packet.pts = packet.dts = self._num_images
                packet.duration, packet.is_keyframe = 1, is_keyframe(data)
                output.mux(packet)
                self._num_images += 1
        self._num_bytes += size
        stop = self._num_images
        return VideoPlace(self._file_number, first / self._fps, stop / self._fps)

    def close(self) -> None:
        """Complete the file that is open."""
        if self._file is not None:
            with disk_errors(f"complete a video of {self._key}"):
                self._file[0].close()
        self._file = None

    def _new_file(self, access_unit: bytes, *, where: str) -> tuple[OutputContainer, VideoStream]:
        self.close()
        self._file_number += 1
        self._num_images = self._num_bytes = 0
        try:
            with av.open(io.BytesIO(access_unit), format="h264") as source:
                template = source.streams.video[0]
                size = (template.height, template.width)
                if size != self._shape[:2]:
                    raise ShapeError(f"{where}: got images {size}, expected {self._shape[:2]}")
                with disk_errors(f"create a video of {self._key}"):
                    path = numbered_path(
                        self._folder, VIDEO_PATH, self._file_number, video_key=self._key
                    )
                    output = av.open(path, "w", format="mp4")
                stream = output.add_stream_from_template(template)
        except (av.error.InvalidDataError, IndexError) as error:
            raise CorruptDataError(f"{where}: is not an H.264 stream ({error})") from error
        stream.time_base = Fraction(1, self._fps)
        return output, stream
