"""Strict loading of pretrained weights from a local folder into networks built without memory.

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
from typing import TYPE_CHECKING, Any, Final, Literal

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from services.networks.memory import check_memory, memory_of
from services.networks.weight_files import refuse_non_finite
from services.world_model.wan.configuration import WanConfig, dtype_of

if TYPE_CHECKING:
    from diffusers import AutoencoderKLWan, WanTransformer3DModel


# Tensor names of the Wan2.2 networks in their original files and in diffusers, mapped both ways.
#
# A rule is a pair of names, original and diffusers; `#` stands for a number and `*` for the last
# part of a name. Every tensor has exactly one rule, so that the same table works both ways.

Rules = tuple[tuple[str, str], ...]
Layout = Literal["original", "diffusers"]

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


def renamed(names: Iterable[str], rules: Rules, *, to: Layout) -> dict[str, str]:
    """Names of the other layout, by the given names.

    Raises:
        InvalidInputError: a name without a rule.
    """
    source, target = (0, 1) if to == "diffusers" else (1, 0)
    compiled = [(_pattern(rule[source]), _template(rule[target])) for rule in rules]
    found: dict[str, str] = {}
    for name in names:
        matches = ((pattern.fullmatch(name), template) for pattern, template in compiled)
        match, template = next(((m, t) for m, t in matches if m is not None), (None, ""))
        if match is None:
            raise InvalidInputError(
                f"tensor {name!r}: has no name in the {to} layout; expected the tensors of "
                "Wan2.2-TI2V-5B"
            )
        found[name] = match.expand(template)
    return found


def _pattern(rule: str) -> re.Pattern[str]:
    return re.compile(re.escape(rule).replace(r"\#", r"(\d+)").replace(r"\*", r"([a-z]+)"))


def _template(rule: str) -> str:
    """Replacement whose groups are numbered in the order of the wildcards."""
    parts = re.split(r"[#*]", rule)
    groups = [f"\\g<{number}>" for number in range(1, len(parts))]
    return "".join(part + group for part, group in zip(parts, [*groups, ""], strict=True))


_INDEX_SUFFIX: Final = ".safetensors.index.json"
_CONVERT: Final = (
    "load the .pth file with torch.load(..., weights_only=True) once and store it with "
    "safetensors.torch.save_file"
)


@dataclass(frozen=True)
class StoredWeights:
    """Weight files of one network; `shapes` by the names in the files."""

    files: tuple[Path, ...]
    shapes: Mapping[str, tuple[int, ...]]

    @property
    def num_bytes(self) -> int:
        """Size of the files."""
        return sum(file.stat().st_size for file in self.files)


def find_weights(folder: Path, *, stem: str, where: str) -> StoredWeights:
    """Find the weights of a network in a folder and read their headers.

    Args:
        folder: local folder.
        stem: beginning of the file names, such as `diffusion_pytorch_model`.
        where: context for error messages.

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


def load_weights(
    network: nn.Module,
    stored: StoredWeights,
    rules: Rules,
    *,
    where: str,
    max_bytes: int | None = None,
) -> None:
    """Load a network in place, in the precision of its parameters; it may be on the meta device.

    Args:
        network: its parameters are replaced; non-persistent buffers stay as they are.
        stored: from `find_weights`.
        rules: names of its tensors in both layouts.
        where: context for error messages.
        max_bytes: limit of memory for the weights; None for the memory that is available.

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


def layout_of(stored: StoredWeights, expected: Mapping[str, Any], rules: Rules) -> Layout:
    """Layout that shares more names with the files."""
    original = set(renamed(expected, rules, to="original").values())
    more = len(original & stored.shapes.keys()) > len(expected.keys() & stored.shapes.keys())
    return "original" if more else "diffusers"


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


def _checked_names(
    stored: StoredWeights, expected: Mapping[str, Tensor], rules: Rules, where: str
) -> dict[str, str]:
    """Name in the network of each stored tensor, after all were compared."""
    names = {name: name for name in expected}
    if layout_of(stored, expected, rules) == "original":
        names = {theirs: ours for ours, theirs in renamed(expected, rules, to="original").items()}
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


# The Wan2.2 networks of diffusers without memory for their weights, which come from files.


def empty_transformer(
    config: WanConfig, *, num_layers: int, num_heads: int, head_width: int
) -> "WanTransformer3DModel":
    """Transformer on the meta device, in the precision of the configuration."""
    from diffusers import WanTransformer3DModel

    sizes = config.transformer_sizes(
        num_layers=num_layers, num_heads=num_heads, head_width=head_width
    )
    with torch.device("meta"):
        transformer = WanTransformer3DModel(**sizes)
    for name, parameter in transformer.named_parameters():
        parameter.data = parameter.data.to(dtype_of(name, config.dtype))
    return transformer.eval()


def empty_autoencoder(config: WanConfig) -> "AutoencoderKLWan":
    """Video autoencoder on the meta device; always float32, as it is published."""
    from diffusers import AutoencoderKLWan

    with torch.device("meta"):
        autoencoder = AutoencoderKLWan(**config.autoencoder_sizes())
    return autoencoder.eval()
