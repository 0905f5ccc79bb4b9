"""Episodes of a store in memory, and subsets of them by their content."""

from collections.abc import Collection
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.episodes import (
    EpisodeGrid,
    EpisodeReader,
    EpisodeStore,
    Split,
    needs,
    select_episodes,
)
from dextouch.schemas import ActionKind, Domain
from dextouch.streams import HEAD_CAMERA
from services.world_model.training.dataset import EpisodeArrays

# What an episode must have for windows to be cut from it.
CUT: Final = (needs.EVERY_IMAGE,)


def load_episodes(
    url: str,
    *,
    splits: Collection[Split] = (),
    domain: Domain | None = None,
    image_px: int | None = None,
) -> list[EpisodeArrays]:
    """Episodes of a store, read once into memory: those of the given splits and domain.

    The middle square of images that are larger than `image_px` is scaled to it.

    Raises:
        NotFoundError, ConflictError: as `select_episodes`.
    """
    readers = select_episodes([EpisodeStore(url)], domain=domain, splits=splits, needs=CUT)
    return [read_episode(reader, image_px=image_px) for reader in readers]


def read_episode(reader: EpisodeReader, *, image_px: int | None = None) -> EpisodeArrays:
    """Read a whole episode.

    The middle square of images that are larger than `image_px` is scaled to it.

    Raises:
        InvalidInputError: the image of a step is missing.
        UnknownNameError: an episode without the head camera.
    """
    reader.require_images(HEAD_CAMERA)
    grid, about = EpisodeGrid(reader, image_px), reader.attributes
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]] = {"measured": grid.measured}
    if grid.action_kind == "commanded":
        actions["commanded"] = reader.actions(0, len(grid), kind="commanded")
    tactile_kpa, tactile_valid = grid.touch()
    poses, boxes_m = grid.boxed_objects(grid.t_ref_ns) or (None, None)
    return EpisodeArrays(
        episode_id=about.episode_id,
        task=about.task,
        instruction=about.instruction,
        scene=grid.scene,
        images=grid.images(range(len(grid))),
        tactile_kpa=tactile_kpa,
        tactile_valid=tactile_valid,
        actions=actions,
        anchor=grid.anchor,
        K_head=grid.K_head,
        model_rate_hz=about.model_rate_hz,
        content_sha256=grid.content_sha256,
        domain=about.domain,
        object_poses=poses,
        boxes_m=boxes_m,
    )
