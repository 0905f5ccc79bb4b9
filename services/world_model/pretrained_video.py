"""Weights of the full-size model's pretrained parts, loaded strictly from a local folder."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from dextouch.errors import CorruptDataError, InvalidInputError, NotFoundError
from services.networks import weight_files
from services.world_model.network.codecs import WanVideoCodec
from services.world_model.network.configuration import NetworkConfig, WanFiles
from services.world_model.network.model import JointWorldModel
from services.world_model.network.video import (
    WanBlock,
    WanVideoCondition,
    WanVideoExpert,
    is_adapter,
)

# As diffusers names the weight files of a network.
_STEM: Final = "diffusion_pytorch_model"
_PRETRAINED: Final = ("codec.", "video.", "video_condition.embedder.")


def initial_model(
    config: NetworkConfig,
    files: WanFiles,
    *,
    filled_later: bool = False,
    prepare: Callable[[JointWorldModel], None] | None = None,
) -> JointWorldModel:
    """A new model; that of the full size begins with the pretrained weights of its files.

    With `filled_later`, a checkpoint replaces them. `prepare` is called before weights have memory.

    Raises:
        InvalidInputError: the full size without a folder.
        NotFoundError, CorruptDataError, LimitExceededError, NonFiniteError: as `load_weights`.
    """
    model = JointWorldModel(config)
    if prepare is not None:
        prepare(model)
    if model.text_features is None:
        return model
    if files.folder is not None:
        load_pretrained(model, files.folder, max_bytes=files.max_bytes)
    elif filled_later:
        weight_files.allocate(model)
    else:
        raise InvalidInputError(
            "pretrained video expert: got no folder; give the local folder of Wan2.2-TI2V-5B "
            "with --wan.folder, or --init with a checkpoint of the full size"
        )
    model.text_features.use(files.folder, files.text_cache)
    return model


def initial_codec(config: NetworkConfig, files: WanFiles) -> JointWorldModel:
    """A model of the full size of which the autoencoder and the text encoder alone are loaded.

    Raises as `initial_model`.
    """
    model = JointWorldModel(config)
    if not isinstance(model.codec, WanVideoCodec) or files.folder is None:
        raise InvalidInputError(
            f"autoencoder: got video_expert {config.video_expert} and folder {files.folder}, "
            "expected wan and the local folder of Wan2.2-TI2V-5B; use --preset wan22-5b and "
            "--wan.folder, or --init"
        )
    _load_autoencoder(model.codec, files.folder, files.max_bytes)
    if model.text_features is not None:
        model.text_features.use(files.folder, files.text_cache)
    return model


def freeze_pretrained(model: JointWorldModel) -> None:
    """Train neither the transformer nor the autoencoder of Wan2.2, but adapters."""
    for name, weight in model.named_parameters():
        if is_pretrained(name):
            weight.requires_grad = is_adapter(name)


def is_pretrained(name: str) -> bool:
    """Whether a weight of a model of the full size is one of Wan2.2, or of its adapters."""
    return name.startswith(_PRETRAINED) or ".video.block." in name


def share_texts(source: JointWorldModel, target: JointWorldModel) -> None:
    """Give a model the text features that another knows."""
    if source.text_features is not None and target.text_features is not None:
        target.text_features.learn(source.text_features.known)


def load_pretrained(model: JointWorldModel, folder: Path, *, max_bytes: int | None = None) -> None:
    """Load transformer and autoencoder of a model of the full size, and use the text encoder.

    `folder` is Wan2.2-TI2V-5B in diffusers' layout; `max_bytes` limits each network's memory.

    Raises:
        InvalidInputError: a model of the small size, or weights that do not fit its sizes.
        NotFoundError, CorruptDataError, LimitExceededError, NonFiniteError: as `load_weights`.
    """
    codec, condition, expert = model.codec, model.video_condition, model.video
    if (
        not isinstance(codec, WanVideoCodec)
        or not isinstance(condition, WanVideoCondition)
        or not isinstance(expert, WanVideoExpert)
    ):
        raise InvalidInputError(
            "pretrained video expert: got video_expert tiny, expected wan; use --preset wan22-5b"
        )
    blocks = [layer.video for layer in model.layers if isinstance(layer.video, WanBlock)]
    transformer = _Transformer(expert, condition, blocks)
    load_weights(
        transformer, folder / "transformer", where="Wan2.2 transformer", max_bytes=max_bytes
    )
    _load_autoencoder(codec, folder, max_bytes)
    # The only tensor that belongs to no module of its own.
    expert.scale_shift_table = transformer.scale_shift_table
    condition.text_features.use(folder)


def _load_autoencoder(codec: WanVideoCodec, folder: Path, max_bytes: int | None) -> None:
    load_weights(codec.autoencoder, folder / "vae", where="Wan2.2 autoencoder", max_bytes=max_bytes)


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


def load_weights(
    network: nn.Module, folder: Path, *, where: str, max_bytes: int | None = None
) -> None:
    """Load a network, which may be on the meta device or sharded, in place, in its precision.

    Names, shapes and memory (`max_bytes`; None: what is available) are checked from headers first.
    Adapters and non-persistent buffers stay as they are.

    Raises:
        NotFoundError: no such folder or file, or a shard is missing.
        CorruptDataError: a damaged index or header, or a tensor in two files.
        InvalidInputError: missing or unexpected tensors, wrong shapes, or only pickled weights.
        LimitExceededError: the network needs more memory.
        NonFiniteError: weights that are NaN or infinite.
    """
    expected = {n: one for n, one in network.state_dict().items() if not is_adapter(n)}
    files = [folder / name for name in _file_names(folder, where)]
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
    missing, foreign = sorted(expected.keys() - shapes), sorted(shapes.keys() - expected.keys())
    if missing or foreign:
        raise InvalidInputError(
            f"{where}: {len(missing)} tensors missing {missing[:3]}, {len(foreign)} unexpected "
            f"{foreign[:3]}; expected exactly the {len(expected)} of its configuration, under "
            "diffusers' names"
        )
    for name, shape in shapes.items():
        if shape != tuple(expected[name].shape):
            raise InvalidInputError(
                f"{where}: {name} has shape {shape}, expected {tuple(expected[name].shape)}; the "
                "folder holds a model of another size"
            )
    limit = _available(expected) if max_bytes is None else max_bytes
    weight_files.check_memory(weight_files.memory_of(expected), where=where, max_bytes=limit)
    weight_files.allocate(network)
    expected = network.state_dict()
    for file in files:
        with safe_open(file, framework="pt") as opened:
            for name in opened.keys():  # noqa: SIM118
                tensor = opened.get_tensor(name)
                weight_files.refuse_non_finite({name: tensor}, where)
                weight_files.fill(expected[name], tensor)


def _available(weights: Mapping[str, Tensor]) -> int | None:
    """Memory for this process's weights: that of its GPU, or its part of the machine's."""
    meshes = [one.device_mesh for one in weights.values() if weight_files.is_sharded(one)]
    if meshes and meshes[0].device_type == "cuda":
        return torch.cuda.mem_get_info()[0]
    free = weight_files.available_memory()
    # torchrun's number of processes on this machine, each with weights of its own.
    return None if free is None else free // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))


def _file_names(folder: Path, where: str) -> Sequence[str]:
    if not folder.is_dir():
        raise NotFoundError(f"{where}: no folder {folder}; give the folder of the downloaded model")
    index = folder / f"{_STEM}.safetensors.index.json"
    if not index.is_file():
        found = sorted(path.name for path in folder.glob(f"{_STEM}*.safetensors"))
        pickled = sorted(path.name for path in folder.glob("*.pth"))
        if not found and pickled:
            raise InvalidInputError(
                f"{where}: {pickled[0]} is a pickle, which can run code when it is read; expected "
                f"{_STEM}*.safetensors, as the diffusers layout of the model has them"
            )
        if not found:
            raise NotFoundError(
                f"{where}: no {_STEM}*.safetensors in {folder}; copy the whole model"
            )
        return found
    try:
        names = sorted(set(json.loads(index.read_text())["weight_map"].values()))
    except (json.JSONDecodeError, KeyError, AttributeError, TypeError) as error:
        raise CorruptDataError(f"{where}: {index.name} is unreadable ({error!r})") from error
    if any(Path(name).name != name for name in names):
        raise CorruptDataError(f"{where}: {index.name} names files outside its folder")
    absent = [name for name in names if not (folder / name).is_file()]
    if absent:
        raise NotFoundError(
            f"{where}: {len(absent)} of {len(names)} files are missing in {folder} ({absent[0]}); "
            "copy the whole model"
        )
    return names
