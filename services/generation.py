"""Replay of robot episodes in a served imagined world, to create imagined episodes."""

import hashlib
from collections.abc import Collection
from typing import Final

import numpy as np
from jaxtyping import Float64

from dextouch.clients import RolloutClient
from dextouch.episodes import EpisodeGrid, EpisodeReader, EpisodeStore, write_rollout
from dextouch.errors import UnknownNameError
from dextouch.schemas import (
    CHUNK_STEPS,
    LineageEntry,
    Observation,
    ReturnSelector,
    WorldDescription,
    matrix_rows,
    rollout_uncertainty,
)
from dextouch.tactile.layout import TactileLayout

SHORT_CHUNK_STEPS: Final = 4
_MAX_ID_LENGTH: Final = 128


def imagine_episode(
    source: EpisodeReader,
    client: RolloutClient,
    world: str,
    store: EpisodeStore,
    *,
    image_steps: Collection[int] | None = None,
) -> str:
    """Replay an episode's actions in an imagined world and store the result.

    The imagined episode starts from the source's first observation, as the world sees it: its
    images have the world's size. Of its steps, what is left over of a chunk of the world at the end
    is cut off. Actions are the commanded ones, or those that were reached if the robot keeps no
    commands. Its `success` is that of the *source*: the real outcome of the actions, and the label
    for training a success classifier on imagined endings. Its lineage names the source and the
    world's digest. Object poses, if the world provides them, are the stream `object_poses`, from
    step 1 on; the world's uncertainty about the whole rollout, and its own estimate of success, are
    quality figures (`RolloutUncertainty.to_quality`).

    With `image_steps`, images are kept of the chunks of four steps that contain one of these. Use
    it only with worlds whose state does not depend on chunk boundaries, since chunks are then
    shorter.

    Returns its id; equal source and world give an equal id, and an existing episode is kept. Raises
    UnknownNameError for no such world, or a source without head camera, and InvalidInputError for a
    source with other steps a second than the world.
    """
    described = {description.name: description for description in client.worlds()}
    if world not in described:
        raise UnknownNameError("world", world, list(described))
    description, attributes = described[world], source.attributes
    name = imagined_id(attributes.episode_id, description.digest)
    if store.exists(name):
        return name
    seen, K_head, actions = _played(source, client, description, image_steps)
    lineage = (
        *attributes.lineage,
        LineageEntry(kind="episode", id=attributes.episode_id, sha256=source.content_sha256),
        LineageEntry(kind="checkpoint", id=world, sha256=_sha256(description.digest)),
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
            # The source's lens and refused taxels are not the world's; its actions were played.
            "calibration": {
                k: v for k, v in attributes.calibration.items() if k.startswith("interpolated_")
            },
            "streams": (),
            "K_head": matrix_rows(K_head),
            "quality": attributes.quality | rollout_uncertainty(seen).to_quality(),
        }
    )
    write_rollout(
        store, imagined, seen, actions, layout=TactileLayout.of(description.tactile_layout)
    )
    return name


def _played(
    source: EpisodeReader,
    client: RolloutClient,
    world: WorldDescription,
    image_steps: Collection[int] | None,
) -> tuple[list[Observation], Float64[np.ndarray, "3 3"], Float64[np.ndarray, "steps 67"]]:
    """Observations of the world for an episode's actions, its camera, and these actions."""
    attributes, grid = source.attributes, EpisodeGrid(source)
    world.check_rate(attributes.model_rate_hz, of=f"episode {attributes.episode_id!r}")
    actions = grid.sent[: whole_steps(len(grid), world.chunk_multiple)]
    with client.start(
        world=world.name,
        task=attributes.task,
        seed=attributes.seed or 0,
        instruction=attributes.instruction,
        init=(grid.observation(0, world.optional_cameras), grid.anchor, grid.K_head),
        action_kind=grid.action_kind,
    ) as rollout:
        seen = [
            rollout.observation,
            *(
                rollout.step(
                    actions[begin:end], selector=None if is_rendered else ReturnSelector(cameras=())
                )
                for begin, end, is_rendered in _chunks(len(actions), image_steps)
            ),
        ]
        return seen, rollout.K_head, actions


def whole_steps(num_steps: int, chunk_multiple: int) -> int:
    """Steps of an episode, the first included, up to the end of its last whole chunk."""
    return num_steps - (num_steps - 1) % chunk_multiple


def _chunks(num_steps: int, image_steps: Collection[int] | None) -> list[tuple[int, int, bool]]:
    if image_steps is None:
        firsts = range(1, num_steps, CHUNK_STEPS)
        return [(first, min(first + CHUNK_STEPS, num_steps), True) for first in firsts]
    chunks: list[tuple[int, int, bool]] = []
    for first in range(1, num_steps, SHORT_CHUNK_STEPS):
        end = min(first + SHORT_CHUNK_STEPS, num_steps)
        is_rendered = any(first <= step < end for step in image_steps)
        if chunks and not is_rendered and not chunks[-1][2] and end - chunks[-1][0] <= CHUNK_STEPS:
            chunks[-1] = (chunks[-1][0], end, False)
        else:
            chunks.append((first, end, is_rendered))
    return chunks


def imagined_id(episode_id: str, world_digest: str) -> str:
    """Id of an imagined episode, from world digest and source; a long id is cut and digested."""
    name = f"imagined-{world_digest[:8]}-{episode_id}"
    if len(name) <= _MAX_ID_LENGTH:
        return name
    digest = hashlib.sha256(episode_id.encode()).hexdigest()[:16]
    return f"{name[: _MAX_ID_LENGTH - len(digest) - 1]}-{digest}"


def _sha256(digest: str) -> str | None:
    return digest if len(digest) == hashlib.sha256().digest_size * 2 else None
