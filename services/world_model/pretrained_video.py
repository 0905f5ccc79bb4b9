"""Loads the pretrained parts of the full-size model from a local folder, before training."""

from pathlib import Path

from torch import nn

from dextouch.errors import InvalidInputError
from services.world_model.network.model import JointWorldModel
from services.world_model.network.wan_codec import WanVideoCodec
from services.world_model.network.wan_video import WanBlock, WanVideoCondition, WanVideoExpert
from services.world_model.wan.loading import find_weights, load_weights
from services.world_model.wan.renaming import TRANSFORMER_RULES, autoencoder_rules

_STEM = "diffusion_pytorch_model"
_ORIGINAL_AUTOENCODER = "Wan2.2_VAE"


def load_pretrained(
    model: JointWorldModel,
    folder: Path,
    *,
    text_cache: Path | None = None,
    max_bytes: int | None = None,
) -> None:
    """Load transformer and autoencoder, and use the folder's text encoder when it is needed.

    Args:
        model: of the full size; its other parts keep their initial weights.
        folder: Wan2.2-TI2V-5B in diffusers' layout (`transformer`, `vae`, `text_encoder`,
            `tokenizer`), or transformer and autoencoder under their original names.
        text_cache: folder for text features; None keeps them in memory and in checkpoints.
        max_bytes: limit of memory for each network; None for the memory that is available.

    Raises:
        InvalidInputError: a model of the small size, or weights that do not fit its sizes.
        NotFoundError, CorruptDataError, LimitExceededError, NonFiniteError: as `load_weights`.
    """
    wan, codec, condition, expert = (
        model.config.wan,
        model.codec,
        model.video_condition,
        model.video,
    )
    if (
        wan is None
        or not isinstance(codec, WanVideoCodec)
        or not isinstance(condition, WanVideoCondition)
        or not isinstance(expert, WanVideoExpert)
    ):
        raise InvalidInputError(
            "pretrained video expert: got video_expert tiny, expected wan; use --preset wan22-5b"
        )
    blocks = [layer.video for layer in model.layers if isinstance(layer.video, WanBlock)]
    transformer = _Transformer(expert, condition, blocks)
    where = "Wan2.2 transformer"
    inner = folder / "transformer"
    stored = find_weights(inner if inner.is_dir() else folder, stem=_STEM, where=where)
    load_weights(transformer, stored, TRANSFORMER_RULES, where=where, max_bytes=max_bytes)
    # The only tensor that belongs to no module of its own.
    expert.scale_shift_table = transformer.scale_shift_table
    where = "Wan2.2 autoencoder"
    inner = folder / "vae"
    stored = (
        find_weights(inner, stem=_STEM, where=where)
        if inner.is_dir()
        else find_weights(folder, stem=_ORIGINAL_AUTOENCODER, where=where)
    )
    rules = autoencoder_rules(wan.vae_blocks)
    load_weights(codec.autoencoder, stored, rules, where=where, max_bytes=max_bytes)
    condition.text_features.use(folder, text_cache)


class _Transformer(nn.Module):
    """The parts of the transformer under diffusers' names; they stay parts of the model."""

    def __init__(
        self, expert: WanVideoExpert, condition: WanVideoCondition, blocks: list[WanBlock]
    ) -> None:
        super().__init__()
        self.patch_embedding = expert.patch_embedding
        self.condition_embedder = condition.embedder
        self.blocks = nn.ModuleList(block.block for block in blocks)
        self.proj_out = expert.proj_out
        self.scale_shift_table = expert.scale_shift_table
