"""Weights of the full-size model's pretrained parts, loaded strictly from a local folder.

Files are safetensors in the original or in diffusers' layout, whole or sharded. Names, shapes and
the memory needed are checked from the files' headers before any weight is read. Nothing is ever
downloaded.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from services.networks.weight_files import check_memory, memory_of, refuse_non_finite
from services.world_model.network.configuration import NetworkConfig, WanFiles
from services.world_model.network.model import JointWorldModel
from services.world_model.network.video import (
    WanBlock,
    WanVideoCodec,
    WanVideoCondition,
    WanVideoExpert,
)

# Names of a tensor, original and in diffusers; `#` stands for a number and `*` for the last part of
# a name. Every tensor has exactly one rule.
Rules = tuple[tuple[str, str], ...]
_STEM = "diffusion_pytorch_model"
_ORIGINAL_AUTOENCODER = "Wan2.2_VAE"
_INDEX_SUFFIX: Final = ".safetensors.index.json"
_CONVERT: Final = (
    "load the .pth file with torch.load(..., weights_only=True) once and store it with "
    "safetensors.torch.save_file"
)
_ATTENTIONS: Rules = (("self_attn", "attn1"), ("cross_attn", "attn2"))
_PROJECTIONS: Rules = (
    ("q", "to_q"),
    ("k", "to_k"),
    ("v", "to_v"),
    ("o", "to_out.0"),
    ("norm_q", "norm_q"),
    ("norm_k", "norm_k"),
)
TRANSFORMER_RULES: Rules = (
    ("patch_embedding.*", "patch_embedding.*"),
    ("time_embedding.0.*", "condition_embedder.time_embedder.linear_1.*"),
    ("time_embedding.2.*", "condition_embedder.time_embedder.linear_2.*"),
    ("time_projection.1.*", "condition_embedder.time_proj.*"),
    ("text_embedding.0.*", "condition_embedder.text_embedder.linear_1.*"),
    ("text_embedding.2.*", "condition_embedder.text_embedder.linear_2.*"),
    ("head.head.*", "proj_out.*"),
    ("head.modulation", "scale_shift_table"),
    ("blocks.#.modulation", "blocks.#.scale_shift_table"),
    # The only norm with weights stands second in a block; diffusers counts in that order.
    ("blocks.#.norm3.*", "blocks.#.norm2.*"),
    ("blocks.#.ffn.0.*", "blocks.#.ffn.net.0.proj.*"),
    ("blocks.#.ffn.2.*", "blocks.#.ffn.net.2.*"),
    *(
        (f"blocks.#.{theirs}.{part}.*", f"blocks.#.{ours}.{renamed_part}.*")
        for theirs, ours in _ATTENTIONS
        for part, renamed_part in _PROJECTIONS
    ),
)
_RESIDUAL: Rules = (
    ("residual.0.*", "norm1.*"),
    ("residual.2.*", "conv1.*"),
    ("residual.3.*", "norm2.*"),
    ("residual.6.*", "conv2.*"),
)


def initial_model(
    config: NetworkConfig, files: WanFiles, *, filled_later: bool = False
) -> JointWorldModel:
    """A new model; that of the full size begins with the pretrained weights of its files.

    With `filled_later`, a checkpoint replaces all weights, so that files are not needed.

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
    wan, codec = model.config.wan, model.codec
    condition, expert = model.video_condition, model.video
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
    for network, rules, where, inner, original_stem in (
        (transformer, TRANSFORMER_RULES, "Wan2.2 transformer", folder / "transformer", _STEM),
        (
            codec.autoencoder, autoencoder_rules(wan.vae_blocks), "Wan2.2 autoencoder",
            folder / "vae", _ORIGINAL_AUTOENCODER,
        ),
    ):  # fmt: skip
        place, stem = (inner, _STEM) if inner.is_dir() else (folder, original_stem)
        stored = find_weights(place, stem=stem, where=where)
        load_weights(network, stored, rules, where=where, max_bytes=max_bytes)
    # The only tensor that belongs to no module of its own.
    expert.scale_shift_table = transformer.scale_shift_table
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


