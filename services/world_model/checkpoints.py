"""Files of trained models and tactile tokenizers: provenance, writing and strict reading."""

import hashlib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from operator import not_
from pathlib import Path
from typing import Final

import torch
from pydantic import Field, model_validator

from dextouch.episodes import Split, scene_fraction, scene_of, split_of_scene
from dextouch.errors import ConflictError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Domain, EpisodeAttributes
from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout
from services.networks.weight_files import (
    MAX_FILE_BYTES,
    available_memory,
    digest_of,
    half_weights,
    load_strictly,
    memory_of,
    notes_of,
    read_history,
    read_weights,
    refuse_non_finite,
    write_weights,
)
from services.world_model.dynamics.features import DynamicsConfig
from services.world_model.dynamics.model import DynamicsModel
from services.world_model.network.configuration import NetworkConfig, RendererConfig, TokenizerName
from services.world_model.network.model import JointWorldModel
from services.world_model.network.tactile import TactileTokenizer, build_tokenizer
from services.world_model.rendering.renderer import RendererNetwork

METADATA_KEY = "dextouch_world_model"
_STATE_KEY = "dextouch_state_model"
_TOKENIZER_KEY = "dextouch_tactile_tokenizer"
# Beginnings of tensor names.
_TEXT, _DYNAMICS, _RENDERER = "text_features.", "dynamics.", "renderer."
# Statistics missing from files of older releases; the network's defaults are used instead.
LATER_STATISTICS = ("tokenizer.peak_kpa",)
# Of the twin's episodes, in files of older releases.
HORIZON_LATENTS: Final = 20


class TrainingSet(FrozenModel):
    """Episodes of one domain that a model was trained on, or that it was evaluated on (held out).

    `tasks` has the number of episodes of each task, `data_hash` is that of the episodes,
    `window_share` the share of windows from the set, None where it follows from the number of
    episodes. `checkpoint` is the digest of the ancestor that was trained on the set, None for the
    checkpoint's own training.
    """

    domain: Domain
    heldout: bool = False
    tasks: dict[str, int]
    data_hash: str
    window_share: float | None = None
    checkpoint: str | None = None


def learned_tasks(sets: Iterable[TrainingSet]) -> set[str]:
    """Tasks of the sets that were trained on."""
    return {task for one in sets if not one.heldout for task in one.tasks}


class CheckpointMetadata(FrozenModel):
    """Provenance and measured accuracy of a model, stored in its checkpoint.

    `initialized_from` is the digest of the checkpoint that the weights were initialized from, whose
    training episodes count here, too, and `tokenizer_digest` that of the pretrained tokenizer's
    file. None is not written, so that older releases can read the file. `sets` are the episodes by
    domain, those of ancestors included; empty in files of older releases. `horizon_latents` is the
    length of the longest training episode. `text_dropout` and `action_dropout` are the shares of
    windows without instruction and without actions, of this training or of an ancestor's, and
    `view_dropout` that of windows without a further view, likewise; 0 where starts need them all.
    """

    format_version: int = 1
    name: str
    network: NetworkConfig
    tasks: tuple[str, ...]
    command: str
    seed: int
    training_steps: int
    training_cpu_s: float
    train_episode_ids: tuple[str, ...]
    train_fingerprints: tuple[str, ...]
    data_hash: str
    heldout_episode_ids: tuple[str, ...] = ()
    initialized_from: str | None = Field(default=None, exclude_if=not_)
    sets: tuple[TrainingSet, ...] = Field(default=(), exclude_if=not_)
    tokenizer_digest: str | None = Field(default=None, exclude_if=not_)
    horizon_latents: int = Field(default=HORIZON_LATENTS, ge=1, exclude_if=HORIZON_LATENTS.__eq__)
    text_dropout: float = Field(default=0.0, ge=0, le=1, exclude_if=not_)
    action_dropout: float = Field(default=0.0, ge=0, le=1, exclude_if=not_)
    view_dropout: float = Field(default=0.0, ge=0, le=1, exclude_if=not_)
    metrics: dict[str, float] = Field(default={})

    @property
    def is_guidable(self) -> bool:
        """Whether the model was trained on windows with neither instruction nor actions, too."""
        return min(self.text_dropout, self.action_dropout) > 0.0


@dataclass(frozen=True)
class Checkpoint:
    """A loaded model with its metadata and the digest of its file."""

    model: JointWorldModel
    metadata: CheckpointMetadata
    digest: str


