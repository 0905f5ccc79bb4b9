"""Training episodes of behaviour cloning: successful robot episodes at decision steps only."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from dextouch.episodes import (
    TRUE_ORIGINS,
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    select_episodes,
)
from dextouch.hands.actions import AnchorPoses
from dextouch.schemas import Origin
from services.evaluation.policies.cloning_network import SLOT_STEPS
from services.evaluation.starts import start_digest
from services.networks.training_settings import USUAL_IMAGE_PX

# Training uses every such step; an evaluation with chunks of 16 decides at every second of them.
DECISION_STRIDE: Final = SLOT_STEPS
# What an episode of a cloned policy must have.
IMITATED: Final = (needs.WHOLE, needs.OUTCOME, needs.SUCCESS, needs.image_every(DECISION_STRIDE))


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
    content_sha256: str

    @property
    def num_steps(self) -> int:
        """Steps of the model grid, including the first one."""
        return len(self.measured)


def read_cloning_episode(
    reader: EpisodeReader, *, image_px: int = USUAL_IMAGE_PX
) -> CloningEpisode:
    """Read one robot episode; only images at decision steps are decoded.

    Args:
        reader: the episode; it must have what is `IMITATED`.
        image_px: side that the middle square of larger images is scaled to.

    Raises:
        InvalidInputError: the outcome is unknown.
    """
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    steps = range(0, len(grid), DECISION_STRIDE)
    touch_kpa, _ = grid.touch()
    return CloningEpisode(
        about.episode_id,
        about.task,
        about.instruction,
        grid.scene,
        grid.success,
        grid.anchor,
        {
            step: Moment(image, touch_kpa[step].copy())
            for step, image in zip(steps, grid.images(steps), strict=True)
        },
        grid.measured,
        grid.sent,
        start_digest(EpisodeGrid(reader).images([0])[0], touch_kpa[0]),
        grid.content_sha256,
    )


def read_cloning_episodes(
    *stores: EpisodeStore,
    tasks: Sequence[str] = (),
    splits: Collection[Split] = (),
    image_px: int = USUAL_IMAGE_PX,
    imagined: bool = False,
) -> list[CloningEpisode]:
    """Read the successful robot episodes of some stores, store by store in the order of ids.

    Args:
        stores: stores to read.
        tasks: tasks to read; empty for all.
        splits: splits of the scenes; empty for all.
        image_px: side that the middle square of larger images is scaled to.
        imagined: whether imagined episodes are read instead of true ones.

    Raises:
        NotFoundError, ConflictError: as `select_episodes`.
    """
    origins: Collection[Origin] = ("imagined",) if imagined else TRUE_ORIGINS
    readers = select_episodes(
        stores, domain="robot", tasks=tasks, splits=splits, origins=origins, needs=IMITATED
    )
    return [read_cloning_episode(reader, image_px=image_px) for reader in readers]
