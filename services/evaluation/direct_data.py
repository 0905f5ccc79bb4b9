"""Training data of a direct judge: stored episodes as attempts with known outcomes."""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import (
    OBJECT_POSES,
    EpisodeReader,
    EpisodeStore,
    scene_of,
    select_episodes,
)
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses, poses_from_actions
from services.evaluation.demonstrations import CAMERA
from services.evaluation.direct_network import NUM_STEPS, Attempt
from services.evaluation.starts import start_digest

# Object poses are learned from the images at these steps.
_VIEW_STEPS = (0, 16, 32, 48, 64, 80)


@dataclass(frozen=True)
class View:
    """One image of an episode, with the camera pose and the true object poses."""

    image: np.ndarray
    T_world_camera: Float64[np.ndarray, "4 4"]
    object_poses: Float64[np.ndarray, "objects 7"]


@dataclass(frozen=True)
class LabelledAttempt:
    """An attempt with its outcome and some of its views, the first one at the start."""

    episode_id: str
    instruction: str
    scene: str
    success: bool
    attempt: Attempt
    views: Sequence[View]

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.attempt.task

    @property
    def start_digest(self) -> str:
        """Digest of the first observation."""
        return start_digest(self.attempt.image, self.attempt.tactile_kpa)


def read_attempts(*stores: EpisodeStore, tasks: Sequence[str] = ()) -> list[LabelledAttempt]:
    """Read the true robot episodes of some stores.

    Args:
        stores: stores to read; imagined and human episodes are skipped.
        tasks: tasks to read; empty for all.

    Raises:
        NotFoundError: no such episode, or an empty store.
        ConflictError: two stores hold an episode of the same id.
        InvalidInputError: an episode with an unknown outcome, another length or no object
            poses.
    """
    return [read_attempt(reader) for reader in select_episodes(stores, domain="robot", tasks=tasks)]


def read_attempt(reader: EpisodeReader) -> LabelledAttempt:
    """Read one episode as an attempt.

    Raises:
        InvalidInputError: unknown outcome, another length, or no object poses or commands.
    """
    about = reader.attributes
    missing = {"action_commanded", OBJECT_POSES} - set(reader.streams)
    if about.success is None or missing or reader.num_steps != 1 + NUM_STEPS:
        raise InvalidInputError(
            f"episode {about.episode_id!r}: success {about.success}, {reader.num_steps} steps, "
            f"without {sorted(missing)}; expected a known outcome, {1 + NUM_STEPS} steps and these "
            "streams, as `dextouch train data` records them"
        )
    window = reader.window(0, reader.num_steps, cameras=())
    steps, images = reader.shown_steps(CAMERA)
    chosen = np.isin(steps, _VIEW_STEPS)
    if not len(steps) or steps[0] != 0:
        raise InvalidInputError(f"episode {about.episode_id!r}: no image of step 0")
    cameras = poses_from_actions(window.actions, window.anchor).Ts_world_camera_head
    poses = reader.read(OBJECT_POSES)
    views = [
        View(image, cameras[step], _nearest(poses.t_ref_ns, poses.values, window.t_ref_ns[step]))
        for step, image in zip(
            steps[chosen].tolist(), reader.images_at(CAMERA, images[chosen]), strict=True
        )
    ]
    actions = reader.read("action_commanded").values.astype(np.float64)
    attempt = Attempt(
        about.task,
        views[0].image,
        window.tactile_kpa[0],
        actions[1:],
        AnchorPoses(*window.anchor.as_tuple()),
        window.K_head,
    )
    return LabelledAttempt(
        about.episode_id, about.instruction, scene_of(about), about.success, attempt, views
    )


def _nearest(t_ref_ns: np.ndarray, values: np.ndarray, now_ns: int) -> Float64[np.ndarray, "k 7"]:
    return np.asarray(values[np.abs(t_ref_ns - now_ns).argmin()], dtype=np.float64)


def attempts_hash(items: Iterable[LabelledAttempt]) -> str:
    """SHA-256 of all training data, in the order of the ids."""
    digest = hashlib.sha256()
    for item in sorted(items, key=lambda one: one.episode_id):
        digest.update(repr((item.episode_id, item.task, item.success)).encode())
        arrays: Mapping[str, np.ndarray] = {
            "actions": item.attempt.actions,
            "touch": item.attempt.tactile_kpa,
            "anchor": np.stack(item.attempt.anchor.as_tuple()),
            "K_head": item.attempt.K_head,
            "images": np.stack([view.image for view in item.views]),
            "poses": np.stack([view.object_poses for view in item.views]),
        }
        for array in arrays.values():
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