def dropout_shares(text: float, action: float, ancestor: Checkpoint | None) -> tuple[float, float]:
    """Shares of windows for the metadata: a training's, or its ancestor's if it has none."""
    if ancestor is not None and not (text or action):
        return ancestor.metadata.text_dropout, ancestor.metadata.action_dropout
    return text, action


def write_checkpoint(path: Path, model: JointWorldModel, metadata: CheckpointMetadata) -> str:
    """Write the file atomically and return its digest; the full size with its text features."""
    if model.text_features is None:
        return write_weights(path, half_weights(model), metadata, METADATA_KEY)
    known = model.text_features.known
    tensors = {**model.state_dict(), **{_TEXT + key: value for key, value in known.items()}}
    refuse_non_finite(tensors, "weights to be written")
    return write_weights(path, tensors, metadata, METADATA_KEY)


def read_checkpoint(path: Path, *, max_bytes: int | None = None) -> Checkpoint:
    """Load a checkpoint strictly, in evaluation mode.

    By default, a file may have 64 MiB and what its network needs beyond, but of the full size the
    memory that is available.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError, NonFiniteError: as `read_weights`.
        InvalidInputError: unsupported format version; missing or unexpected tensors, wrong shapes.
    """
    if max_bytes is None:
        max_bytes = _default_limit(path)
    tensors, metadata, digest = read_weights(
        path, CheckpointMetadata, METADATA_KEY, max_bytes=max_bytes
    )
    model = JointWorldModel(metadata.network)
    if model.text_features is not None:
        keys = [name for name in tensors if name.startswith(_TEXT)]
        model.text_features.learn({key.removeprefix(_TEXT): tensors.pop(key) for key in keys})
    load_strictly({"": model}, tensors, where=f"checkpoint {path.name}", later=LATER_STATISTICS)
    return Checkpoint(model, metadata, digest)


def _default_limit(path: Path) -> int:
    """Bytes that a checkpoint may have, by the network of its metadata and the memory."""
    is_full_size = '"video_expert":"wan"' in notes_of(path).get(METADATA_KEY, "")
    if not is_full_size and (not path.is_file() or path.stat().st_size <= MAX_FILE_BYTES):
        return MAX_FILE_BYTES
    available = available_memory()
    limit = sys.maxsize if available is None else available
    if is_full_size:
        return limit
    if METADATA_KEY not in notes_of(path):
        return MAX_FILE_BYTES
    with torch.device("meta"):
        network = JointWorldModel(read_metadata(path).network)
    return min(limit, MAX_FILE_BYTES + memory_of(network.state_dict()))


def read_metadata(path: Path) -> CheckpointMetadata:
    """Metadata of a checkpoint without its weights; raises as `read_history`."""
    return read_history(path, CheckpointMetadata, METADATA_KEY)


def list_checkpoints(folder: Path) -> dict[Path, str]:
    """Every checkpoint file of a folder with its digest."""
    return {path: digest_of(path) for path in sorted(folder.glob("*.safetensors"))}


class StateBounds(FrozenModel):
    """Limits beyond which a rollout is flagged as uncertain, high quantiles over held-out episodes.

    Bounds `of_chunks` apply to the worst latent step of any 16 steps; those of older checkpoints to
    an episode's worst disagreement and mean distance.
    """

    disagreement_m: float = Field(default=1.0, ge=0, allow_inf_nan=False)
    distance: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    horizon_latents: int = Field(default=HORIZON_LATENTS, ge=1)
    of_chunks: bool = False

    @property
    def latent_distance(self) -> float:
        """Largest distance at which a latent step is not flagged, from the mean over an episode."""
        return self.distance * (1 if self.of_chunks else self.horizon_latents)


class StateMetadata(FrozenModel):
    """Provenance and measured accuracy of a state model, stored in its checkpoint.

    `training_seeds` are the first and last seed of every task, of the scenes in `training_splits`
    (all splits if empty; `task_splits` has those of tasks that differ) but the share
    `heldout_share`, by hash; `training_scenes` are `scene_digest` of recorded ones, without a seed.
    `object_sources` are the numbers of training episodes by the source of their object poses, or
    "none". `sets` are the episodes by domain, those of the models that it started from included;
    files of older releases have none.
    """

    format_version: int = 5
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
    task_splits: dict[str, tuple[Split, ...]] = Field(default={}, exclude_if=not_)
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

    def splits_of(self, task: str) -> tuple[Split, ...]:
        """Splits of a task's training scenes; none means all."""
        return self.task_splits.get(task, self.training_splits)

    def may_have_seen(self, task: str, seed: int) -> bool:
        """Whether a scene of the twin may be one of the training scenes."""
        low, high = self.training_seeds.get(task, (0, -1))
        splits = self.splits_of(task)
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
    return _STATE_KEY in notes_of(path)


