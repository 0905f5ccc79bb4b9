"""Memory and FLOPs of a joint model, computed from its configuration without any weights.

The network runs on torch's meta device, which has shapes but no numbers, so that the full size can
be planned on a laptop. FLOPs are those of matrix products, convolutions and attention (two per
multiplication and addition); memory is the largest sum of tensors that are alive at one time.
Attention counts its whole matrix, which fused kernels do not store; working memory of convolutions,
which depends on the library, is not counted.
"""

import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from services.networks.weight_files import memory_of
from services.world_model.network.attention import CAMERA_DIM, HAND_DIM
from services.world_model.network.configuration import NetworkConfig, Precision, num_latents
from services.world_model.network.inputs import GEOMETRY_SIZE, ModelInputs
from services.world_model.network.instruction import MAX_WORDS, key_of
from services.world_model.network.model import Context, FirstLatents, JointLatents, JointWorldModel

_PRECISIONS: Final[tuple[Precision, ...]] = ("float32", "bfloat16")
# A chunk needs one of the two.
_DECODING: Final = ("decode all images", "decode the last image")
# Text encoder of the published model, UMT5-XXL.
_TEXT_ENCODER: Final = {
    "vocab_size": 256384, "d_model": 4096, "d_kv": 64, "d_ff": 10240, "num_layers": 24,
    "num_heads": 64,
}  # fmt: skip


@dataclass(frozen=True)
class Part:
    """One part of the model; `memory_bytes` of its weights."""

    name: str
    num_weights: int
    memory_bytes: int


@dataclass(frozen=True)
class Work:
    """One computation; `memory_bytes` beside the weights while it runs."""

    name: str
    times: int
    flops: int
    memory_bytes: int


@dataclass(frozen=True)
class Plan:
    """What one action chunk of one rollout needs.

    `kept_bytes` is what the sampler's steps share: keys and values of clean tokens, and conditions.
    `training_bytes` are weights, gradients, two moments of AdamW and the average of the weights;
    activations come on top.
    """

    num_steps: int
    num_video_tokens: int
    num_tactile_tokens: int
    parts: tuple[Part, ...]
    work: tuple[Work, ...]
    kept_bytes: int
    training_bytes: int

    @property
    def peak_bytes(self) -> int:
        """Weights, what is kept, and the most memory that a computation takes."""
        weight_bytes = sum(part.memory_bytes for part in self.parts)
        return weight_bytes + self.kept_bytes + max(work.memory_bytes for work in self.work)


class PeakMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Largest sum of the tensors made inside the context and alive at one time, in bytes."""

    def __init__(self, given: Iterable[Tensor]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.peak_bytes = 0
        self._now_bytes = 0
        # Views share the storage of their tensor. Held, since storages are known by identity.
        self._given = [tensor.untyped_storage() for tensor in given]
        self._alive = weakref.WeakSet(self._given)

    def __torch_dispatch__(
        self,
        func: Callable[..., object],
        types: object,
        args: tuple[object, ...] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """Run an operation and count its new tensors."""
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor):
                self._count(leaf.untyped_storage())
        return result

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage in self._alive:
            return
        size = storage.nbytes()
        self._alive.add(storage)
        self._now_bytes += size
        self.peak_bytes = max(self.peak_bytes, self._now_bytes)
        weakref.finalize(storage, self._free, size)

    def _free(self, size: int) -> None:
        self._now_bytes -= size


def plan_table(config: NetworkConfig) -> str:
    """Plan as a text; for the full size in both precisions."""
    plans = {"float32": plan_of(config)}
    if config.wan is not None:
        sizes = {one: config.wan.model_copy(update={"precision": one}) for one in _PRECISIONS}
        plans = {one: plan_of(config.model_copy(update={"wan": wan})) for one, wan in sizes.items()}
    columns = list(plans.values())
    first = columns[0]

    def row(name: str, amount: str, sizes: Iterable[int]) -> str:
        return f"{name:<38}{amount:>18}" + "".join(f"{size / 1e9:>15.3f} GB" for size in sizes)

    weights = [
        row(f"  {one.name}", f"{one.num_weights:,}", (p.parts[i].memory_bytes for p in columns))
        for i, one in enumerate(first.parts)
    ]
    times = [f"{one.times} x {one.flops / 1e9:,.2f} GF" for one in first.work]
    work = [
        row(f"  {one.name}", times[i], (p.work[i].memory_bytes for p in columns))
        for i, one in enumerate(first.work)
    ]
    totals = [
        row(
            f"all, and {name}",
            f"{sum(w.times * w.flops for w in first.work if w.name != other) / 1e9:,.2f} GF",
            (plan.peak_bytes for plan in columns),
        )
        for name, other in (_DECODING, _DECODING[::-1])
    ]
    return "\n".join(
        [
            f"one action chunk of {first.num_steps} steps, {first.num_video_tokens} video and "
            f"{first.num_tactile_tokens} tactile tokens",
            f"{'weights':<38}{'':>18}" + "".join(f"{name:>18}" for name in plans),
            *weights,
            "work, with memory beside the weights",
            *work,
            *totals,
            row("shared by sampler steps", "", (plan.kept_bytes for plan in columns)),
            row("training, without activations", "", (plan.training_bytes for plan in columns)),
        ]
    )


def plan_of(config: NetworkConfig) -> Plan:
    """Plan of one action chunk of the greatest length."""
    steps = config.max_steps - 1
    with torch.device("meta"), torch.no_grad():
        model = JointWorldModel(config).eval()
        work, kept_bytes = _work(model, 1 + steps)
        learned = {n: p for n, p in model.named_parameters() if p.requires_grad}
        return Plan(
            num_steps=steps,
            num_video_tokens=num_latents(1 + steps) * config.tokens_per_latent,
            num_tactile_tokens=(1 + steps) * 2 * model.tokenizer.num_tokens,
            parts=_parts(model),
            work=work,
            kept_bytes=kept_bytes,
            # Gradient and two moments of each learned weight; the average copies the whole model.
            training_bytes=2 * memory_of(model.state_dict()) + 3 * memory_of(learned),
        )


def _parts(model: JointWorldModel) -> tuple[Part, ...]:
    video = [model.video_condition, model.video, *(layer.video for layer in model.layers)]
    touch = [model.tactile_condition, model.tactile, *(layer.tactile for layer in model.layers)]
    groups: dict[str, list[Any]] = {
        "video expert": video,
        "tactile expert": touch,
        "visual codec": [model.codec],
        "tactile tokenizer": [model.tokenizer],
    }
    wan = model.config.wan
    if wan is not None and wan.text_width == _TEXT_ENCODER["d_model"]:
        from transformers import UMT5Config, UMT5EncoderModel

        encoder = UMT5EncoderModel(UMT5Config(**_TEXT_ENCODER)).to(wan.dtype)
        groups["text encoder (once per instruction)"] = [encoder]
    parts = []
    for name, group in groups.items():
        modules = nn.ModuleList(group)
        # Shared weights are counted once.
        tensors = {**dict(modules.named_parameters()), **dict(modules.named_buffers())}
        parts.append(Part(name, sum(t.numel() for t in tensors.values()), memory_of(tensors)))
    return tuple(parts)


def _work(model: JointWorldModel, num_steps: int) -> tuple[tuple[Work, ...], int]:
    """Computations of a chunk, and the memory that the sampler's steps share."""
    config = model.config
    inputs = _inputs(config, num_steps)
    if model.text_features is not None and config.wan is not None:
        model.text_features.learn({key_of(""): torch.zeros(1, config.wan.text_width)})
    first = FirstLatents(
        torch.zeros(1, config.tokens_per_latent, config.video_channels),
        torch.zeros(1, 2, model.tokenizer.num_tokens, model.tokenizer.channels),
    )
    noisy = JointLatents(
        first.video[:, None].repeat(1, num_latents(num_steps), 1, 1),
        first.tactile[:, None].repeat(1, num_steps, 1, 1, 1),
    )

    def shared() -> Context:
        return model.with_clean_tokens(model.context(inputs, first), noisy)

    context, steps = shared(), config.sampling_steps
    jobs: dict[str, tuple[int, Callable[[], Any]]] = {
        "encode the first image": (1, lambda: model.first_latents(inputs)),
        "what sampler steps share": (1, shared),
        "one sampler step": (steps, lambda: model.denoise(context, noisy, torch.ones(1))),
        _DECODING[0]: (1, lambda: model.decode(first, noisy)),
        _DECODING[1]: (1, lambda: model.decode(first, noisy, all_images=False)),
    }
    kept = {str(id(tensor)): tensor for tensor in _tensors_of(context)}
    work = []
    for name, (times, run) in jobs.items():
        given = (*model.parameters(), *model.buffers(), *kept.values())
        with PeakMemory(given) as memory, FlopCounterMode(display=False) as counter:
            run()
        work.append(Work(name, times, counter.get_total_flops(), memory.peak_bytes))
    return tuple(work), memory_of(kept)


def _tensors_of(kept: object) -> list[Tensor]:
    if isinstance(kept, Tensor):
        return [kept]
    if is_dataclass(kept):
        return [tensor for part in vars(kept).values() for tensor in _tensors_of(part)]
    if isinstance(kept, dict):
        kept = tuple(kept.values())
    if isinstance(kept, tuple):
        return [tensor for part in kept for tensor in _tensors_of(part)]
    return []


def _inputs(config: NetworkConfig, num_steps: int) -> ModelInputs:
    cells = config.raster_cells
    return ModelInputs(
        first_image=torch.zeros(1, config.image_px, config.image_px, 3, dtype=torch.uint8),
        first_tactile_kpa=torch.zeros(1, 2, config.tactile_layout.num_taxels),
        hands=torch.zeros(1, num_steps, 2, HAND_DIM),
        camera=torch.zeros(1, num_steps, 2, CAMERA_DIM),
        layout=torch.zeros(1, 2, CAMERA_DIM),
        raster=torch.zeros(1, num_steps, 2, cells, cells),
        geometry=torch.zeros(1, num_steps, 2, GEOMETRY_SIZE * config.use_contact_geometry),
        commanded=torch.zeros(1),
        acting=torch.ones(1),
        words=torch.zeros(1, MAX_WORDS, dtype=torch.int64),
        instructions=("",),
    )
