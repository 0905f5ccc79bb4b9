"""Import of zip files written by `export_umi`, as episodes on the model grid."""

import json
import math
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field, ValidationError

from dextouch.bridges.umi.layout import (
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
from dextouch.episodes import EpisodeStore, EpisodeWriter
from dextouch.errors import CorruptDataError, InvalidInputError, LimitExceededError, StorageError
from dextouch.frozen_model import FrozenModel
from dextouch.geometry import pose_from_transform
from dextouch.hands.actions import JOINTS_LEFT, JOINTS_RIGHT, poses_from_actions
from dextouch.schemas import EpisodeAttributes, LineageEntry
from dextouch.streams import StreamDescriptor, StreamKind

MAX_EPISODES: Final = 1_000_000
MAX_STEPS: Final = 100_000
_BLOCK_BYTES: Final = 1 << 26


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
    with ZarrZipReader(path) as archive:
        meta = _meta(archive, path)
        ends = _ends(archive, path, meta)
        for episode, start, stop in zip(meta.episodes, [0, *ends], ends, strict=False):
            _Import(archive, store, meta.cameras).run(episode, start, stop)
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
        meta = _Meta.model_validate_json(json.dumps(plain))
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


class _Import:
    """Import of one episode into the store."""

    def __init__(
        self, archive: ZarrZipReader, store: EpisodeStore, cameras: tuple[str, ...]
    ) -> None:
        self._archive, self._store, self._cameras = archive, store, cameras

    def run(self, episode: _Episode, start: int, stop: int) -> None:
        """Write rows start … stop-1 as one episode."""
        source = episode.attributes
        entry = LineageEntry(kind="episode", id=source.episode_id, sha256=episode.content_sha256)
        attributes = source.model_copy(update={"streams": (), "lineage": (*source.lineage, entry)})
        with self._store.writer(attributes=attributes) as writer:
            t_ref_ns = self._archive.read("data/t_ref_ns", start, stop)
            self._add_numbers(writer, attributes, t_ref_ns, start)
            for index, camera in enumerate(self._cameras):
                self._add_camera(writer, attributes, camera, t_ref_ns, (index, start))

    def _add_numbers(
        self,
        writer: EpisodeWriter,
        attributes: EpisodeAttributes,
        t_ref_ns: np.ndarray,
        start: int,
    ) -> None:
        stop, rate_hz = start + len(t_ref_ns), attributes.model_rate_hz
        actions = self._archive.read("data/action", start, stop)
        poses = poses_from_actions(actions, attributes.anchor.to_poses())
        found: dict[str, tuple[StreamKind, str, np.ndarray]] = {
            "action": ("robot_state", "action", actions),
            "wrist_left": ("pose", "pose_m_wxyz", pose_from_transform(poses.Ts_world_wrist_left)),
            "wrist_right": ("pose", "pose_m_wxyz", pose_from_transform(poses.Ts_world_wrist_right)),
            "head": ("pose", "pose_m_wxyz", pose_from_transform(poses.Ts_world_camera_head)),
        }
        if COMMANDED in self._archive.arrays("data"):
            commanded = self._archive.read(COMMANDED, start, stop)
            found["action_commanded"] = ("robot_state", "action", commanded)
        if attributes.domain == "robot":
            joints = np.concatenate([actions[:, JOINTS_LEFT], actions[:, JOINTS_RIGHT]], axis=1)
            found["joints_measured"] = ("robot_state", "rad", joints)
        for name, (kind, unit, values) in found.items():
            frame = "world" if kind == "pose" else None
            writer.add_stream(_descriptor(name, kind, unit, values, rate_hz, frame))
            writer.append(name, values=values, t_ref_ns=t_ref_ns)
        tactile = self._archive.read("data/tactile", start, stop)
        valid = self._archive.read("data/tactile_valid", start, stop)
        for index, side in enumerate(("left", "right")):
            values, keep = tactile[:, index], valid[:, index]
            if not keep.any():
                continue
            name = f"tactile_{side}"
            writer.add_stream(_descriptor(name, "tactile", "kPa", values, rate_hz, None))
            writer.append(name, values=values[keep], t_ref_ns=t_ref_ns[keep])

    def _add_camera(
        self,
        writer: EpisodeWriter,
        attributes: EpisodeAttributes,
        camera: str,
        t_ref_ns: np.ndarray,
        where: tuple[int, int],
    ) -> None:
        index, start = where
        stop, name = start + len(t_ref_ns), camera_array(index)
        stamps = t_ref_ns + self._archive.read(camera_dt_array(index), start, stop)
        # A camera slower than the grid repeats an image at several steps; it is stored once.
        keep = np.diff(stamps, prepend=stamps[0] - 1) > 0
        shape = self._archive.metadata(name).shape[1:]
        writer.add_stream(
            StreamDescriptor(
                name=camera,
                kind="image",
                shape=shape,
                dtype="uint8",
                unit="rgb8",
                nominal_rate_hz=attributes.model_rate_hz,
                frame=camera,
            )
        )
        each = max(1, _BLOCK_BYTES // math.prod(shape))
        for first in range(0, len(keep), each):
            chosen = keep[first : first + each]
            images = self._archive.read(name, start + first, start + first + len(chosen))
            writer.append(
                camera,
                values=images[chosen],
                t_ref_ns=stamps[first : first + each][chosen],
            )


def _descriptor(
    name: str, kind: StreamKind, unit: str, values: np.ndarray, rate_hz: float, frame: str | None
) -> StreamDescriptor:
    return StreamDescriptor.model_validate(
        {
            "name": name,
            "kind": kind,
            "shape": values.shape[1:],
            "dtype": str(values.dtype),
            "unit": unit,
            "nominal_rate_hz": rate_hz,
            "frame": frame,
        }
    )
