"""Joint model of future images and pressures: two experts with shared attention."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor, nn

from services.world_model.network import flow_matching
from services.world_model.network.conditioning import ActionNormalizer, TactileCondition
from services.world_model.network.configuration import NetworkConfig, num_latents
from services.world_model.network.inputs import ModelInputs
from services.world_model.network.joint_attention import JointLayer, clean_mask
from services.world_model.network.solvers import Sampler
from services.world_model.network.tactile_expert import TactileExpert
from services.world_model.network.tokenizer_choice import build_tokenizer
from services.world_model.network.video_side import video_side
from services.world_model.network.visual_codec import to_unit
from services.world_model.network.wan_video import WanVideoCondition
from services.world_model.wan.configuration import FLOAT32_PARTS
from services.world_model.wan.text import TextFeatures

Precision = Literal["float32", "bfloat16"]
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
class Prediction:
    """Future after the first step; images of all its steps, or of the last four only."""

    images: Float32[Tensor, "batch shown px px 3"]
    tactile_kpa: Float32[Tensor, "batch steps 2 320"]


class JointWorldModel(nn.Module):
    """Video and tactile expert on latents, with their frozen codecs."""

    video_residual_std: Tensor
    tactile_residual_std: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        side = video_side(config)
        self.codec = side.codec()
        self.tokenizer = build_tokenizer(config).requires_grad_(requires_grad=False)
        self.normalizer = ActionNormalizer()
        self.register_buffer("video_residual_std", torch.ones(()))
        self.register_buffer("tactile_residual_std", torch.ones(()))
        self.video_condition = side.condition()
        self.tactile_condition = TactileCondition(config) if config.use_touch else None
        self.video = side.expert()
        self.tactile: TactileExpert | None = None
        if config.use_touch:
            self.tactile = TactileExpert(
                config, num_tokens=self.tokenizer.num_tokens, channels=self.tokenizer.channels
            )
        self.layers = nn.ModuleList(
            JointLayer(side.block(index), TactileExpert.block(config) if config.use_touch else None)
            for index in range(config.num_layers)
        )

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
        kept = {name: tensor.data for name, tensor in tensors if _keeps_precision(name)}
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        for name, tensor in (*self.named_parameters(), *self.named_buffers()):
            if name in kept and tensor.dtype != kept[name].dtype:
                tensor.data = kept[name].to(tensor.device)
        return self

    def first_latents(self, inputs: ModelInputs) -> FirstLatents:
        """Latents of the first image and the first touch."""
        images = to_unit(inputs.first_image)[:, None]
        return FirstLatents(
            self.codec.encode(images)[:, 0], self.tokenizer.encode(inputs.first_tactile_kpa)
        )

    def targets(
        self,
        images: UInt8[Tensor, "batch time px px 3"],
        tactile_kpa: Float32[Tensor, "batch time 2 320"],
    ) -> JointLatents:
        """Clean latents of recorded windows, which the flow ends at, in units of their deviation.

        Residuals from the first latents, or the latents themselves, as the configuration says.
        """
        video = self.codec.encode(to_unit(images))
        if self.config.video_target == "residual":
            video = video - video[:, :1]
        return JointLatents(video / self.video_residual_std, self.tactile_targets(tactile_kpa))

    def tactile_targets(
        self, tactile_kpa: Float32[Tensor, "batch time 2 320"]
    ) -> Float32[Tensor, "batch time 2 tactile_tokens tactile_channels"]:
        """Clean tactile latents; as `targets`."""
        tactile = self.tokenizer.encode(tactile_kpa)
        if self.config.tactile_target == "residual":
            tactile = tactile - tactile[:, :1]
        return tactile / self.tactile_residual_std

    def forward(
        self,
        inputs: ModelInputs,
        first: FirstLatents,
        noisy: JointLatents,
        t: Float32[Tensor, " batch"],
    ) -> JointLatents:
        """Predict clean latents, or velocities, from noisy ones at time t (the first are clean).

        Without touch the tactile latents are returned as they came.
        """
        features, noisy = self.normalizer(inputs), self.with_clean_first(noisy, first)
        video_condition = self.video_condition(inputs, features, _time_of_each(t, noisy.video))
        video = self.video.start(noisy.video, first.video, video_condition, inputs.raster)
        mask = self.attention_mask(inputs.num_steps).to(t.device)
        if self.tactile is None or self.tactile_condition is None:
            for layer in self.layers:
                video, _ = layer(video, None, mask)
            return JointLatents(self.video.finish(video, video_condition), noisy.tactile)
        tactile_condition = self.tactile_condition(
            inputs, features, _time_of_each(t, noisy.tactile)
        )
        tactile = self.tactile.start(noisy.tactile, first.tactile, tactile_condition)
        for layer in self.layers:
            video, tactile = layer(video, tactile, mask)
        return JointLatents(
            self.video.finish(video, video_condition),
            self.tactile.finish(tactile, tactile_condition),
        )

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
        """Mask by which clean tokens (first latent frame and touch) attend to each other only."""
        per_latent = self.config.tokens_per_latent
        is_clean_video = torch.arange(num_latents(num_steps) * per_latent) < per_latent
        if not self.config.use_touch:
            return clean_mask(is_clean_video)
        per_step = 2 * self.tokenizer.num_tokens
        is_clean_tactile = torch.arange(num_steps * per_step) < per_step
        return clean_mask(torch.cat([is_clean_video, is_clean_tactile]))

    def noise(self, num_steps: int, generator: torch.Generator) -> JointLatents:
        """Noise for one chunk of one rollout; stack several for a batch."""
        config = self.config
        video = (num_latents(num_steps), config.tokens_per_latent, config.video_channels)
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
        sampling_steps: int | None = None,
        sampler: Sampler | None = None,
        all_images: bool = True,
        precision: Precision = "float32",
    ) -> Prediction:
        """Sample a future for every request.

        Args:
            inputs: from `build_inputs`.
            noise: one per request, from `noise`; like the inputs it may be on any device.
            sampling_steps: network calls; None uses the configuration's.
            sampler: solver of the flow; None uses the configuration's.
            all_images: decode every image, or only those of the last latent.
            precision: of the experts' matrix products (autocast); codecs always use float32.
        """
        device = self.device
        inputs = inputs.to(device)
        first = self.first_latents(inputs)

        def denoise(video: Tensor, tactile: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
            with products_in(precision, video.device.type):
                guess = self(inputs, first, JointLatents(video, tactile), t)
            found = guess.video.float(), guess.tactile.float()
            if self.config.prediction == "clean":
                return found
            return (
                flow_matching.clean_from_velocity(video, found[0], t),
                flow_matching.clean_from_velocity(tactile, found[1], t),
            )

        video, tactile = flow_matching.sample(
            denoise,
            (noise.video.to(device), noise.tactile.to(device)),
            num_steps=sampling_steps or self.config.sampling_steps,
            shift=self.config.sampling_time_shift,
            sampler=sampler or self.config.sampler,
        )
        future = self.decode(first, JointLatents(video, tactile), all_images=all_images)
        touch = self.tokenizer.bounded(future.tactile_kpa, inputs.first_tactile_kpa)
        return Prediction(future.images, touch)

    def decode(
        self, first: FirstLatents, clean: JointLatents, *, all_images: bool = True
    ) -> Prediction:
        """Images and pressures after the first step; of the images maybe the last four only.

        Without touch all pressures are zero.
        """
        clean = self.with_clean_first(clean, first)
        video = self.video_residual_std * clean.video
        if self.config.video_target == "residual":
            video = first.video[:, None] + video
        tactile = self.tactile_residual_std * clean.tactile[:, 1:]
        if self.config.tactile_target == "residual":
            tactile = first.tactile[:, None] + tactile
        if not self.config.use_touch:
            tactile = torch.zeros_like(tactile)
        images = self.codec.decode_future(video, all_images=all_images)
        return Prediction(images, self.tokenizer.decode(tactile))


def _keeps_precision(name: str) -> bool:
    """Whether a tensor keeps its precision when the experts are converted."""
    return name.startswith(_EXACT_PARTS) or any(part in name for part in FLOAT32_PARTS)


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
    return JointLatents(
        torch.cat([noise.video for noise in noises]), torch.cat([noise.tactile for noise in noises])
    )


def _time_of_each(t: Tensor, latents: Tensor) -> Tensor:
    """Flow time of every latent or step: zero for the clean first one."""
    times = t[:, None].repeat(1, latents.shape[1])
    times[:, 0] = 0.0
    return times
