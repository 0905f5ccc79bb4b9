"""Memory and FLOPs of a joint model, computed from its configuration without any weights.

The network runs on torch's meta device. FLOPs are two per multiplication and addition of matrix
products, convolutions and attention; memory is the largest sum of tensors alive at one time, with
the whole matrix of attention and without working memory of libraries. Deep models are planned from
a few layers. In training activations count in float32.
"""

import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from functools import cache
from typing import Any, ClassVar, Final, TypeVar, cast

import torch
from torch import Tensor, nn
from torch._ops import OpOverload
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from services.networks.optimizer import learned_weights
from services.networks.weight_files import memory_of
from services.world_model.network.attention import CAMERA_DIM, HAND_DIM
from services.world_model.network.configuration import NetworkConfig, Precision, num_latents
from services.world_model.network.inputs import GEOMETRY_SIZE, ModelInputs, kept_bytes
from services.world_model.network.instruction import MAX_WORDS, key_of
from services.world_model.network.model import Context, FirstLatents, JointLatents, JointWorldModel
from services.world_model.paper_settings import LoraSettings, TrainSettings
from services.world_model.pretrained_video import freeze_pretrained

_PRECISIONS: Final[tuple[Precision, ...]] = ("float32", "bfloat16")
# A chunk needs one of the two.
_DECODING: Final = ("decode all images", "decode the last image")
# Cards that choices of a training are compared with, in 1e9 bytes as all of the plan.
_CARDS_GB: Final = (24, 80, 141)
# Layers that deeper models are planned from, by what the last one adds; with fewer, sampler steps
# still need more from layer to layer.
_FEW_LAYERS: Final = 4
# Text encoder of the published model, UMT5-XXL: its width, and weights as transformers builds them.
_TEXT_WIDTH: Final = 4096
TEXT_ENCODER_WEIGHTS: Final = 5_680_910_336


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
    """What a chunk of one rollout needs; `kept_bytes` is what the sampler's steps share."""

    num_steps: int
    num_video_tokens: int
    num_tactile_tokens: int
    parts: tuple[Part, ...]
    work: tuple[Work, ...]
    kept_bytes: int

    @property
    def peak_bytes(self) -> int:
        """Weights, what is kept, and the most memory that a computation takes."""
        weight_bytes = sum(part.memory_bytes for part in self.parts)
        return weight_bytes + self.kept_bytes + max(work.memory_bytes for work in self.work)


@dataclass(frozen=True)
class _Weights:
    """Bytes of the weights of a training.

    Of all `weights`, codec and tokenizer are `whole` in every process; `learned` ones are trained.
    `layer` are weights of a layer, `outer` those beside layers and whole parts.
    """

    weights: int
    whole: int
    learned: int
    outer: int
    layer: int


@dataclass(frozen=True)
class TrainingPlan(_Weights):
    """Memory of a training's process while it takes a step, in bytes.

    Learned weights have gradients, two moments and maybe an average (`copies` without gradients).
    `step` is the most that forward and backward take, with all gradients if there is one process,
    and `encoding` what the codec takes for the latents.
    """

    step: int
    encoding: int
    copies: int
    shards: int

    @property
    def peak_bytes(self) -> int:
        """The most memory, beside the library's own.

        Sharded (FSDP2), outer weights and two layers with one gradient are gathered.
        """
        copies = self.copies * self.learned
        if self.shards == 1:
            return self.weights + copies + max(self.step, self.learned + self.encoding)
        shared = self.weights - self.whole + copies + self.learned
        gathered = self.outer + 3 * self.layer
        return self.whole + shared // self.shards + gathered + max(self.step, self.encoding)


PlanT = TypeVar("PlanT")


class PeakMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Largest sum of the tensors made inside the context and alive at one time, in bytes.

    Also counts FLOPs. Gradients given to `drop` are `dropped_bytes`; `kept_peak_bytes` is the peak
    as if they had stayed. On the meta device an operation is computed once for tensors of the same
    shapes, since its Python implementations there take ten times as long as making the results.
    """

    # Shape, stride and kind of the new tensors of an operation, its kind of result, and its FLOPs.
    _known: ClassVar[dict[object, tuple[list[Any], type | None, int]]] = {}

    def __init__(self, given: Iterable[Tensor]) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.flops = self.peak_bytes = self.kept_peak_bytes = self.dropped_bytes = 0
        self._now_bytes = 0
        # Views share the storage of their tensor. Held, since storages are known by identity.
        self._given = [tensor.untyped_storage() for tensor in given]
        self._alive = weakref.WeakSet(self._given)

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # Nothing is compiled here; to tell torch._dynamo so, torch would import it.
        return False

    def __torch_dispatch__(
        self,
        func: OpOverload[..., Any],
        types: object,
        args: tuple[object, ...] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> object:
        """Run an operation and count its new tensors and FLOPs."""
        kwargs = kwargs or {}
        key = None if func.is_view else (func, _signature(args), _signature((*kwargs.items(),)))
        known = self._known.get(key)
        if known is None:
            result = func(*args, **kwargs)
            count = flop_registry.get(func.overloadpacket)
            flops = 0 if count is None else count(*args, **kwargs, out_val=result)
            kind = type(result) if isinstance(result, tuple | list) else None
            results = [result] if kind is None else list(result)
            if key and _are_new(results, (args, kwargs)):
                made = [one if one is None else _form(one) for one in results]
                self._known[key] = made, kind, flops
        else:
            made, kind, flops = known
            results = [
                one and torch.empty_strided(*one[:2], dtype=one[2], device="meta") for one in made
            ]
            result = results[0] if kind is None else kind(results)
        self.flops += flops
        for one in results:
            if isinstance(one, Tensor):
                self._count(one.untyped_storage())
        return result

    def drop(self, weight: Tensor) -> None:
        """Free the gradient of a weight."""
        if weight.grad is not None:
            self.dropped_bytes += weight.grad.untyped_storage().nbytes()
            weight.grad = None

    def _count(self, storage: torch.UntypedStorage) -> None:
        if storage in self._alive:
            return
        size = storage.nbytes()
        self._alive.add(storage)
        self._now_bytes += size
        self.peak_bytes = max(self.peak_bytes, self._now_bytes)
        self.kept_peak_bytes = max(self.kept_peak_bytes, self._now_bytes + self.dropped_bytes)
        weakref.finalize(storage, self._free, size)

    def _free(self, size: int) -> None:
        self._now_bytes -= size


def _signature(value: object) -> object:
    """What the shapes of an operation's results depend on."""
    if isinstance(value, Tensor):
        # Those of other devices are equal to nothing else.
        return _form(value) if value.is_meta else object()
    if isinstance(value, tuple | list):
        return tuple(map(_signature, value))
    return type(value), value


def _form(tensor: Tensor) -> tuple[torch.Size, tuple[int, ...], torch.dtype]:
    return tensor.shape, tensor.stride(), tensor.dtype


def _are_new(results: list[object], given: object) -> bool:
    """Whether all results are on the meta device, and none shares the memory of what was given."""
    old = {tensor.untyped_storage() for tensor in _tensors_of(given)}
    return all(
        one is None
        or (isinstance(one, Tensor) and one.is_meta and one.untyped_storage() not in old)
        for one in results
    )


def plan_table(config: NetworkConfig) -> str:
    """Plan as a text; for the full size in both precisions."""
    if config.wan is None:
        plans = {"float32": plan_of(config)}
    else:
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
            row("remembered by a rollout, at most", "", [kept_bytes(config)] * len(columns)),
        ][: None if config.past_images else -1]
    )


def plan_of(config: NetworkConfig) -> Plan:
    """Plan of one action chunk of the greatest length."""
    return _of_depth(config, _plan_of)


def _of_depth(config: NetworkConfig, planned: Callable[[JointWorldModel], PlanT]) -> PlanT:
    """A plan of many layers from those of few: each further one needs the same."""
    further = config.num_layers - _FEW_LAYERS
    few_layers = config.model_copy(update={"num_layers": config.num_layers - max(0, further)})
    with torch.device("meta"):
        model = JointWorldModel(few_layers)
    plan = planned(model)
    if further <= 0:
        return plan
    del model.layers[-1]
    return cast("PlanT", _further(planned(model), plan, further))


