"""Rollouts of a study as episodes, to be played, rated or trained on."""

import re
from typing import Final

from dextouch.episodes import EpisodeStore, write_rollout
from dextouch.schemas import (
    EpisodeAttributes,
    LineageEntry,
    Origin,
    StoredAnchor,
    WorldDescription,
    matrix_rows,
)
from services.evaluation.matched_starts import MatchedStart
from services.evaluation.rollout_runner import PlayedRollout
from services.evaluation.studies.results import PlannedRollout, StudyHeader, rollout_episode_id

_ORIGINS: Final[dict[str, Origin]] = {"twin": "twin", "robot": "recorded"}


def keep_rollout(
    store: EpisodeStore,
    header: StudyHeader,
    cell: PlannedRollout,
    start: MatchedStart,
    played: PlayedRollout,
    world: WorldDescription,
) -> None:
    """Store a rollout, unless a killed run of the study has done so already.

    `success` is the one reported by the world itself, never the probe's estimate.
    """
    episode_id = rollout_episode_id(header, cell)
    if store.exists(episode_id):
        return
    is_digest = re.fullmatch(r"[0-9a-f]{64}", world.digest) is not None
    attributes = EpisodeAttributes(
        episode_id=episode_id,
        task=cell.task,
        instruction=start.instruction,
        domain="robot",
        origin=_ORIGINS.get(world.kind, "imagined"),
        seed=cell.seed,
        model_rate_hz=world.model_rate_hz,
        anchor=StoredAnchor.from_poses(start.anchor),
        K_head=matrix_rows(start.K_head),
        success=played.success,
        quality=played.doubt.to_quality(),
        trace_id=played.trace_id,
        lineage=(
            LineageEntry(kind="rollout", id=f"{header.name}: {cell.policy} in {cell.world}"),
            LineageEntry(
                kind="checkpoint", id=world.name, sha256=world.digest if is_digest else None
            ),
        ),
    )
    write_rollout(store, attributes, played.observations, played.commanded)
