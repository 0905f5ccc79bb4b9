"""Import of zip files written by `export_umi`, as episodes on the model grid."""

from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import UInt8
from pydantic import Field, ValidationError

from dextouch.bridges.model_grid import (
    BLOCK_IMAGES,
    GridEpisode,
    GridImages,
    GridNumbers,
    store_episode,
    tactile_numbers,
)
from dextouch.bridges.umi.writing import (
    ATTRIBUTES_KEY,
    COMMANDED,
    ENDS,
    LAYOUT_VERSION,
    MODEL_CAMERAS,
    NUMBERS,
    camera_array,
    camera_dt_array,
)
from dextouch.bridges.umi.zarr_zip import ZarrZipReader
from dextouch.episodes import EpisodeStore
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import pose_from_transform
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, poses_from_actions
from dextouch.schemas import EpisodeAttributes, LineageEntry

MAX_EPISODES: Final = 1_000_000
MAX_STEPS: Final = 100_000


class _Episode(FrozenModel):
    attributes: EpisodeAttributes
    content_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class _Meta(FrozenModel):
    layout_version: int
    cameras: tuple[str, ...]
    episodes: tuple[_Episode, ...] = Field(max_length=MAX_EPISODES)


def import_umi(path: Path, store: EpisodeStore) -> list[str]:
    """Import a zip file written by `export_umi` into a store.

    The episodes are on the model grid: samples between the steps are not in the file.

    Args:
        path: of the file; it may come from anywhere.
        store: where the episodes appear under the ids that they had.

    Returns:
        The ids.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: a replay buffer not written by DexTouch.
        CorruptDataError: truncated or damaged; episodes before the damage may be in the store.
        LimitExceededError: larger than the limits of this reader.
        ConflictError: an id is in the store already.
    """
    with closing(ZarrZipReader(path)) as archive:
        meta = _meta(archive, path)
        ends = _ends(archive, path, meta)
        for episode, start, stop in zip(meta.episodes, [0, *ends], ends, strict=False):
            source = episode.attributes
            entry = LineageEntry(
                kind="episode", id=source.episode_id, sha256=episode.content_sha256
            )
            lineage = (*source.lineage, entry)
            attributes = source.model_copy(update={"streams": (), "lineage": lineage})
            rows = slice(start, stop)
            store_episode(store, attributes, _episode(archive, attributes, meta.cameras, rows))
    return [episode.attributes.episode_id for episode in meta.episodes]


def _meta(archive: ZarrZipReader, path: Path) -> _Meta:
    plain = archive.attributes("meta").get(ATTRIBUTES_KEY)
    if not isinstance(plain, dict):
        raise InvalidInputError(
            f"{path}: has no DexTouch attributes in meta/.zattrs; only files that "
            "`dextouch export --format umi` wrote can be imported (other replay buffers hold no "
            "67-D actions)"
        )
    if plain.get("layout_version") != LAYOUT_VERSION:
        raise StorageError(
            f"{path}: got layout version {plain.get('layout_version')!r}, expected "
            f"{LAYOUT_VERSION}; read it with the release that wrote it"
        )
    try:
        meta = _Meta.model_validate(plain)
    except ValidationError as error:
        raise CorruptDataError(
            f"{path}: attributes in meta/.zattrs are invalid ({error})"
        ) from error
    if not set(meta.cameras) <= set(MODEL_CAMERAS) or len(set(meta.cameras)) != len(meta.cameras):
        raise CorruptDataError(f"{path}: got cameras {meta.cameras}, expected of {MODEL_CAMERAS}")
    return meta


def _ends(archive: ZarrZipReader, path: Path, meta: _Meta) -> list[int]:
    num_episodes = len(meta.episodes)
    shape = archive.metadata(ENDS).shape
    if shape != (num_episodes,):
        raise CorruptDataError(f"{path}: {ENDS} has shape {shape}, expected ({num_episodes},)")
    ends = archive.read(ENDS, 0, num_episodes)
    names = [*NUMBERS, *(camera_array(index) for index in range(len(meta.cameras)))]
    rows = {name: archive.metadata(name).shape[0] for name in names}
    rising = bool((np.diff(ends, prepend=0) > 0).all())
    if ends.dtype != np.int64 or not rising or set(rows.values()) != {int(ends[-1])}:
        raise CorruptDataError(f"{path}: {ENDS} is inconsistent with the arrays of {rows} rows")
    longest = int(np.diff(ends, prepend=0).max())
    if longest > MAX_STEPS:
        raise LimitExceededError(
            f"{path}: an episode has {longest} steps, expected at most {MAX_STEPS}"
        )
    for name, (dtype, row_shape) in NUMBERS.items():
        found = archive.metadata(name)
        if (found.dtype, found.shape[1:]) != (dtype, row_shape):
            raise CorruptDataError(
                f"{path}: {name} holds {found.dtype} {found.shape[1:]}, "
                f"expected {dtype} {row_shape}"
            )
    return [int(end) for end in ends]


def _episode(
    archive: ZarrZipReader, attributes: EpisodeAttributes, cameras: tuple[str, ...], rows: slice
) -> GridEpisode:
    start, stop = rows.start, rows.stop
    t_ref_ns = archive.read("data/t_ref_ns", start, stop)
    actions = archive.read("data/action", start, stop)
    poses = poses_from_actions(actions, attributes.anchor.to_poses())
    numbers = {"action": GridNumbers("robot_state", "action", actions)}
    for name, Ts_world in (
        ("wrist_left", poses.Ts_world_wrist_left),
        ("wrist_right", poses.Ts_world_wrist_right),
        ("head", poses.Ts_world_camera_head),
    ):
        values = pose_from_transform(Ts_world)
        numbers[name] = GridNumbers("pose", "pose_m_wxyz", values, frame="world")
    if COMMANDED in archive.arrays("data"):
        commanded = archive.read(COMMANDED, start, stop)
        numbers["action_commanded"] = GridNumbers("robot_state", "action", commanded)
    if attributes.domain == "robot":
        joints = np.concatenate([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
        numbers["joints_measured"] = GridNumbers("robot_state", "rad", joints)
    tactile = archive.read("data/tactile", start, stop)
    numbers |= tactile_numbers(tactile, archive.read("data/tactile_valid", start, stop))
    images = {}
    for index, camera in enumerate(cameras):
        name = camera_array(index)
        stamps = t_ref_ns + archive.read(camera_dt_array(index), start, stop)
        shape = archive.metadata(name).shape[1:]
        images[camera] = GridImages(
            shape, stamps, partial(_images, archive, name, rows), frame=camera
        )
    return GridEpisode(t_ref_ns, numbers, images)


def _images(archive: ZarrZipReader, name: str, rows: slice) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    for first in range(rows.start, rows.stop, BLOCK_IMAGES):
        yield from archive.read(name, first, min(first + BLOCK_IMAGES, rows.stop))