def write_state_checkpoint(
    path: Path, dynamics: DynamicsModel, renderer: RendererNetwork, metadata: StateMetadata
) -> str:
    """Write the file atomically and return its digest."""
    tensors = half_weights(dynamics, prefix=_DYNAMICS) | half_weights(renderer, prefix=_RENDERER)
    return write_weights(path, tensors, metadata, _STATE_KEY)


def read_state_checkpoint(path: Path) -> StateCheckpoint:
    """Load a state model strictly, in float32 and evaluation mode.

    Raises:
        The errors of `read_checkpoint`.
    """
    tensors, metadata, digest = read_weights(path, StateMetadata, _STATE_KEY)
    dynamics = DynamicsModel(metadata.dynamics, metadata.num_members)
    renderer = RendererNetwork(metadata.renderer)
    models = {_DYNAMICS: dynamics, _RENDERER: renderer}
    load_strictly(models, tensors, where=f"checkpoint {path.name}")
    return StateCheckpoint(dynamics, renderer, metadata, digest)


class Reconstruction(FrozenModel):
    """Accuracy on hands of held-out scenes after some training steps."""

    step: int
    cpu_s: float
    mse_kpa2: float
    mae_kpa: float
    contact_iou: float
    contact_f1: float


class TokenizerMetadata(FrozenModel):
    """Provenance and accuracy of a tokenizer; `curve` is from the untrained to the stored one."""

    format_version: int = 1
    tokenizer: TokenizerName
    palm_channels: int
    tactile_channels: int
    command: str
    seed: int
    training_steps: int
    training_cpu_s: float
    num_parameters: int
    num_training_hands: int
    num_heldout_hands: int
    train_scenes: tuple[str, ...]
    data_hash: str
    layout: TactileLayout | None = Field(default=None, exclude_if=lambda layout: layout is None)
    curve: tuple[Reconstruction, ...] = Field(min_length=1)

    def network(self, config: NetworkConfig) -> NetworkConfig:
        """The configuration with this tokenizer.

        Raises:
            ConflictError: the configuration explicitly names other values.
        """
        size = "palm_channels" if self.tokenizer == "principal_axes" else "tactile_channels"
        ours = {"tokenizer": self.tokenizer, size: getattr(self, size)}
        given = {name: getattr(config, name) for name in config.model_fields_set & ours.keys()}
        others = {name: (ours[name], value) for name, value in given.items() if value != ours[name]}
        if others:
            raise ConflictError(
                "training: the tokenizer's file has other network settings (stored, requested): "
                f"{others}; leave them out"
            )
        return config.model_copy(update=ours).with_layout(self.layout or DEXTOUCH_V1)


@dataclass(frozen=True)
class StoredTokenizer:
    """A loaded tokenizer with its metadata and the digest of its file."""

    tokenizer: TactileTokenizer
    metadata: TokenizerMetadata
    digest: str


def is_tokenizer(path: Path) -> bool:
    """Whether a file declares a tactile tokenizer."""
    return _TOKENIZER_KEY in notes_of(path)


def write_tokenizer(path: Path, tokenizer: TactileTokenizer, metadata: TokenizerMetadata) -> str:
    """Write the file atomically and return its digest."""
    return write_weights(path, half_weights(tokenizer), metadata, _TOKENIZER_KEY)


def read_tokenizer(path: Path) -> StoredTokenizer:
    """Load a tokenizer strictly, in float32 and evaluation mode, with one token per hand.

    Raises:
        The errors of `read_checkpoint`.
    """
    tensors, metadata, digest = read_weights(path, TokenizerMetadata, _TOKENIZER_KEY)
    tokenizer = build_tokenizer(metadata.network(NetworkConfig()))
    load_strictly({"": tokenizer}, tensors, where=f"tokenizer {path.name}")
    return StoredTokenizer(tokenizer, metadata, digest)