def _further(few: object, more: object, num: int) -> object:
    if isinstance(few, int) and isinstance(more, int):
        return more + num * (more - few)
    if isinstance(few, tuple) and isinstance(more, tuple):
        return tuple(_further(one, other, num) for one, other in zip(few, more, strict=True))
    if isinstance(few, Plan | Part | Work | _Weights):
        amounts = {name: _further(one, vars(more)[name], num) for name, one in vars(few).items()}
        return type(few)(**amounts)  # type: ignore[arg-type]
    return more


def _plan_of(model: JointWorldModel) -> Plan:
    config, steps = model.config, model.config.max_steps - 1
    with torch.no_grad():
        work, kept_bytes = _work(model.eval(), 1 + steps)
    return Plan(
        num_steps=steps,
        num_video_tokens=(num_latents(1 + steps) + config.past_images) * config.tokens_per_frame,
        num_tactile_tokens=(1 + steps) * 2 * model.tokenizer.num_tokens,
        parts=_parts(model),
        work=work,
        kept_bytes=kept_bytes,
    )


def training_table(settings: TrainSettings, num_processes: int) -> str:
    """Memory of a training as it is set, and of leaner ones, and which cards have it."""
    rows = [f"{'training, memory of a process':<56}{'one':>12}{f'of {num_processes}':>15}"]
    lean = {}
    for flags, changed in _choices(settings).items():
        sizes = [training_plan(changed, count).peak_bytes / 1e9 for count in (1, num_processes)]
        lean[flags] = sizes[0]
        rows.append(f"  {flags:<54}" + "".join(f"{size:>12.3f} GB" for size in sizes))
    for card_gb in _CARDS_GB:
        # A tenth is left to the library and to the working memory of convolutions.
        fitting = [flags for flags, size in lean.items() if size <= 0.9 * card_gb]
        rows.append(
            f"fits {card_gb} GB, in one process: {fitting[0] if fitting else 'none of them'}"
        )
    return "\n".join(rows)


def _choices(settings: TrainSettings) -> dict[str, TrainSettings]:
    """The training, and leaner ones with the flags that change it, from most to least learned."""
    choices, changed, flags = {"as given": settings}, settings, ""
    wan, batch = settings.network.wan, settings.optimizer.batch
    if wan is None:
        return choices
    half = wan.model_copy(update={"precision": "bfloat16"})
    network = settings.network.model_copy(update={"wan": half})
    parts: dict[str, dict[str, object]] = {
        f"--accumulate {batch}": {"accumulate": batch},
        "--recompute": {"recompute": True},
        "--network.wan.precision bfloat16": {"network": network},
        "--lora.rank 32": {"lora": LoraSettings(rank=32)},
    }
    for flag, update in parts.items():
        before, changed = changed, changed.model_copy(update=update)
        if changed == before or (settings.lora.rank and "lora" in update):
            changed = before
            continue
        flags = f"{flags} {flag}".strip()
        choices[flags] = changed
    return choices


