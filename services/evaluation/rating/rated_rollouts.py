"""Rollouts of an episode store as raters see them: prompts, and pictures of image and touch."""

from collections.abc import Collection
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from dextouch.episodes import EpisodeReader, EpisodeStore
from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.images import encode_jpeg
from services.evaluation.rating.rating_queue import RatedRollout, token_of
from services.evaluation.reporting.pictures import touch_image

CAMERA: Final = "camera_head"
IMAGE_HEIGHT_PX: Final = 384
_BACKGROUND: Final = 24


def rated_rollouts(store: EpisodeStore, tasks: Collection[str]) -> dict[str, RatedRollout]:
    """Rollouts of a store that have head images, by episode id.

    Args:
        store: of episodes.
        tasks: tasks with a rubric; episodes of others are left out.

    Raises:
        InvalidInputError: nothing to rate.
    """
    found = {}
    for episode_id in store.list():
        episode = store.open(episode_id)
        about = episode.attributes
        if about.task in tasks and CAMERA in episode.streams:
            found[episode_id] = RatedRollout(
                token_of(episode_id),
                episode_id,
                about.task,
                about.instruction,
                episode.num_steps,
                about.model_rate_hz,
            )
    if not found:
        raise InvalidInputError(
            f"store {store.root}: holds no episode with the stream {CAMERA} of "
            f"{', '.join(sorted(tasks))}"
        )
    return found


class RolloutPictures:
    """JPEG pictures of single steps: the head image beside taxel maps of both hands."""

    def __init__(self, store: EpisodeStore) -> None:
        self._store = store
        # A rater's page asks for the steps of one rollout after the other.
        self._opened = lru_cache(maxsize=16)(self._read)

    def step(self, episode_id: str, step: int) -> bytes:
        """JPEG of one step; where it has no image, of the nearest one.

        Raises:
            NotFoundError: no such step.
        """
        images, tactile_kpa = self._opened(episode_id)
        if not 0 <= step < len(images):
            raise NotFoundError(f"step {step}: the rollout has the steps 0 … {len(images) - 1}")
        return encode_jpeg(side_by_side(images[step], tactile_kpa[step]))

    def _read(
        self, episode_id: str
    ) -> tuple[UInt8[np.ndarray, "steps h w 3"], Float32[np.ndarray, "steps 2 320"]]:
        episode: EpisodeReader = self._store.open(episode_id)
        window = episode.window(0, episode.num_steps, cameras=(CAMERA,))
        return window.images[CAMERA], window.tactile_kpa


def side_by_side(
    image: UInt8[np.ndarray, "h w 3"], tactile_kpa: Float32[np.ndarray, "2 320"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The image, enlarged, beside the taxel maps of the left and the right hand."""
    height, width = image.shape[:2]
    size = (round(width * IMAGE_HEIGHT_PX / height), IMAGE_HEIGHT_PX)
    shown = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
    touch = Image.fromarray(touch_image(tactile_kpa))
    scale = min(IMAGE_HEIGHT_PX / touch.height, size[0] / touch.width)
    touch = touch.resize((round(touch.width * scale), round(touch.height * scale)))
    canvas = Image.new("RGB", (size[0] + touch.width + 8, IMAGE_HEIGHT_PX), (_BACKGROUND,) * 3)
    canvas.paste(shown, (0, 0))
    canvas.paste(touch, (size[0] + 8, (IMAGE_HEIGHT_PX - touch.height) // 2), touch)
    return np.asarray(canvas)
