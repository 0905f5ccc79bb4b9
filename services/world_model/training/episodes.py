"""Episodes of a store as arrays on the model grid, and their split by hash."""

import hashlib
from collections.abc import Collection, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Float64, Int64

from dextouch.episodes import (
    EpisodeReader,
    EpisodeStore,
    Split,
    is_in,
    is_rejected,
    object_track,
    scene_of,
)
from dextouch.errors import InvalidInputError
from dextouch.images import square_of_at_most
from dextouch.schemas import ActionKind, Domain
from services.world_model.starts import CAMERA
from services.world_model.training.dataset import EpisodeArrays, TrainingEpisode

E = TypeVar("E", bound=TrainingEpisode)


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
        InvalidInputError: the store is empty, mixes model rates, or lacks the image of a step.
        UnknownNameError: an episode without the head camera.
    """
    store = EpisodeStore(url)
    ids = training_ids(store, splits, domain)
    episodes = [read_episode(store.open(one), image_px=image_px) for one in ids]
    check_rates({episode.model_rate_hz for episode in episodes}, url)
    return episodes


def training_ids(
    store: EpisodeStore, splits: Collection[Split] = (), domain: Domain | None = None
) -> list[str]:
    """Ids of the episodes of these splits and this domain (default: all).

    Imagined episodes and those that were rejected in review are left out.
    """
    return [
        episode_id
        for episode_id in store.list()
        if (about := store.open(episode_id).attributes).origin != "imagined"
        and is_in(about, splits)
        and domain in {None, about.domain}
        and not is_rejected(store, about)
    ]


def check_rates(rates_hz: set[float], url: str) -> None:
    """Reject an empty store and a store with several model rates.

    Raises:
        InvalidInputError: the store is empty or mixes model rates.
    """
    if not rates_hz:
        raise InvalidInputError(
            f"episodes: the store {url} has none, or none of the domain and splits asked for that "
            "was not rejected in review; record some first (dextouch train data)"
        )
    if len(rates_hz) > 1:
        raise InvalidInputError(
            f"episodes: the store {url} mixes model rates {sorted(rates_hz)} Hz, expected one"
        )


def read_episode(reader: EpisodeReader, *, image_px: int | None = None) -> EpisodeArrays:
    """Read a whole episode as a single window for each kind of action.

    The middle square of images that are larger than `image_px` is scaled to it.

    Raises:
        InvalidInputError: the image of a step is missing.
        UnknownNameError: an episode without the head camera.
    """
    reader.require_images(CAMERA)
    measured = reader.window(0, reader.num_steps, cameras=(CAMERA,))
    actions: dict[ActionKind, Float64[np.ndarray, "steps 67"]] = {"measured": measured.actions}
    if "action_commanded" in reader.streams:
        sent = reader.window(0, reader.num_steps, cameras=(), action_kind="commanded")
        actions["commanded"] = sent.actions
    attributes = reader.attributes
    images, K_head = square_of_at_most(measured.images[CAMERA], measured.K_head, image_px)
    poses, boxes_m = objects_of(reader, measured.t_ref_ns) or (None, None)
    return EpisodeArrays(
        episode_id=attributes.episode_id,
        task=attributes.task,
        instruction=attributes.instruction,
        scene=scene_of(attributes),
        images=images,
        tactile_kpa=measured.tactile_kpa,
        tactile_valid=measured.tactile_valid,
        actions=actions,
        anchor=measured.anchor,
        K_head=K_head,
        model_rate_hz=attributes.model_rate_hz,
        domain=attributes.domain,
        object_poses=poses,
        boxes_m=boxes_m,
    )


def objects_of(
    reader: EpisodeReader, t_ref_ns: Int64[np.ndarray, " steps"]
) -> tuple[Float32[np.ndarray, "steps objects 7"], Float64[np.ndarray, "objects 6"]] | None:
    """Poses of an episode's objects at given times and their boxes; None where unknown."""
    boxes_m = np.array(reader.attributes.object_boxes_m, dtype=np.float64).reshape(-1, 6)
    track = object_track(reader, t_ref_ns)
    # What is not known is not stated: a window's first step needs all of its objects.
    if track is None or not len(boxes_m) or not track.known.all():
        return None
    return track.poses, boxes_m


def subset_by_hash(episodes: Sequence[E], count: int | None, *, what: str) -> list[E]:
    """A number of episodes chosen by their content, in their order; None for all.

    A larger subset of the same episodes contains every smaller one.

    Raises:
        InvalidInputError: there are fewer; `what` names them.
    """
    if count is None:
        return list(episodes)
    if count > len(episodes):
        raise InvalidInputError(
            f"training: got {count} as the number of {what} episodes, expected at most the "
            f"{len(episodes)} there are; record more, or ask for fewer"
        )

    def place(index: int) -> str:
        content = episodes[index].content_hash()
        return hashlib.sha256(f"subset/{content}".encode()).hexdigest()

    chosen = sorted(range(len(episodes)), key=place)[:count]
    return [episodes[index] for index in sorted(chosen)]