def training_plan(settings: TrainSettings, num_processes: int = 1) -> TrainingPlan:
    """Plan of a step with the longest windows, in one process of several; as `with_adapters`."""
    settings = settings.with_adapters()
    config, accumulate = settings.network, settings.accumulate
    shards = max(1, num_processes // settings.replicas)
    windows = max(1, settings.optimizer.batch // (num_processes * accumulate))
    is_frozen = settings.freeze_video or settings.lora.rank > 0
    weights, *steps = _pass(config, windows, is_frozen=is_frozen, recompute=settings.recompute)
    return TrainingPlan(
        **vars(weights),
        step=steps[0 if shards > 1 else min(accumulate, 2)],
        encoding=_encoding_bytes(_of_codec(config), windows),
        copies=2 + (settings.optimizer.ema_decay > 0.0),
        shards=shards,
    )


@cache
def _pass(
    config: NetworkConfig, num_windows: int, *, is_frozen: bool, recompute: bool
) -> tuple[_Weights, int, int, int]:
    """Weights, and the peak of forward and backward: sharded, of one part of a batch, of several.

    Several processes and choices of a training share a pass.
    """

    def planned(model: JointWorldModel) -> tuple[_Weights, int, int, int]:
        model.train()
        if is_frozen:
            freeze_pretrained(model)
        for layer in model.joint_layers():
            layer.recompute = recompute
        memory = _backward(model, num_windows)
        # Gradients of the parts before are there while the last part runs.
        several = memory.peak_bytes + memory.dropped_bytes
        return _weights(model), memory.peak_bytes, memory.kept_peak_bytes, several

    return _of_depth(config, planned)


def _weights(model: JointWorldModel) -> _Weights:
    whole = sum(memory_of(part.state_dict()) for part in (model.codec, model.tokenizer))
    layers, weights = memory_of(model.layers.state_dict()), memory_of(model.state_dict())
    return _Weights(
        weights=weights,
        whole=whole,
        learned=memory_of(learned_weights(model)),
        outer=weights - whole - layers,
        layer=memory_of(model.joint_layers()[0].state_dict()),
    )


def _backward(model: JointWorldModel, num_windows: int) -> PeakMemory:
    """Memory of forward and backward, of which no gradient stays."""
    steps = model.config.max_steps
    with torch.device("meta"):
        inputs = _inputs(model.config, steps, num_windows)
        first, noisy = _latents(model, steps, num_windows)
        t = torch.ones(num_windows)
    with PeakMemory((*model.parameters(), *model.buffers())) as memory:
        hooks = [
            weight.register_post_accumulate_grad_hook(memory.drop)  # type: ignore[no-untyped-call]
            for weight in learned_weights(model).values()
        ]
        guess = model(inputs, first, noisy, t)
        torch.autograd.backward(guess.video.square().mean() + guess.tactile.square().mean())
    for hook in hooks:
        hook.remove()
    return memory


def _of_codec(config: NetworkConfig) -> NetworkConfig:
    """The smallest configuration with the same codec."""
    wan = config.wan
    if wan is not None:
        same = {"precision": "float32", "lora_rank": 0, "lora_scale": 1.0}
        wan = wan.model_copy(update=same)
    return config.model_copy(update={"num_layers": 1, "wan": wan})


@cache
def _encoding_bytes(config: NetworkConfig, num_windows: int) -> int:
    """What the codec takes for the latents of some windows."""
    shape = config.max_steps, config.image_px, config.image_px, 3
    with torch.device("meta"):
        codec = JointWorldModel(config).codec
        images = torch.zeros(num_windows * config.num_views, *shape)
    with torch.no_grad(), PeakMemory((*codec.parameters(), *codec.buffers())) as memory:
        codec.encode(images)
    return memory.peak_bytes


def _parts(model: JointWorldModel) -> tuple[Part, ...]:
    ends = [model.video_condition, model.video, *([model.views] if model.views else [])]
    video = [*ends, *(layer.video for layer in model.layers)]
    touch = [model.tactile_condition, model.tactile, *(layer.tactile for layer in model.layers)]
    groups: dict[str, list[Any]] = {
        "video expert": video,
        "tactile expert": touch,
        "visual codec": [model.codec],
        "tactile tokenizer": [model.tokenizer],
    }
    parts = []
    for name, group in groups.items():
        modules = nn.ModuleList(group)
        # Shared weights are counted once.
        tensors = {**dict(modules.named_parameters()), **dict(modules.named_buffers())}
        parts.append(Part(name, sum(t.numel() for t in tensors.values()), memory_of(tensors)))
    wan = model.config.wan
    if wan is not None and wan.text_width == _TEXT_WIDTH:
        num, name = TEXT_ENCODER_WEIGHTS, "text encoder (once per instruction)"
        parts.append(Part(name, num, num * wan.dtype.itemsize))
    return tuple(parts)


def _work(model: JointWorldModel, num_steps: int) -> tuple[tuple[Work, ...], int]:
    """Computations of a chunk, and the memory that the sampler's steps share."""
    config = model.config
    with torch.device("meta"):
        inputs, t = _inputs(config, num_steps), torch.ones(1)
        first, noisy = _latents(model, num_steps)

    def share() -> Context:
        context = model.context(inputs, first)
        return replace(context, clean=model.clean_tokens(context, noisy))

    def step() -> JointLatents:
        return model.denoise(context, noisy, t)

    contexts: list[Context] = []
    shared = _measured(
        ("what sampler steps share", 1),
        lambda: contexts.append(share()),
        model,
        _tensors_of((inputs, first, noisy)),
    )
    (context,) = contexts
    kept = {str(id(tensor)): tensor for tensor in _tensors_of(context)}
    steps = ("one sampler step", config.sampling_steps)
    sampled = _measured(steps, step, model, kept.values())
    encoded, *decoded = _codec_work(_of_codec(config), num_steps)
    return (encoded, shared, sampled, *decoded), memory_of(kept)


@cache
def _codec_work(config: NetworkConfig, num_steps: int) -> tuple[Work, ...]:
    """Computations of codec and tokenizer, which are equal in both precisions and all depths."""
    with torch.device("meta"):
        model, inputs = JointWorldModel(config).eval(), _inputs(config, num_steps)
        first, noisy = _latents(model, num_steps)
    jobs: dict[str, Callable[[], object]] = {
        "encode the first image": lambda: model.first_latents(inputs),
        _DECODING[0]: lambda: model.decode(first, noisy),
        _DECODING[1]: lambda: model.decode(first, noisy, all_images=False),
    }
    return tuple(_measured((name, 1), run, model) for name, run in jobs.items())


def _measured(
    times: tuple[str, int],
    run: Callable[[], object],
    model: JointWorldModel,
    kept: Iterable[Tensor] = (),
) -> Work:
    """A computation that has a name and is done some times, beside what is kept."""
    with PeakMemory((*model.parameters(), *model.buffers(), *kept)) as memory:
        run()
    return Work(*times, memory.flops, memory.peak_bytes)


def _tensors_of(kept: object) -> list[Tensor]:
    if isinstance(kept, Tensor):
        return [kept]
    if is_dataclass(kept):
        return [tensor for part in vars(kept).values() for tensor in _tensors_of(part)]
    if isinstance(kept, dict):
        kept = tuple(kept.values())
    if isinstance(kept, tuple | list):
        return [tensor for part in kept for tensor in _tensors_of(part)]
    return []


def _latents(
    model: JointWorldModel, num_steps: int, num_windows: int = 1
) -> tuple[FirstLatents, JointLatents]:
    """Latents of windows, whose text the model knows from now on."""
    config = model.config
    if model.text_features is not None and config.wan is not None:
        model.text_features.learn({key_of(""): torch.zeros(1, config.wan.text_width)})
    first = FirstLatents(
        torch.zeros(num_windows, config.tokens_per_frame, config.video_channels),
        torch.zeros(num_windows, 2, model.tokenizer.num_tokens, model.tokenizer.channels),
    )
    return first, JointLatents(
        first.video[:, None].repeat(1, num_latents(num_steps), 1, 1),
        first.tactile[:, None].repeat(1, num_steps, 1, 1, 1),
    )


def _inputs(config: NetworkConfig, num_steps: int, num_windows: int = 1) -> ModelInputs:
    cells, num, past = config.raster_cells, num_windows, config.past_images
    px, further = config.image_px, len(config.further_views)
    return ModelInputs(
        first_image=torch.zeros(num, config.image_px, config.image_px, 3, dtype=torch.uint8),
        first_tactile_kpa=torch.zeros(num, 2, config.tactile_layout.num_taxels),
        hands=torch.zeros(num, num_steps, 2, HAND_DIM),
        camera=torch.zeros(num, num_steps, 2, CAMERA_DIM),
        layout=torch.zeros(num, 2, CAMERA_DIM),
        raster=torch.zeros(num, num_steps, 2, cells, cells),
        geometry=torch.zeros(num, num_steps, 2, GEOMETRY_SIZE * config.use_contact_geometry),
        commanded=torch.zeros(num),
        acting=torch.ones(num),
        words=torch.zeros(num, MAX_WORDS, dtype=torch.int64),
        instructions=("",) * num,
        further_images=torch.zeros(num, further, px, px, 3, dtype=torch.uint8),
        missing=torch.zeros(num, further, dtype=torch.bool),
        past_images=torch.zeros(num, 0, 1 + further, px, px, 3, dtype=torch.uint8),
        past_latents=torch.zeros(num, past, config.tokens_per_frame, config.video_channels),
        past_hands=torch.zeros(num, past, 2, HAND_DIM),
        past_camera=torch.zeros(num, past, 2, CAMERA_DIM),
        past_raster=torch.zeros(num, past, 2, cells, cells),
        past_age=torch.zeros(num, past),
    )
