"""Loads the pretrained parts of the full-size model from a local folder, before training."""

from pathlib import Path

from torch import nn

from dextouch.errors import InvalidInputError
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.model import JointWorldModel
from services.world_model.network.video import (
    WanBlock,
    WanVideoCodec,
    WanVideoCondition,
    WanVideoExpert,
)
from services.world_model.wan.configuration import WanFiles
from services.world_model.wan.loading import (
    TRANSFORMER_RULES,
    autoencoder_rules,
    find_weights,
    load_weights,
)

_STEM = "diffusion_pytorch_model"
_ORIGINAL_AUTOENCODER = "Wan2.2_VAE"


def initial_model(
    config: NetworkConfig, files: WanFiles, *, filled_later: bool = False
) -> JointWorldModel:
    """A new model; that of the full size begins with the pretrained weights of its files.

    Args:
        config: network to build.
        files: pretrained networks; unused by the small size.
        filled_later: a checkpoint replaces all weights, so that files are not needed.

    Raises:
        InvalidInputError: the full size without a folder.
        NotFoundError, CorruptDataError, LimitExceededError, NonFiniteError: as `load_weights`.
    """
    model = JointWorldModel(config)
    if model.text_features is None:
        return model
    if files.folder is not None:
        load_pretrained(model, files.folder, max_bytes=files.max_bytes)
    elif filled_later:
        for module in model.modules():
            if any(tensor.is_meta for tensor in module.parameters(recurse=False)):
                module.to_empty(device="cpu", recurse=False)
    else:
        raise InvalidInputError(
            "pretrained video expert: got no folder; give the local folder of Wan2.2-TI2V-5B "
            "with --wan.folder, or --init with a checkpoint of the full size"
        )
    model.text_features.use(files.folder, files.text_cache)
    return model


def share_texts(source: JointWorldModel, target: JointWorldModel) -> None:
    """Give a model the text features that another knows."""
    if source.text_features is not None and target.text_features is not None:
        target.text_features.learn(source.text_features.known)


def load_pretrained(model: JointWorldModel, folder: Path, *, max_bytes: int | None = None) -> None:
    """Load transformer and autoencoder, and use the folder's text encoder when it is needed.

    Args:
        model: of the full size; its other parts keep their initial weights.
        folder: Wan2.2-TI2V-5B in diffusers' layout (`transformer`, `vae`, `text_encoder`,
            `tokenizer`), or transformer and autoencoder under their original names.
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
    condition.text_features.use(folder)


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