@dataclass(frozen=True)
class StoredWeights:
    """Weight files of one network; `shapes` by the names in the files."""

    files: tuple[Path, ...]
    shapes: Mapping[str, tuple[int, ...]]


def find_weights(folder: Path, *, stem: str, where: str) -> StoredWeights:
    """Find the files of a network, whose names begin with `stem`, and read their headers.

    Raises:
        NotFoundError: no such folder or file, or a shard is missing.
        CorruptDataError: a damaged index or header, or a tensor in two files.
        InvalidInputError: only pickled weights.
    """
    files = _files(folder, stem, where)
    shapes: dict[str, tuple[int, ...]] = {}
    for file in files:
        try:
            with safe_open(file, framework="pt") as opened:
                for name in opened.keys():  # noqa: SIM118
                    if name in shapes:
                        raise CorruptDataError(f"{where}: {name} is in more than one file")
                    shapes[name] = tuple(opened.get_slice(name).get_shape())
        except SafetensorError as error:
            raise CorruptDataError(
                f"{where}: {file.name} is not a safetensors file ({error}); copy it again"
            ) from error
    return StoredWeights(files, shapes)


def _files(folder: Path, stem: str, where: str) -> tuple[Path, ...]:
    if not folder.is_dir():
        raise NotFoundError(f"{where}: no folder {folder}; give the folder of the downloaded model")
    index = folder / f"{stem}{_INDEX_SUFFIX}"
    if index.is_file():
        shards = _shards(index, where)
        absent = [name for name in shards if not (folder / name).is_file()]
        if absent:
            raise NotFoundError(
                f"{where}: {len(absent)} of {len(shards)} files are missing in {folder} "
                f"({absent[0]}); copy the whole model"
            )
        return tuple(folder / name for name in shards)
    found = sorted(folder.glob(f"{stem}*.safetensors"))
    if found:
        return tuple(found)
    if pickled := sorted(folder.glob("*.pth")):
        raise InvalidInputError(
            f"{where}: {pickled[0].name} is a pickle, which can run code when it is read; expected "
            f"{stem}*.safetensors: {_CONVERT}, or use the diffusers layout of the model"
        )
    raise NotFoundError(f"{where}: no {stem}*.safetensors in {folder}; copy the whole model")


def _shards(index: Path, where: str) -> Sequence[str]:
    try:
        files = sorted(set(json.loads(index.read_text())["weight_map"].values()))
    except (json.JSONDecodeError, KeyError, AttributeError, TypeError) as error:
        raise CorruptDataError(f"{where}: {index.name} is unreadable ({error!r})") from error
    if any(Path(name).name != name for name in files):
        raise CorruptDataError(f"{where}: {index.name} names files outside its folder")
    return files


def load_weights(
    network: nn.Module,
    stored: StoredWeights,
    rules: Rules,
    *,
    where: str,
    max_bytes: int | None = None,
) -> None:
    """Load a network in place, in the precision of its parameters; it may be on the meta device.

    Non-persistent buffers stay as they are. The weights may take `max_bytes` of memory; None: what
    is available.

    Raises:
        InvalidInputError: missing or unexpected tensors, or wrong shapes.
        LimitExceededError: the network needs more memory.
        NonFiniteError: weights that are NaN or infinite.
    """
    expected = network.state_dict()
    names = _checked_names(stored, expected, rules, where)
    check_memory(memory_of(expected), where=where, max_bytes=max_bytes)
    tensors: dict[str, Tensor] = {}
    with ExitStack() as stack:
        for file in stored.files:
            opened = stack.enter_context(safe_open(file, framework="pt"))
            for name in opened.keys():  # noqa: SIM118
                tensor = opened.get_tensor(name)
                refuse_non_finite({name: tensor}, where)
                tensors[names[name]] = tensor.to(expected[names[name]].dtype)
    network.load_state_dict(tensors, assign=True)


