"""Training episodes of behaviour cloning: successful robot episodes at decision steps only."""

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.episodes import EpisodeReader, EpisodeStore, Split, is_in, scene_of
from dextouch.errors import InvalidInputError
from dextouch.hands.actions import AnchorPoses
from dextouch.images import square_of_at_most
from services.evaluation.demonstrations import CAMERA
from services.evaluation.policies.cloning_network import SLOT_STEPS
from services.evaluation.robot_episodes import robot_episodes
from services.evaluation.starts import start_digest
from services.networks.training_settings import USUAL_IMAGE_PX

# Training uses every such step; an evaluation with chunks of 16 decides at every second of them.
DECISION_STRIDE: Final = SLOT_STEPS


@dataclass(frozen=True)
class Moment:
    """Image and touch at one step."""

    image: UInt8[np.ndarray, "h w 3"]
    tactile_kpa: Float32[np.ndarray, "2 320"]


@dataclass(frozen=True)
class CloningEpisode:
    """One robot episode: measured and commanded actions at every step, observations at some.

    `commanded` are the measured ones where the episode has no commands. Both actions are relative
    to the measured poses of step 0, which are `anchor`. `moments` maps steps to observations and
    includes step 0. `start_digest` is that of the first observation as recorded.
    """

    episode_id: str
    task: str
    instruction: str
    scene: str
    success: bool
    anchor: AnchorPoses
    moments: Mapping[int, Moment]
    measured: Float64[np.ndarray, "steps 67"]
    commanded: Float64[np.ndarray, "steps 67"]
    start_digest: str

    @property
    def num_steps(self) -> int:
        """Steps of the model grid, including the first one."""
        return len(self.measured)


def read_cloning_episode(
    reader: EpisodeReader, *, image_px: int = USUAL_IMAGE_PX
) -> CloningEpisode:
    """Read one successful robot episode; only images at decision steps are decoded.

    Args:
        reader: the episode.
        image_px: side that the middle square of larger images is scaled to.

    Raises:
        InvalidInputError: no image at a decision step.
    """
    about = reader.attributes
    wanted = range(0, reader.num_steps, DECISION_STRIDE)
    missing = sorted(set(wanted) - set(reader.shown_steps(CAMERA)[0].tolist()))
    if missing:
        raise InvalidInputError(
            f"episode {about.episode_id!r}: no image of {CAMERA!r} at step {missing[0]}, expected "
            f"one at least every {DECISION_STRIDE} steps; record it with `dextouch train data "
            f"--images {DECISION_STRIDE}` or fewer"
        )
    first = reader.window(0, num_steps=reader.num_steps, cameras=())

    def images_of(step: int) -> UInt8[np.ndarray, "1 h w 3"]:
        return reader.window(step, num_steps=1, cameras=(CAMERA,)).images[CAMERA]

    def seen(step: int) -> UInt8[np.ndarray, "h w 3"]:
        return square_of_at_most(images_of(step), first.K_head, image_px)[0][0]

    return CloningEpisode(
        about.episode_id,
        about.task,
        about.instruction,
        scene_of(about),
        bool(about.success),
        first.anchor,
        {step: Moment(seen(step), first.tactile_kpa[step].copy()) for step in wanted},
        first.actions,
        _commanded(reader, first.actions),
        start_digest(images_of(0)[0], first.tactile_kpa[0]),
    )


def _commanded(
    reader: EpisodeReader, measured: Float64[np.ndarray, "steps 67"]
) -> Float64[np.ndarray, "steps 67"]:
    """Commands of every step; of robots that keep none, the poses that they reached."""
    if "action_commanded" not in reader.streams:
        return measured
    return reader.read("action_commanded").values


def read_cloning_episodes(
    *stores: EpisodeStore,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    image_px: int = USUAL_IMAGE_PX,
    origin: Literal["true", "imagined"] = "true",
) -> list[CloningEpisode]:
    """Read the successful robot episodes of some stores, store by store in the order of ids.

    Args:
        stores: stores to read.
        tasks: tasks to read; empty for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to.
        origin: whether true episodes are read or imagined ones, never both.

    Raises:
        NotFoundError: no such episode, or an empty store.
        ConflictError: two stores hold an episode of the same id.
    """
    readers = robot_episodes(
        stores,
        tasks=tasks,
        wanted=lambda about: (
            bool(about.success)
            and (about.origin == "imagined") == (origin == "imagined")
            and is_in(about, splits)
        ),
        what=f"{origin} robot episode that succeeded",
    )
    return [read_cloning_episode(reader, image_px=image_px) for reader in readers]


def cloning_hash(episodes: Sequence[CloningEpisode]) -> str:
    """SHA-256 of all training data, in the order of the episode ids."""
    digest = hashlib.sha256()
    for item in sorted(episodes, key=lambda e: e.episode_id):
        digest.update(repr((item.episode_id, item.task, item.instruction, item.success)).encode())
        for moment in (item.moments[step] for step in sorted(item.moments)):
            digest.update(np.ascontiguousarray(moment.image).tobytes())
            digest.update(np.ascontiguousarray(moment.tactile_kpa).tobytes())
        for array in (item.measured, item.commanded, *vars(item.anchor).values()):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
