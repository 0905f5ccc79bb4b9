"""Contents of one episode of a LeRobot dataset: actions, tactile rows and image locations."""

from functools import partial

import numpy as np
from jaxtyping import Int64

from dextouch.bridges.lerobot import layout
from dextouch.bridges.lerobot.mapping import FeatureMap
from dextouch.bridges.lerobot.rows import WORLD
from dextouch.bridges.lerobot.sidecar import Sidecar
from dextouch.bridges.lerobot.source import EpisodeEntry, LeRobotFolder
from dextouch.bridges.lerobot.video_reader import read_images, read_units
from dextouch.bridges.model_grid import GridEpisode, GridImages, GridNumbers, tactile_numbers
from dextouch.errors import CorruptDataError
from dextouch.hands.actions import ACTION_DIM, AnchorPoses, poses_from_actions, reanchor

# What our own exports keep beside LeRobot's features; None: one number a camera.
_OURS: dict[str, tuple[str, tuple[int, ...] | None]] = {
    layout.MEASURED: ("float32", (ACTION_DIM,)),
    layout.VALID: ("bool", (2,)),
    layout.STAMP: ("int64", (1,)),
    layout.IMAGE_DT: ("int64", None),
}


def content_of(
    source: LeRobotFolder, entry: EpisodeEntry, features: FeatureMap, sidecar: Sidecar | None
) -> tuple[GridEpisode, AnchorPoses | None]:
    """Read an episode's numbers and find its videos.

    Actions are relative to the measured poses of the first frame; these are returned where they are
    not those that the dataset's description gives.

    Raises:
        NotFoundError: a file is missing.
        CorruptDataError: a damaged file, or stamps that do not rise.
        InvalidInputError: actions that are no poses.
    """
    where = f"{source.folder}: episode {entry.index}"
    columns = _columns(source, entry, features)
    t_ns = columns.get(layout.STAMP)
    if t_ns is None:
        t_ns = np.rint(np.arange(entry.length) * (1e9 / source.info.fps))
    t_ns = t_ns.astype(np.int64)
    if (np.diff(t_ns) <= 0).any():
        raise CorruptDataError(f"{where}: {layout.STAMP!r} does not rise from frame to frame")
    measured, commanded, anchor = _actions(columns, features, sidecar, where)
    numbers = _tactile(columns, features, entry.length)
    numbers["action"] = GridNumbers("robot_state", "action", measured)
    if commanded is not None:
        numbers["action_commanded"] = GridNumbers("robot_state", "action", commanded)
    cameras = {}
    for camera, key in features.cameras.items():
        span = source.span(entry, key)
        stamps = _image_stamps(source, key, t_ns, columns.get(layout.IMAGE_DT), where)
        cameras[camera] = GridImages(
            span.shape, stamps, partial(read_images, span), partial(read_units, span)
        )
    return GridEpisode(t_ns, numbers, cameras), anchor


def _columns(
    source: LeRobotFolder, entry: EpisodeEntry, features: FeatureMap
) -> dict[str, np.ndarray]:
    wanted = [features.action, features.state, features.tactile]
    for name, (dtype, shape) in _OURS.items():
        feature = source.info.features.get(name)
        if feature is None:
            continue
        if feature.dtype != dtype or (shape is not None and feature.shape != shape):
            raise CorruptDataError(
                f"{source.folder}: feature {name!r} is {feature.dtype} {list(feature.shape)}, "
                f"expected {dtype} {list(shape or ['cameras'])}"
            )
        wanted.append(name)
    return source.columns(entry, [name for name in wanted if name is not None])


def _actions(
    columns: dict[str, np.ndarray], features: FeatureMap, sidecar: Sidecar | None, where: str
) -> tuple[np.ndarray, np.ndarray | None, AnchorPoses | None]:
    """Measured and commanded actions, and the poses that they are relative to."""
    action = columns[features.action].astype(np.float64)
    if sidecar is None:
        if features.state is None:
            return action, None, None
        state = columns[features.state][:1].astype(np.float64)
        return action, None, poses_from_actions(state, WORLD).anchor(0)
    measured, commanded = action, None
    if sidecar.action_kind == "commanded":
        if layout.MEASURED not in columns:
            raise CorruptDataError(f"{where}: feature {layout.MEASURED!r} is missing")
        measured, commanded = columns[layout.MEASURED].astype(np.float64), action
    if sidecar.grid == "model":
        return measured, commanded, None
    # Frame 0 need not be step 0: actions become relative to what they now begin with.
    anchor = poses_from_actions(measured[:1], sidecar.attributes.anchor.to_poses()).anchor(0)
    if commanded is not None:
        commanded = reanchor(commanded, 0, anchor_action=measured[0])
    return reanchor(measured, 0), commanded, anchor


def _tactile(
    columns: dict[str, np.ndarray], features: FeatureMap, count: int
) -> dict[str, GridNumbers]:
    if features.tactile is None:
        return {}
    kpa = columns[features.tactile].astype(np.float32)
    valid = columns.get(layout.VALID, np.ones((count, 2), dtype=bool))
    return tactile_numbers(kpa, valid.astype(bool))


def _image_stamps(
    source: LeRobotFolder, key: str, t_ns: np.ndarray, offsets_ns: np.ndarray | None, where: str
) -> Int64[np.ndarray, " n"]:
    """Stamp of the image of each frame: the frame's own where the dataset says nothing."""
    if offsets_ns is None:
        return t_ns
    names = source.info.features[layout.IMAGE_DT].names
    columns = offsets_ns.reshape(len(t_ns), -1)
    camera = key.removeprefix(layout.IMAGES)
    if not isinstance(names, list) or camera not in names[: columns.shape[1]]:
        return t_ns
    stamps = t_ns + columns[:, names.index(camera)].astype(np.int64)
    if (np.diff(stamps) < 0).any():
        raise CorruptDataError(f"{where}: stamps of {camera!r} in {layout.IMAGE_DT!r} go back")
    return stamps
