"""Checkpoints of state models: dynamics, renderer and metadata in one safetensors file."""

import hashlib
from dataclasses import dataclass
from operator import not_
from pathlib import Path

from pydantic import Field, model_validator

from dextouch.episodes import Split, scene_fraction, scene_of, split_of_scene
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import EpisodeAttributes
from services.networks.weight_files import (
    half_weights,
    holds,
    load_strictly,
    read_weights,
    write_weights,
)
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.rendering.configuration import RendererConfig
from services.world_model.rendering.network import RendererNetwork
from services.world_model.training_set import TrainingSet

FORMAT_VERSION = 5
METADATA_KEY = "dextouch_state_model"
_DYNAMICS, _RENDERER = "dynamics.", "renderer."


class StateBounds(FrozenModel):
    """Limits beyond which a rollout is flagged as uncertain.

    `disagreement_m` and `distance` are high quantiles over held-out episodes; `horizon_latents` is
    the length of the episodes that the cores were trained on. Bounds `of_chunks` apply to the worst
    latent step of any 16 steps of an episode; those of older checkpoints apply to whole episodes:
    to the worst disagreement and the mean distance.
    """

    disagreement_m: float = Field(default=1.0, ge=0, allow_inf_nan=False)
    distance: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    horizon_latents: int = Field(default=20, ge=1)
    of_chunks: bool = False

    @property
    def latent_distance(self) -> float:
        """Largest distance at which a latent step is not flagged.

        If the bound is on the mean over an episode, no step exceeds that mean times the number of
        steps.
        """
        return self.distance * (1 if self.of_chunks else self.horizon_latents)


class StateMetadata(FrozenModel):
    """Provenance and measured accuracy of a state model, stored in its checkpoint.

    `training_seeds` are the first and last seed of every task, of the scenes in `training_splits`
    (all splits if empty) but the share `heldout_share`, by hash; `training_scenes` are
    `scene_digest` of those without a seed, which a station recorded. `object_sources` are the
    numbers of training episodes whose object poses are from the twin, markers, trackers or clicks,
    and of those without any ("none"). `sets` are the episodes by domain, those of the models that
    it started from included; files of older releases have none.
    """

    format_version: int = FORMAT_VERSION
    name: str
    dynamics: DynamicsConfig
    num_members: int = Field(ge=1, le=16)
    renderer: RendererConfig
    object_names: dict[str, tuple[str, ...]]
    object_boxes_m: dict[str, tuple[tuple[float, ...], ...]]
    model_rate_hz: float = 15.0
    bounds: StateBounds = StateBounds()
    command: str
    seed: int
    training_cpu_s: float
    num_training_episodes: int
    training_seeds: dict[str, tuple[int, int]]
    training_splits: tuple[Split, ...] = ()
    heldout_share: float | None = Field(default=None, exclude_if=not_)
    training_scenes: tuple[str, ...] = Field(default=(), exclude_if=not_)
    data_hash: str
    object_sources: dict[str, int] = Field(default={}, exclude_if=not_)
    sets: tuple[TrainingSet, ...] = Field(default=(), exclude_if=not_)
    metrics: dict[str, float] = Field(default={})

    def may_have_seen_episode(self, about: EpisodeAttributes) -> bool:
        """Whether the scene of an episode may be one of the training scenes."""
        if about.seed is None:
            return scene_digest(scene_of(about)) in self.training_scenes
        return self.may_have_seen(about.task, about.seed)

    def may_have_seen(self, task: str, seed: int) -> bool:
        """Whether a scene of the twin may be one of the training scenes."""
        low, high = self.training_seeds.get(task, (0, -1))
        splits = self.training_splits
        is_heldout = scene_fraction(f"{task}/{seed}") < (self.heldout_share or 0.0)
        is_in_splits = not splits or split_of_scene(task, seed) in splits
        return low <= seed <= high and is_in_splits and not is_heldout

    @model_validator(mode="after")
    def _names_and_boxes_fit_the_tasks(self) -> "StateMetadata":
        for task, count in zip(self.dynamics.tasks, self.dynamics.num_objects, strict=True):
            boxes = self.object_boxes_m.get(task, ())
            if (
                len(self.object_names.get(task, ())) != count
                or [len(b) for b in boxes] != [6] * count
            ):
                raise ValueError(
                    f"task {task!r}: got names {self.object_names.get(task)} and {len(boxes)} "
                    f"boxes, expected {count} of each, six numbers a box"
                )
        return self


def scene_digest(scene: str) -> str:
    """Short digest of a scene, as checkpoints list them."""
    return hashlib.sha256(scene.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class StateCheckpoint:
    """A loaded state model with its metadata and the digest of its file."""

    dynamics: DynamicsModel
    renderer: RendererNetwork
    metadata: StateMetadata
    digest: str


def is_state_checkpoint(path: Path) -> bool:
    """Whether the metadata of a safetensors file declares a state model."""
    return holds(path, METADATA_KEY)


def write_state_checkpoint(
    path: Path, dynamics: DynamicsModel, renderer: RendererNetwork, metadata: StateMetadata
) -> str:
    """Write the file atomically and return its digest."""
    tensors = half_weights(dynamics, prefix=_DYNAMICS) | half_weights(renderer, prefix=_RENDERER)
    return write_weights(path, tensors, metadata, METADATA_KEY)


def read_state_checkpoint(path: Path) -> StateCheckpoint:
    """Load a state model strictly, in float32 and evaluation mode.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError, NonFiniteError: as `read_weights`.
        InvalidInputError: unsupported format version; missing or unexpected tensors, wrong shapes.
    """
    tensors, metadata, digest = read_weights(path, StateMetadata, METADATA_KEY)
    dynamics = DynamicsModel(metadata.dynamics, metadata.num_members)
    renderer = RendererNetwork(metadata.renderer)
    models = {_DYNAMICS: dynamics, _RENDERER: renderer}
    load_strictly(models, tensors, where=f"checkpoint {path.name}")
    return StateCheckpoint(dynamics, renderer, metadata, digest)
