"""Finds images of a recording that no working camera takes, and cameras that see otherwise.

What is found, and how, is in `dextouch.streams.pictures` and `dextouch.streams.camera_motion`.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from dextouch.episodes import ImageForm
from dextouch.errors import CorruptDataError, InvalidInputError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import Matrix
from dextouch.streams import (
    ENCODED_UNITS,
    IMAGE_FAULTS,
    PICTURE_SHAPE,
    TRACKERS,
    CameraMotion,
    Implausible,
    View,
    image_faults,
    spread,
    thumbnail,
    view_faults,
)
from services.alignment.retargeting.wrist import calibrated_transform
from services.alignment.synchronization.recorded_streams import DatedStream, moved_poses

# Images of a camera that are looked at, half a minute in the middle of the take: H.264 of VGA takes
# some 2 ms each, and stations look at all.
MAX_LOOKED: Final = 900
# What is left out; the others are all there is.
MIN_POSES: Final = 2
_LEFT_OUT: Final = ("black", "torn", "older")


def looked_at(stream: DatedStream) -> tuple[DatedStream, View | None]:
    """A camera's stream with what is wrong with single images, and what was looked at.

    The view has no matrix yet. Damaged images are said elsewhere, and nothing is looked at then.
    """
    count, name = len(stream.t_ns), stream.name
    first = max(0, count - MAX_LOOKED) // 2
    places = np.arange(first, min(count, first + MAX_LOOKED))
    encoded = stream.descriptor.unit in ENCODED_UNITS
    form = ImageForm(half_size=encoded, gray=encoded)
    pictures = np.empty((len(places), *PICTURE_SHAPE), dtype=np.float32)
    for low in range(0, len(places), 32):
        kept = stream.timing.kept[places[low : low + 32]]
        try:
            images = stream.recording.images_at(name, kept, form=form)
        except CorruptDataError:
            return stream, None
        pictures[low : low + 32] = [thumbnail(image) for image in images]
    start_ns = stream.recording.attributes.started_t_host_ns or 0
    implausible, first_s = [], {}
    for fault, marked in image_faults(pictures).items():
        samples, harmless = spread(marked, places, count), fault not in _LEFT_OUT
        implausible.append(Implausible(fault, IMAGE_FAULTS[fault], samples, harmless=harmless))
        first_s[f"{name}_first_{fault}_s"] = float(stream.t_ns[samples][0] - start_ns) / 1e9
    height, width = stream.descriptor.shape[:2]
    view = View(stream.t_ns[places], pictures, np.eye(3), (height, width))
    quality = stream.quality | first_s
    return replace(stream, implausible=tuple(implausible), quality=quality), view


def check_views(
    views: Mapping[str, View | None],
    streams: Mapping[str, DatedStream],
    calibration: Mapping[str, Matrix],
) -> dict[str, float]:
    """Compare what cameras saw with how they moved; figures of lags and of still pictures.

    Raises InvalidInputError: images are turned or mirrored, or another camera's (`details`).
    """
    found = {name: _motion(name, streams, calibration) for name in TRACKERS if name in views}
    motions = {name: motion for name, motion in found.items() if motion is not None}
    quality: dict[str, float] = {}
    for name in motions:
        K, view = calibration.get(f"K_{name.removeprefix('camera_')}"), views[name]
        if K is None or view is None:
            continue
        faults = view_faults(name, replace(view, K=np.array(K)), motions)
        fault, text = (
            "axes",
            (
                f"images are {faults.turn}, as they flow where the camera turns and moves: send "
                "them as it was calibrated, or calibrate it again"
            ),
        )
        if faults.like is not None:
            fault, text = (
                "swapped",
                (
                    f"images flow as those of {faults.like!r} should, and not with its own tracker "
                    f"{TRACKERS[name]!r}: exchange the cameras or their settings"
                ),
            )
        if faults.like or faults.turn:
            message = f"stream {name!r}: {text}, and record again"
            raise InvalidInputError(message, fault=fault, stream=name)
        if faults.still_share is not None:
            quality[f"{name}_still_share"] = faults.still_share
        if faults.lag_s is not None:
            quality[f"{name}_lag_s"], quality[f"{name}_lag_sigma_s"] = faults.lag_s
    return quality


def _motion(
    name: str, streams: Mapping[str, DatedStream], calibration: Mapping[str, Matrix]
) -> CameraMotion | None:
    """Motion of a camera; None without poses, or where its mount is not known."""
    tracker = TRACKERS[name]
    T = calibrated_transform(calibration, f"T_tracker_{tracker.removeprefix('wrist_')}_{name}")
    if tracker not in streams or (T is None and name != "camera_head"):
        return None
    raw = replace(streams[tracker], convert=np.asarray).load()
    poses = moved_poses(raw.values.astype(np.float64), T_world_base=None, T_tracker_body=T)
    seen = np.isfinite(poses).all(axis=1)
    if np.count_nonzero(seen) < MIN_POSES:
        return None
    return CameraMotion(raw.t_ns[seen], transform_from_pose(poses[seen]))
