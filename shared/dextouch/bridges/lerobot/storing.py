"""Writing of imported LeRobot episodes into the store, copying H.264 where possible."""

from collections.abc import Iterator
from itertools import islice
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from dextouch.bridges.lerobot.content import CameraContent, EpisodeContent
from dextouch.bridges.lerobot.rows import BLOCK_IMAGES
from dextouch.bridges.lerobot.video_reader import read_images, read_units
from dextouch.episodes import GOP_IMAGES, EpisodeStore, EpisodeWriter, is_keyframe
from dextouch.schemas import EpisodeAttributes
from dextouch.streams import StreamDescriptor, StreamKind, encoded_values
from dextouch.tactile.layout import SIDES

ImageUnit = Literal["h264", "jpeg", "rgb8"]


def store_episode(
    store: EpisodeStore,
    attributes: EpisodeAttributes,
    content: EpisodeContent,
    *,
    images: ImageUnit,
) -> None:
    """Write an episode into the store, atomically.

    Args:
        store: destination.
        attributes: of the episode, without streams; the model rate is that of the frames.
        content: its frames.
        images: unit of the camera streams. Video that is H.264 in the store's groups already is
            copied into `h264` streams; everything else is decoded and encoded again.

    Raises:
        CorruptDataError: damaged video.
        ConflictError: the id exists.
        NonFiniteError: NaN or infinity among the numbers.
    """
    rate_hz = attributes.model_rate_hz
    with store.writer(attributes=attributes) as writer:
        for hand, side in enumerate(SIDES):
            keep = content.tactile_valid[:, hand]
            if keep.any():
                kpa = content.tactile_kpa[keep, hand]
                name = _announce(writer, f"tactile_{side}", "tactile", kpa, rate_hz)
                writer.append(name, values=kpa, t_ref_ns=content.t_ref_ns[keep])
        for name, actions in (
            ("action", content.measured),
            ("action_commanded", content.commanded),
        ):
            if actions is not None:
                _announce(writer, name, "robot_state", actions, rate_hz)
                writer.append(name, values=actions, t_ref_ns=content.t_ref_ns)
        for camera, found in content.cameras.items():
            descriptor = StreamDescriptor(
                name=camera,
                kind="image",
                shape=found.span.shape,
                dtype="uint8",
                unit=images,
                nominal_rate_hz=rate_hz,
            )
            writer.add_stream(descriptor)
            _store_images(writer, camera, found, images)


def _announce(
    writer: EpisodeWriter, name: str, kind: StreamKind, values: np.ndarray, rate_hz: float
) -> str:
    writer.add_stream(
        StreamDescriptor.model_validate(
            {
                "name": name,
                "kind": kind,
                "shape": values.shape[1:],
                "dtype": str(values.dtype),
                "unit": "kPa" if kind == "tactile" else "action",
                "nominal_rate_hz": rate_hz,
            }
        )
    )
    return name


def _store_images(
    writer: EpisodeWriter, camera: str, found: CameraContent, unit: ImageUnit
) -> None:
    # An image that is the nearest one to several frames is stored once.
    fresh = np.diff(found.t_ref_ns, prepend=found.t_ref_ns[0] - 1) > 0
    units = read_units(found.span) if unit == "h264" and fresh.all() else None
    if units is not None and _in_groups(units):
        writer.append(camera, values=encoded_values(units), t_ref_ns=found.t_ref_ns)
        return
    images = _kept(read_images(found.span), fresh)
    stamps = found.t_ref_ns[fresh]
    for start in range(0, len(stamps), BLOCK_IMAGES):
        block = np.stack(list(islice(images, BLOCK_IMAGES)))
        writer.append(camera, values=block, t_ref_ns=stamps[start : start + BLOCK_IMAGES])
    # Exhausts the reader, so that a file that is too short is refused.
    for _ in images:
        pass


def _kept(
    images: Iterator[UInt8[np.ndarray, "h w 3"]], keep: np.ndarray
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    return (image for image, wanted in zip(images, keep, strict=True) if wanted)


def _in_groups(units: list[bytes]) -> bool:
    """Whether access units form the closed groups that the store requires."""
    return all(is_keyframe(data) == (index % GOP_IMAGES == 0) for index, data in enumerate(units))
