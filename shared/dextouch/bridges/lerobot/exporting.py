"""Export of episodes to a LeRobotDataset v3.0 folder, which appears complete or not at all."""

import re
import shutil
import uuid
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from dextouch.bridges.lerobot.dataset import DatasetWriter
from dextouch.bridges.lerobot.layout import IMAGES, Sidecar
from dextouch.bridges.lerobot.rows import frames_of, images_at
from dextouch.bridges.lerobot.statistics import Statistics, image_statistics, sample_places
from dextouch.episodes import (
    FULL_FORM,
    EpisodeReader,
    GopEncoder,
    VideoSettings,
    decoder_of_this_thread,
    disk_errors,
    is_keyframe,
)
from dextouch.errors import ConflictError, CorruptDataError, InvalidInputError, ShapeError

REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]{0,95}(/[A-Za-z0-9][\w.-]{0,95})?")

VIDEO = VideoSettings(crf=23, preset="veryfast")


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export.

    `fps`: frames a second, a whole number; without it the model rate of the first episode.
    `cameras`: whose images go along, the first of them setting the frames' times when `fps` is its
    own rate; without it all image streams of the first episode, the head's first. `video`, `group`:
    encoder settings and distance of IDR pictures of video that has to be encoded.
    """

    fps: int | None = None
    cameras: tuple[str, ...] | None = None
    video: VideoSettings = VIDEO
    group: int = 2
    robot_type: str = "dextouch"


DEFAULTS = ExportOptions()


def export_lerobot(
    readers: Iterable[EpisodeReader],
    folder: Path,
    *,
    repo_id: str,
    options: ExportOptions = DEFAULTS,
) -> int:
    """Write episodes as one LeRobotDataset v3.0 and return the number of frames.

    Args:
        readers: of the episodes, in the order of the dataset; opened one at a time.
        folder: of the dataset; must not exist.
        repo_id: name of the dataset, `user/name`.
        options: rate, cameras, quality.

    Raises:
        ConflictError: the folder exists.
        InvalidInputError: no episodes, a rate that is not an integer, or episodes that cannot share
            one dataset.
        UnknownNameError: a camera that an episode does not have.
        ShapeError: images with an odd side.
        CorruptDataError: a damaged episode.
        StorageError: the write failed.
    """
    if not REPO_ID.fullmatch(repo_id):
        raise InvalidInputError(f"repo_id: got {repo_id!r}, expected a name like 'user/name'")
    if folder.exists():
        raise ConflictError(f"{folder}: exists already; choose another folder")
    partial = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
    dataset: DatasetWriter | None = None
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, partial, ignore_errors=True)
        for reader in readers:
            if dataset is None:
                cameras = options.cameras or _cameras_of(reader)
                dataset = _new_dataset(reader, partial, cameras, options)
                stack.callback(dataset.close)
            _add_episode(dataset, reader, cameras, options)
        if dataset is None:
            raise InvalidInputError("export to LeRobot: got no episode, expected at least one")
        dataset.finish(repo_id)
        with disk_errors(f"complete {folder}"):
            partial.rename(folder)
    return dataset.num_frames


def _cameras_of(reader: EpisodeReader) -> tuple[str, ...]:
    names = [name for name, stream in reader.streams.items() if stream.kind == "image"]
    return tuple(sorted(names, key=lambda name: (name != "camera_head", name)))


def _new_dataset(
    reader: EpisodeReader, folder: Path, cameras: Sequence[str], options: ExportOptions
) -> DatasetWriter:
    rate_hz = reader.attributes.model_rate_hz
    if options.fps is None and rate_hz != round(rate_hz):
        raise InvalidInputError(
            f"episode {reader.attributes.episode_id!r}: got a model rate of {rate_hz} Hz, LeRobot "
            "counts whole frames a second; give fps="
        )
    _check_cameras(reader, cameras)
    return DatasetWriter(
        folder,
        cameras={name: reader.streams[name].shape for name in cameras},
        fps=round(rate_hz) if options.fps is None else options.fps,
        has_measured="action_commanded" in reader.streams,
        robot_type=options.robot_type,
    )


def _check_cameras(reader: EpisodeReader, cameras: Sequence[str]) -> None:
    images = [name for name, stream in reader.streams.items() if stream.kind == "image"]
    missing = [name for name in cameras if name not in images]
    if missing:
        raise InvalidInputError(
            f"episode {reader.attributes.episode_id!r}: has no camera {missing}, only {images}; "
            "choose cameras that all episodes have"
        )
    for name in cameras:
        height_px, width_px = reader.streams[name].shape[:2]
        if height_px % 2 or width_px % 2:
            raise ShapeError(
                f"camera {name!r}: got images of {height_px} x {width_px} pixels, expected even "
                "sides; LeRobot's players need 4:2:0 video"
            )


def _add_episode(
    dataset: DatasetWriter, reader: EpisodeReader, cameras: Sequence[str], options: ExportOptions
) -> None:
    _check_cameras(reader, cameras)
    frames = frames_of(reader, cameras, dataset.fps)
    videos: dict[str, list[bytes]] = {}
    statistics: dict[str, Statistics] = {}
    how: dict[str, Literal["remuxed", "encoded"]] = {}
    where = f"episode {reader.attributes.episode_id!r}"
    for camera in cameras:
        indices = frames.image_indices[camera]
        units, how[camera] = stored_units(reader, camera, indices), "remuxed"
        if units is None:
            images, how[camera] = images_at(reader, camera, indices), "encoded"
            units = encode_images(images, dataset.fps, options)
        videos[camera] = units
        entries = [data for data in units if is_keyframe(data)]
        sampled = [entries[place] for place in sample_places(len(entries))]
        statistics[IMAGES + camera] = image_statistics(
            decode_entry_points(sampled, reader.streams[camera].shape, where=f"{where}: {camera!r}")
        )
    sidecar = Sidecar(
        episode_index=dataset.num_episodes,
        content_sha256=reader.content_sha256,
        grid=frames.grid,
        action_kind=frames.action_kind,
        cameras=how,
        attributes=reader.attributes,
    )
    dataset.append(frames, videos, statistics, sidecar)


def stored_units(reader: EpisodeReader, camera: str, indices: np.ndarray) -> list[bytes] | None:
    """The stored access units of a camera, where they can be remuxed without encoding.

    None where the stream is not H.264, images are skipped or repeated, or the first one cannot be
    decoded without those before it.
    """
    consecutive = bool((np.diff(indices) == 1).all())
    if reader.streams[camera].unit != "h264" or not consecutive:
        return None
    units = reader.encoded_images(camera, int(indices[0]), int(indices[-1]) + 1)
    return units if is_keyframe(units[0]) else None


def encode_images(
    images: Iterable[UInt8[np.ndarray, "h w 3"]], fps: int, options: ExportOptions
) -> list[bytes]:
    """RGB images of one size as H.264, one access unit each."""
    encoder: GopEncoder | None = None
    units = []
    for image in images:
        if encoder is None:
            encoder = GopEncoder(
                *image.shape[:2],
                rate_hz=float(fps),
                settings=options.video,
                group_images=options.group,
            )
        units.append(encoder.encode(image))
    return units


def decode_entry_points(
    access_units: Iterable[bytes], shape: tuple[int, ...], *, where: str
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Decode access units that are each decodable on their own to RGB images [h, w, 3].

    Raises:
        CorruptDataError: an access unit that cannot be decoded, or is of another size.
    """
    decoder = decoder_of_this_thread(*shape[:2])
    for index, data in enumerate(access_units):
        image = np.empty((1, *shape), dtype=np.uint8)
        try:
            decoder.decode([data], [0], FULL_FORM, image)
        except CorruptDataError as error:
            raise CorruptDataError(f"{where}: entry point {index} is damaged ({error})") from error
        yield image[0]