def _checked_names(
    stored: StoredWeights, expected: Mapping[str, Tensor], rules: Rules, where: str
) -> dict[str, str]:
    """Name in the network of each stored tensor, after all were compared."""
    names = {name: name for name in expected}
    original = {theirs: ours for ours, theirs in original_names(expected, rules).items()}
    # The layout that shares more names with the files.
    if len(original.keys() & stored.shapes.keys()) > len(names.keys() & stored.shapes.keys()):
        names = original
    missing = sorted(names.keys() - stored.shapes.keys())
    foreign = sorted(stored.shapes.keys() - names.keys())
    if missing or foreign:
        raise InvalidInputError(
            f"{where}: {len(missing)} tensors missing {missing[:3]}, {len(foreign)} unexpected "
            f"{foreign[:3]}; expected exactly the {len(names)} of its configuration"
        )
    for name, shape in stored.shapes.items():
        wanted = tuple(expected[names[name]].shape)
        if shape != wanted:
            raise InvalidInputError(
                f"{where}: {name} has shape {shape}, expected {wanted}; the folder holds a model "
                "of another size"
            )
    return names


def autoencoder_rules(num_blocks: int) -> Rules:
    """Rules of the video autoencoder of Wan2.2 with this many residual blocks per resolution."""
    return (
        ("conv1.*", "quant_conv.*"),
        ("conv2.*", "post_quant_conv.*"),
        *_coder_rules("encoder", ("downsamples", "down_blocks", "downsampler"), num_blocks),
        *_coder_rules("decoder", ("upsamples", "up_blocks", "upsampler"), num_blocks + 1),
    )


def _coder_rules(coder: str, names: tuple[str, str, str], num_blocks: int) -> Rules:
    """Rules of the encoder or the decoder; the resampling follows the blocks of a resolution."""
    theirs, ours, resampler = names
    places = [
        (f"{theirs}.#.{theirs}.{index}", f"{ours}.#.resnets.{index}") for index in range(num_blocks)
    ]
    middle = [("middle.0", "mid_block.resnets.0"), ("middle.2", "mid_block.resnets.1")]
    parts = [
        ("conv1.*", "conv_in.*"),
        ("head.0.*", "norm_out.*"),
        ("head.2.*", "conv_out.*"),
        *((f"middle.1.{one}.*", f"mid_block.attentions.0.{one}.*") for one in ("norm", "to_qkv")),
        ("middle.1.proj.*", "mid_block.attentions.0.proj.*"),
        *(
            (f"{there}.{old}", f"{here}.{new}")
            for there, here in (*places, *middle)
            for old, new in _RESIDUAL
        ),
        *((f"{there}.shortcut.*", f"{here}.conv_shortcut.*") for there, here in places),
        *(
            (f"{theirs}.#.{theirs}.{num_blocks}.{one}.*", f"{ours}.#.{resampler}.{one}.*")
            for one in ("resample.1", "time_conv")
        ),
    ]
    return tuple((f"{coder}.{old}", f"{coder}.{new}") for old, new in parts)


def original_names(names: Iterable[str], rules: Rules) -> dict[str, str]:
    """Names of tensors in the original layout, by those of diffusers."""
    compiled = [(_pattern(ours), _template(theirs)) for theirs, ours in rules]
    found: dict[str, str] = {}
    for name in names:
        matches = ((pattern.fullmatch(name), template) for pattern, template in compiled)
        found[name] = next(m.expand(template) for m, template in matches if m is not None)
    return found


def _pattern(rule: str) -> re.Pattern[str]:
    return re.compile(re.escape(rule).replace(r"\#", r"(\d+)").replace(r"\*", r"([a-z]+)"))


def _template(rule: str) -> str:
    """Replacement whose groups are numbered in the order of the wildcards."""
    parts = re.split(r"[#*]", rule)
    groups = [f"\\g<{number}>" for number in range(1, len(parts))]
    return "".join(part + group for part, group in zip(parts, [*groups, ""], strict=True))
