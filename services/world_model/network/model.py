"""Joint model of future images and pressures: two experts with shared attention."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor, nn

from services.world_model.dynamics.tensor_trees import combined, mapped
from services.world_model.network import flow_matching
from services.world_model.network.attention import (
    ExpertBlock,
    JointLayer,
    Stream,
    clean_mask,
    split_axis,
)
from services.world_model.network.codecs import Latents, VisualCodec, WanVideoCodec, to_unit
from services.world_model.network.conditioning import (
    ActionNormalizer,
    Condition,
    Constants,
    TactileCondition,
    VideoCondition,
)
from services.world_model.network.configuration import (
    FLOAT32_PARTS,
    NetworkConfig,
    Precision,
    Sampler,
    num_latents,
)
from services.world_model.network.flow_matching import CleanTokens
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.instruction import LastUsed, TextFeatures
from services.world_model.network.tactile import TactileExpert, build_tokenizer
from services.world_model.network.video import (
    VideoExpert,
    ViewTokens,
    WanBlock,
    WanVideoCondition,
    WanVideoExpert,
    add_adapters,
    empty_transformer,
    merge_adapters,
)

_EXACT_PARTS = (
    "codec.", "tokenizer.", "normalizer.", "video_condition.", "tactile_condition.",
    "video_residual_std", "tactile_residual_std",
)  # fmt: skip


@dataclass(frozen=True)
class JointLatents:
    """Latents of both streams."""

    video: Float32[Tensor, "batch latents tokens channels"]
    tactile: Float32[Tensor, "batch time 2 tactile_tokens tactile_channels"]


@dataclass(frozen=True)
class FirstLatents:
    """Clean latents of the first step of both streams: the context and the anchor."""

    video: Float32[Tensor, "batch tokens channels"]
    tactile: Float32[Tensor, "batch 2 tactile_tokens tactile_channels"]


@dataclass(frozen=True)
class Context:
    """What the predictions of a chunk at all flow times share; conditions without the time.

    `past` are latents of past images. With `clean`, clean tokens are not computed again.
    """

    first: FirstLatents
    raster: Float32[Tensor, "batch time 2 cells cells"]
    past: Float32[Tensor, "batch past tokens channels"]
    past_raster: Float32[Tensor, "batch past 2 cells cells"]
    missing: Bool[Tensor, "batch further"]
    video: Any
    tactile: Constants | None
    clean: CleanTokens | None = None


@dataclass(frozen=True)
class Sampling:
    """How futures are sampled.

    `num_steps` (network calls) and `sampler` are the configuration's if None. With `keep_context`,
    calls share what does not depend on the flow time, which changes results by rounding only. With
    a `guidance` other than 1, predictions are moved away from those without instruction and
    actions, by that factor (classifier-free guidance, Ho and Salimans 2022). After `stop_after`
    calls latents are noisy ones on the way.
    """

    num_steps: int | None = None
    sampler: Sampler | None = None
    keep_context: bool = True
    guidance: float = 1.0
    stop_after: int | None = None


@dataclass(frozen=True)
class Observed:
    """What chunks that start from equal observations have in common."""

    first: FirstLatents
    clean: CleanTokens


@dataclass(frozen=True)
class Prediction:
    """Future after the first step, also of further views; `first` are latents of first images."""

    images: Float32[Tensor, "batch shown px px 3"]
    tactile_kpa: Float32[Tensor, "batch steps 2 taxels"]
    further: Float32[Tensor, "batch further shown px px 3"]
    first: Float32[Tensor, "batch tokens channels"]


class JointWorldModel(nn.Module):
    """Video and tactile expert on latents, with their frozen codecs."""

    video_residual_std: Tensor
    tactile_residual_std: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        # Small parts and those of Wan2.2 have the same methods. The latter are on the meta device
        # until their weights are loaded.
        wan = config.wan
        transformer: Any = None
        if wan is not None:
            transformer = empty_transformer(config, wan)
        self.codec: VisualCodec | WanVideoCodec = (
            VisualCodec(config) if wan is None else WanVideoCodec(wan)
        )
        self.tokenizer = build_tokenizer(config).requires_grad_(requires_grad=False)
        self.normalizer = ActionNormalizer()
        self.register_buffer("video_residual_std", torch.ones(()))
        self.register_buffer("tactile_residual_std", torch.ones(()))
        self.video_condition: VideoCondition | WanVideoCondition = (
            VideoCondition(config)
            if wan is None
            else WanVideoCondition(config, wan, transformer.condition_embedder)
        )
        self.tactile_condition = TactileCondition(config) if config.use_touch else None
        self.video: VideoExpert | WanVideoExpert = (
            VideoExpert(config) if wan is None else WanVideoExpert(config, transformer)
        )
        self.views: ViewTokens | None = None
        if config.further_views or config.past_images:
            self.views = ViewTokens(config)
            if wan is not None:
                self.views.to(wan.dtype)
        self.tactile: TactileExpert | None = None
        if config.use_touch:
            tokens, channels = self.tokenizer.num_tokens, self.tokenizer.channels
            self.tactile = TactileExpert(config, num_tokens=tokens, channels=channels)
        self.layers = nn.ModuleList(
            JointLayer(
                ExpertBlock(config, config.video_width)
                if wan is None
                else WanBlock(transformer.blocks[index]),
                ExpertBlock(config, config.tactile_width) if config.use_touch else None,
            )
            for index in range(config.num_layers)
        )
        if wan is not None and wan.lora_rank:
            for layer in self.joint_layers():
                add_adapters(layer.video, wan.lora_rank, wan.lora_scale)
        self._observed: LastUsed[Observed] | None = None
        # Finds latents of images, or computes them by its second argument; None: computes all.
        self.latent_cache: Callable[[Any, Callable[[Any], Latents]], Latents] | None = None

    def keep_contexts(self, count: int) -> None:
        """Keep up to `count` results of instruction and first step alone for later chunks.

        Weights must not change from now on. With the scene encoder, which sees actions, only texts
        are kept.
        """
        if not self.config.use_scene_encoder:
            self._observed = LastUsed(count)
        if isinstance(self.video_condition, WanVideoCondition):
            self.video_condition.kept_texts = LastUsed(count)

    @property
    def text_features(self) -> TextFeatures | None:
        """Features of instructions for the pretrained video expert."""
        condition = self.video_condition
        return condition.text_features if isinstance(condition, WanVideoCondition) else None

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self.video_residual_std.device

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "JointWorldModel":  # noqa: FBT001, FBT002
        """Move or convert the weights; codecs, conditions and norms keep their precision."""
        tensors = (*self.named_parameters(), *self.named_buffers())
        parts = {name: any(part in name for part in FLOAT32_PARTS) for name, _ in tensors}
        kept = {n: one.data for n, one in tensors if n.startswith(_EXACT_PARTS) or parts[n]}
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for name, tensor in (*self.named_parameters(), *self.named_buffers()):
            if name in kept and tensor.dtype != kept[name].dtype:
                tensor.data = kept[name].to(tensor.device)
        return self

    def first_latents(self, inputs: ModelInputs) -> FirstLatents:
        """Latents of the first images of all views and the first touch."""
        images = torch.cat([inputs.first_image[:, None], inputs.further_images], dim=1)
        video = self._encoded(images[:, :, None])[:, 0]
        return FirstLatents(video, self.tokenizer.encode(inputs.first_tactile_kpa))

    def with_past(self, inputs: ModelInputs) -> ModelInputs:
        """The inputs with their past images as latents."""
        pixels = inputs.past_images
        if not pixels.shape[1]:
            return inputs
        shape = self.config.tokens_per_frame, self.config.video_channels
        latents = torch.zeros(*pixels.shape[:2], *shape, device=pixels.device)
        known = inputs.past_age > 0
        if known.any():
            latents[known] = self._encoded(pixels[known][:, :, None])[:, 0]
        return replace(inputs, past_images=pixels[:, :0], past_latents=latents)

    def encode_images(self, images: UInt8[Tensor, "n time px px 3"]) -> Latents:
        """Latents of 1 + 4k images each, from the cache if there is one."""
        if self.latent_cache is None:
            return self.codec.encode(to_unit(images))
        return self.latent_cache(images, lambda some: self.codec.encode(to_unit(some)))

    def _encoded(
        self, images: UInt8[Tensor, "batch views time px px 3"]
    ) -> Float32[Tensor, "batch latents tokens channels"]:
        """Latents of images, the tokens of each frame view by view."""
        latents = self.encode_images(images.flatten(0, 1))
        return split_axis(latents, 0, tuple(images.shape[:2])).transpose(1, 2).flatten(2, 3)

    def targets(
        self,
        images: UInt8[Tensor, "batch time px px 3"],
        tactile_kpa: Float32[Tensor, "batch time 2 taxels"],
        further: UInt8[Tensor, "batch further time px px 3"] | None = None,
    ) -> JointLatents:
        """Clean latents of recorded windows, or residuals, in units of their deviation."""
        shown = images[:, None] if further is None else torch.cat([images[:, None], further], dim=1)
        video = from_first(self._encoded(shown), self.config.video_target)
        touch = from_first(self.tokenizer.encode(tactile_kpa), self.config.tactile_target)
        return JointLatents(video / self.video_residual_std, touch / self.tactile_residual_std)

    def forward(
        self,
        inputs: ModelInputs,
        first: FirstLatents,
        noisy: JointLatents,
        t: Float32[Tensor, " batch"],
    ) -> JointLatents:
        """Predict clean latents, or velocities, from noisy ones at time t (first ones clean)."""
        return self.denoise(self.context(inputs, first), noisy, t)

    def context(self, inputs: ModelInputs, first: FirstLatents) -> Context:
        """What does not depend on the flow time."""
        features, touch = self.normalizer(inputs), self.tactile_condition
        past = torch.where(
            inputs.past_age[..., None, None] > 0, inputs.past_latents, first.video[:, None]
        )
        return Context(
            first,
            inputs.raster,
            past,
            inputs.past_raster,
            inputs.missing,
            self.video_condition.constants(inputs, features),
            None if touch is None else touch.constants(inputs, features),
        )

    def clean_tokens(self, context: Context, noisy: JointLatents) -> CleanTokens:
        """Clean tokens, which no value of `noisy` changes."""
        t = torch.ones(len(noisy.video), device=noisy.video.device)
        video, tactile, _, _ = self._begin(context, noisy, t)
        video = video.split(self.config.num_clean_frames * self.config.tokens_per_frame)[0]
        if tactile is not None:
            tactile = tactile.split(2 * self.tokenizer.num_tokens)[0]
        return CleanTokens.through(self.joint_layers(), video, tactile)

    def denoise(
        self, context: Context, noisy: JointLatents, t: Float32[Tensor, " batch"]
    ) -> JointLatents:
        """`forward` with a context, which several times may share."""
        video, tactile, of_video, of_tactile = self._begin(context, noisy, t)
        if context.clean is None:
            mask = self.attention_mask(context.raster.shape[1]).to(t.device)
            for layer in self.layers:
                video, tactile = layer(video, tactile, mask)
        else:
            video, tactile = context.clean.update(self.joint_layers(), video, tactile)
        latents = self.video.finish(video, of_video)[:, self.config.past_images :]
        if self.tactile is None or tactile is None or of_tactile is None:
            return JointLatents(latents, self.with_clean_first(noisy, context.first).tactile)
        return JointLatents(latents, self.tactile.finish(tactile, of_tactile))

    def merge_adapters(self) -> None:
        """Merge adapters of the pretrained video expert into its weights, in place."""
        merge_adapters(self)
        self.config = self.config.adapted(rank=0)

    def joint_layers(self) -> list[JointLayer]:
        """The layers, typed."""
        return [layer for layer in self.layers if isinstance(layer, JointLayer)]

    def _begin(
        self, context: Context, noisy: JointLatents, t: Tensor
    ) -> tuple[Stream, Stream | None, Any, Condition | None]:
        """Both streams before the first layer, then their conditions."""
        noisy, first = self.with_clean_first(noisy, context.first), context.first.video
        frames = torch.cat([self._past(context), noisy.video], dim=1)
        times = _time_of_each(t, frames, self.config.num_clean_frames)
        of_video: Any = self.video_condition.at(context.video, times)
        video = self.video.start(frames, first, of_video, context.raster, context.past_raster)
        if self.views is not None:
            video = replace(video, tokens=self.views(video.tokens, context.missing))
        if self.tactile is None or self.tactile_condition is None or context.tactile is None:
            return video, None, of_video, None
        of_tactile = self.tactile_condition.at(context.tactile, _time_of_each(t, noisy.tactile))
        tactile = self.tactile.start(noisy.tactile, context.first.tactile, of_tactile)
        return video, tactile, of_video, of_tactile

    def _past(self, context: Context) -> Float32[Tensor, "batch past tokens channels"]:
        """Latents of past images as those of the window: residuals from its first, or plain."""
        past = context.past
        if self.config.video_target == "residual":
            past = past - context.first.video[:, None]
        return past / self.video_residual_std

    def with_clean_first(self, noisy: JointLatents, first: FirstLatents) -> JointLatents:
        """Latents whose first ones are clean: zero for residuals, `first` for plain ones."""
        video, tactile = torch.zeros_like(first.video), torch.zeros_like(first.tactile)
        if self.config.video_target == "plain":
            video = first.video / self.video_residual_std
        if self.config.tactile_target == "plain":
            tactile = first.tactile / self.tactile_residual_std
        return JointLatents(
            torch.cat([video[:, None], noisy.video[:, 1:]], dim=1),
            torch.cat([tactile[:, None], noisy.tactile[:, 1:]], dim=1),
        )

    def attention_mask(self, num_steps: int) -> Bool[Tensor, "tokens tokens"]:
        """Mask by which past and first images and first touch attend to each other only."""
        per_frame, num_clean = self.config.tokens_per_frame, self.config.num_clean_frames
        num_frames = num_clean - 1 + num_latents(num_steps)
        is_clean = torch.arange(num_frames * per_frame) < num_clean * per_frame
        if self.config.use_touch:
            per_step = 2 * self.tokenizer.num_tokens
            of_touch = torch.arange(num_steps * per_step) < per_step
            is_clean = torch.cat([is_clean, of_touch])
        return clean_mask(is_clean)

    def noise(self, num_steps: int, generator: torch.Generator) -> JointLatents:
        """Noise for one chunk of one rollout; stack several for a batch."""
        config = self.config
        video = (num_latents(num_steps), config.tokens_per_frame, config.video_channels)
        tactile = (num_steps, 2, self.tokenizer.num_tokens, self.tokenizer.channels)
        return JointLatents(
            torch.randn(1, *video, generator=generator),
            torch.randn(1, *tactile, generator=generator),
        )

    @torch.no_grad()
    def predict(
        self,
        inputs: ModelInputs,
        noise: JointLatents,
        *,
        sampling: Sampling | None = None,
        all_images: bool = True,
    ) -> Prediction:
        """Sample a future for every request, with its `noise`; of the images all, or the last."""
        inputs, sampling = self.with_past(inputs.to(self.device)), sampling or Sampling()
        noise, num_windows = mapped(noise, lambda one: one.to(self.device)), len(inputs)
        conditions = inputs
        if sampling.guidance != 1.0:
            everything = torch.ones(num_windows, dtype=torch.bool, device=self.device)
            conditions = inputs.joined(inputs.without(everything, everything))
        first, kept = self._observe(conditions, noise, sampling)
        clean = self.sample(conditions, first, noise, sampling, kept=kept)
        first = mapped(first, lambda one: one[:num_windows])
        future = self.decode(first, clean, all_images=all_images)
        touch = self.tokenizer.bounded(future.tactile_kpa, inputs.first_tactile_kpa)
        return replace(future, tactile_kpa=touch)

    def _observe(
        self, inputs: ModelInputs, noise: JointLatents, sampling: Sampling
    ) -> tuple[FirstLatents, CleanTokens | None]:
        """First latents, and clean tokens where those of earlier chunks are kept."""
        if self._observed is None or not sampling.keep_context:
            return self.first_latents(inputs), None

        def compute(rows: list[int]) -> list[Observed]:
            some = inputs.rows(rows)
            noisy = mapped(noise, lambda one: one[:1].expand(len(rows), *one.shape[1:]))
            first = self.first_latents(some)
            whole = Observed(first, self.clean_tokens(self.context(some, first), noisy))
            each = torch.split(torch.arange(len(rows), device=self.device), 1)
            return [mapped(whole, partial(torch.index_select, dim=0, index=row)) for row in each]

        found = combined(self._observed.of(inputs.first_step_keys(), compute), torch.cat)
        return found.first, found.clean

    @torch.no_grad()
    def sample(
        self,
        inputs: ModelInputs,
        first: FirstLatents,
        noise: JointLatents,
        sampling: Sampling,
        *,
        kept: CleanTokens | None = None,
    ) -> JointLatents:
        """Sample clean latents.

        With guidance, `inputs` and `first` are those of all windows, followed by the same without
        their instructions and actions. `kept` are clean tokens that are known already.
        """
        is_guided = sampling.guidance != 1.0
        num_steps = sampling.num_steps or self.config.sampling_steps

        def all_of(latents: Tensor) -> Tensor:
            return torch.cat([latents, latents]) if is_guided else latents

        context: Context | None = None
        if sampling.keep_context and (num_steps > 1 or kept is not None):
            context = self.context(inputs, first)
            kept = kept or self.clean_tokens(context, mapped(noise, all_of))
            context = replace(context, clean=kept)

        def denoise(video: Tensor, tactile: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
            noisy, times = JointLatents(all_of(video), all_of(tactile)), all_of(t)
            # Weights that are sharded over processes are there in `forward` only.
            guess = (
                self(inputs, first, noisy, times)
                if context is None
                else self.denoise(context, noisy, times)
            )
            found = guess.video.float(), guess.tactile.float()
            if is_guided:
                (conditioned, unconditional), touch = (one.chunk(2) for one in found)
                scale = sampling.guidance
                found = (
                    torch.lerp(unconditional, conditioned, scale),
                    torch.lerp(touch[1], touch[0], scale),
                )
            if self.config.prediction == "clean":
                return found
            return (
                flow_matching.clean_from_velocity(video, found[0], t),
                flow_matching.clean_from_velocity(tactile, found[1], t),
            )

        video, tactile = flow_matching.sample(
            denoise,
            (noise.video, noise.tactile),
            num_steps=num_steps,
            shift=self.config.sampling_time_shift,
            sampler=sampling.sampler or self.config.sampler,
            stop_after=sampling.stop_after,
        )
        return JointLatents(video, tactile)

    def decode(
        self, first: FirstLatents, clean: JointLatents, *, all_images: bool = True
    ) -> Prediction:
        """Images, maybe the last only, and pressures after the first step (0 without touch)."""
        clean = self.with_clean_first(clean, first)
        video = self.video_residual_std * clean.video
        if self.config.video_target == "residual":
            video = first.video[:, None] + video
        tactile = self.tactile_residual_std * clean.tactile[:, 1:]
        if self.config.tactile_target == "residual":
            tactile = first.tactile[:, None] + tactile
        if not self.config.use_touch:
            tactile = torch.zeros_like(tactile)
        views = split_axis(video, 2, (self.config.num_views, -1)).transpose(1, 2)
        images = self.codec.decode_future(views.flatten(0, 1), all_images=all_images)
        shown = split_axis(images, 0, (len(video), -1))
        touch = self.tokenizer.decode(tactile)
        return Prediction(shown[:, 0], touch, shown[:, 1:], first.video)


@contextmanager
def products_in(precision: Precision, device_type: str) -> Iterator[None]:
    """Autocast matrix products; silences torch's warning about norm weights kept in float32."""
    if precision == "float32":
        yield
        return
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Mismatch dtype between input and weight")
        with torch.autocast(device_type, dtype=torch.bfloat16):
            yield


def stack_noise(noises: Sequence[JointLatents]) -> JointLatents:
    """Stack the noise of several rollouts into a batch."""
    return combined(noises, torch.cat)


def from_first(latents: Float32[Tensor, "batch time ..."], target: str) -> Tensor:
    """Residuals of latents from the first ones, or themselves if `target` is "plain"."""
    return latents - latents[:, :1] if target == "residual" else latents


def _time_of_each(t: Tensor, latents: Tensor, num_clean: int = 1) -> Tensor:
    """Flow time of every latent or step: zero for the clean ones, which come first."""
    times = t[:, None].repeat(1, latents.shape[1])
    times[:, :num_clean] = 0.0
    return times
