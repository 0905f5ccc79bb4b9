"""Replay of robot episodes in a served imagined world, to create imagined episodes."""

import hashlib
from collections.abc import Collection
from typing import Final

import numpy as np

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeReader, EpisodeStore, write_rollout
from dextouch.errors import InvalidInputError
from dextouch.schemas import LineageEntry, Observation, ReturnSelector, rollout_doubt

CAMERA: Final = "camera_head"
CHUNK_STEPS: Final = 16
SHORT_CHUNK_STEPS: Final = 4


def imagine_episode(
    source: EpisodeReader,
    client: RolloutClient,
    world: str,
    store: EpisodeStore,
    *,
    image_steps: Collection[int] | None = None,
) -> str:
    """Replay an episode's commanded actions in an imagined world and store the result.

    The imagined episode starts from the source's first observation. Its `success` is that of the
    *source*: the real outcome of the actions, and the label for training a success probe on
    imagined endings. Its lineage names the source and the world's digest. Object poses, if the
    world provides them, are the stream `object_poses`, from step 1 on; the world's doubt about the
    whole rollout, and its own estimate of success, are quality figures (`RolloutDoubt.to_quality`).

    Args:
        source: a robot episode with head camera, touch and commanded actions.
        client: of the service with the world.
        world: its name at the service.
        store: destination of the imagined episode.
        image_steps: steps whose images are needed; None for all. Images are kept for the chunks of
            four steps that contain one of these. Use it only with worlds whose state does not
            depend on chunk boundaries, since chunks are then shorter.

    Returns:
        Its id; equal source and world give an equal id, and an existing episode is kept.

    Raises:
        InvalidInputError: a source without commanded actions.
        UnknownNameError: no such world.
    """
    digests = {description.name: description.digest for description in client.worlds()}
    attributes = source.attributes
    name = imagined_id(attributes.episode_id, digests.get(world, world))
    if store.exists(name):
        return name
    if "action_commanded" not in source.streams:
        raise InvalidInputError(
            f"episode {attributes.episode_id!r}: has no commanded actions to replay in {world!r}"
        )
    commanded = source.read("action_commanded").values
    seen = _played(source, commanded, client, world, image_steps)
    lineage = (
        *attributes.lineage,
        LineageEntry(kind="episode", id=attributes.episode_id, sha256=source.content_sha256),
        LineageEntry(kind="checkpoint", id=world, sha256=_sha256(digests.get(world, ""))),
    )
    imagined = attributes.model_copy(
        update={
            "episode_id": name,
            "origin": "imagined",
            "lineage": lineage,
            "object_names": (),
            "object_boxes_m": (),
            "event_times_s": {},
            "generator_command": None,
            "streams": (),
            "quality": attributes.quality | rollout_doubt(seen).to_quality(),
        }
    )
    write_rollout(store, imagined, seen, commanded)
    return name


def _played(
    source: EpisodeReader,
    commanded: np.ndarray,
    client: RolloutClient,
    world: str,
    image_steps: Collection[int] | None,
) -> list[Observation]:
    """Observations of the world for an episode's commands, including the first one."""
    attributes = source.attributes
    window = source.window(0, source.num_steps, cameras=(CAMERA,))
    first = Observation(
        first_step=0,
        images={CAMERA: window.images[CAMERA][:1]},
        tactile_kpa=window.tactile_kpa[:1],
        action_reached=window.actions[:1],
        reached_is_measured=True,
    )
    with client.start(
        world=world,
        task=attributes.task,
        seed=attributes.seed or 0,
        instruction=attributes.instruction,
        init=(first, window.anchor, window.K_head),
    ) as rollout:
        return [
            first,
            *(
                rollout.step(
                    commanded[begin:end],
                    selector=None if shown else ReturnSelector(cameras=()),
                )
                for begin, end, shown in _chunks(len(commanded), image_steps)
            ),
        ]


def _chunks(num_steps: int, image_steps: Collection[int] | None) -> list[tuple[int, int, bool]]:
    """First step, end step and image request of every chunk."""
    if image_steps is None:
        firsts = range(1, num_steps, CHUNK_STEPS)
        return [(first, min(first + CHUNK_STEPS, num_steps), True) for first in firsts]
    chunks: list[tuple[int, int, bool]] = []
    for first in range(1, num_steps, SHORT_CHUNK_STEPS):
        end = min(first + SHORT_CHUNK_STEPS, num_steps)
        shown = any(first <= step < end for step in image_steps)
        if chunks and not shown and not chunks[-1][2] and end - chunks[-1][0] <= CHUNK_STEPS:
            chunks[-1] = (chunks[-1][0], end, False)
        else:
            chunks.append((first, end, shown))
    return chunks


def imagined_id(episode_id: str, world_digest: str) -> str:
    """Id of an imagined episode, from its source and an abbreviated world digest."""
    return f"imagined-{world_digest[:8]}-{episode_id}"


def _sha256(digest: str) -> str | None:
    return digest if len(digest) == hashlib.sha256().digest_size * 2 else None
