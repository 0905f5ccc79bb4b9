"""Finds images of a recording that no working camera takes, and cameras that see otherwise.

What is found, and how, is in `dextouch.streams.pictures` and `dextouch.streams.camera_motion`.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from dextouch.episodes import ImageForm
from dextouch.errors import CorruptDataError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import Matrix
from dextouch.streams import (
    ENCODED_UNITS,
    IMAGE_FAULTS,
    PICTURE_SHAPE,
    TRACKERS,
    Implausible,
    MovingCamera,
    View,
    image_faults,
    spread,
    thumbnail,
    view_faults,
)
from services.alignment.retargeting.wrist import calibrated_transform
from services.alignment.synchronization.recorded_streams import DatedStream, moved_poses

# Images of a camera that are looked at, some seconds in the middle of the take: JPEG of VGA takes
# 0.9 ms each, H.264 0.6 ms, the rest of an alignment of 30 s some 3 s; and stations look at all.
MAX_LOOKED: Final = 120
# Poses around them with which images that are late are told from turned ones.
REACH_NS: Final = 500_000_000
MIN_POSES: Final = 2
_LEFT_OUT: Final = ("black", "torn")


def looked_at(stream: DatedStream) -> tuple[DatedStream, View | None]:
    """A camera's stream with what is wrong with single images, and what was looked at.

    The view has no matrix yet. Damaged images are said elsewhere, and nothing is looked at then, or
    where images are depths, or too small for blocks of several pixels.
    """
    height, width = stream.descriptor.shape[:2]
    is_small = height < 2 * PICTURE_SHAPE[0] or width < 2 * PICTURE_SHAPE[1]
    if is_small or stream.descriptor.dtype != "uint8":
        return stream, None
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
    view = View(stream.t_ns[places], pictures, np.eye(3), (height, width))
    quality = stream.quality | first_s
    return replace(stream, implausible=tuple(implausible), quality=quality), view


def check_views(
    views: Mapping[str, View | None],
    streams: Mapping[str, DatedStream],
    calibration: Mapping[str, Matrix],
) -> dict[str, float]:
    """Compare what cameras saw with how they moved; no figure makes a take a bad one."""
    quality: dict[str, float] = {}
    for name, view in views.items():
        K = calibration.get(f"K_{name.removeprefix('camera_')}")
        if view is None or K is None:
            continue
        motion = _motion(name, view, streams, calibration)
        if motion is None:
            continue
        faults = view_faults(replace(view, K=np.array(K)), motion)
        quality |= {f"{name}_looks_{what}": share for what, share in faults.looks.items()}
        if faults.still_share is not None:
            quality[f"{name}_still_share"] = faults.still_share
    return quality


def _motion(
    name: str, view: View, streams: Mapping[str, DatedStream], calibration: Mapping[str, Matrix]
) -> MovingCamera | None:
    """Motion of a camera; None without poses, or where its mount is not known."""
    tracker = TRACKERS.get(name, "")
    T = calibrated_transform(calibration, f"T_tracker_{tracker.removeprefix('wrist_')}_{name}")
    if tracker not in streams or (T is None and name != "camera_head"):
        return None
    raw = replace(streams[tracker], convert=np.asarray).load()
    poses = moved_poses(raw.values.astype(np.float64), T_world_base=None, T_tracker_body=T)
    seen = np.isfinite(poses).all(axis=1)
    seen &= (raw.t_ns > view.t_ns[0] - REACH_NS) & (raw.t_ns < view.t_ns[-1] + REACH_NS)
    if np.count_nonzero(seen) < MIN_POSES:
        return None
    return MovingCamera(raw.t_ns[seen], transform_from_pose(poses[seen]))
