"""Files of pretrained tactile tokenizers, with their provenance and learning curve."""

from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from dextouch.errors import ConflictError
from dextouch.frozen_model import FrozenModel
from services.networks.weight_files import (
    half_weights,
    holds,
    load_strictly,
    read_weights,
    write_weights,
)
from services.world_model.network.configuration import NetworkConfig, TokenizerName
from services.world_model.network.tactile_tokenizers import TactileTokenizer, build_tokenizer

METADATA_KEY = "dextouch_tactile_tokenizer"


class Reconstruction(FrozenModel):
    """Accuracy on hands of held-out scenes after some training steps."""

    step: int
    cpu_s: float
    mse_kpa2: float
    mae_kpa: float
    contact_iou: float
    contact_f1: float


class TokenizerMetadata(FrozenModel):
    """Provenance and measured accuracy of a tokenizer.

    `train_scenes` are the scenes of the episodes trained on (`dextouch.episodes.scene_of`). `curve`
    begins with the untrained network and ends with the stored one.
    """

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
        return config.model_copy(update=ours)


@dataclass(frozen=True)
class StoredTokenizer:
    """A loaded tokenizer with its metadata and the digest of its file."""

    tokenizer: TactileTokenizer
    metadata: TokenizerMetadata
    digest: str


def is_tokenizer(path: Path) -> bool:
    """Whether a file declares a tactile tokenizer."""
    return holds(path, METADATA_KEY)


def write_tokenizer(path: Path, tokenizer: TactileTokenizer, metadata: TokenizerMetadata) -> str:
    """Write the file atomically and return its digest."""
    return write_weights(path, half_weights(tokenizer), metadata, METADATA_KEY)


def read_tokenizer(path: Path) -> StoredTokenizer:
    """Load a tokenizer strictly, in float32 and evaluation mode, with one token per hand.

    Raises:
        NotFoundError, LimitExceededError, CorruptDataError, NonFiniteError: as `read_weights`.
        InvalidInputError: unsupported format version; missing or unexpected tensors, wrong shapes.
    """
    tensors, metadata, digest = read_weights(path, TokenizerMetadata, METADATA_KEY)
    tokenizer = build_tokenizer(metadata.network(NetworkConfig()))
    load_strictly({"": tokenizer}, tensors, where=f"tokenizer {path.name}")
    return StoredTokenizer(tokenizer, metadata, digest)
