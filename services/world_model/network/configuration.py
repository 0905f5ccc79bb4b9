"""Network configuration: shape and sampling of the joint model, stored in its checkpoint."""

from typing import Literal

from pydantic import Field, model_validator

from dextouch.frozen_model import FrozenModel
from services.world_model.wan.configuration import (
    LATENT_CHANNELS,
    SPATIAL_FACTOR,
    WanConfig,
)

Sampler = Literal["euler", "unipc"]
Precision = Literal["float32", "bfloat16"]
TokenizerName = Literal["principal_axes", "split_hands", "grid"]


class NetworkConfig(FrozenModel):
    """Shape and sampling of the joint model; stored in every checkpoint."""

    video_expert: Literal["tiny", "wan"] = Field(
        default="tiny",
        description="video expert and codec: small ones, or Wan2.2 from --wan.folder",
    )
    image_px: int = Field(default=64, ge=16, le=1024, description="side of the square head image")
    patch_px: int = Field(default=8, description="side of a visual patch")
    max_steps: int = Field(default=17, ge=5, description="longest window: 1 + 4k steps")
    codec_channels: int = Field(default=48, ge=1, le=768, description="latents per visual patch")
    tokenizer: TokenizerName = Field(
        default="principal_axes",
        description="tactile tokenizer; the learned ones need --tokenizer",
    )
    tactile_tokens: Literal["hand", "pad"] = Field(
        default="hand", description="tactile tokens: one per hand, or with split_hands one per pad"
    )
    palm_channels: int = Field(
        default=48, ge=1, le=240, description="latents per palm pad of principal_axes"
    )
    tactile_channels: int = Field(
        default=192,
        ge=6,
        le=1920,
        multiple_of=6,
        description="latents per hand of split_hands and grid",
    )
    video_width: int = Field(default=96, ge=8, description="width of the visual expert")
    tactile_width: int = Field(default=96, ge=8, description="width of the tactile expert")
    num_layers: int = Field(default=3, ge=1, description="layers of each expert")
    num_heads: int = Field(default=3, ge=1, description="attention heads")
    head_width: int = Field(default=32, ge=4, description="width of an attention head")
    ffn_ratio: int = Field(
        default=3, ge=1, description="feed-forward width relative to the expert's width"
    )
    instruction_encoder: Literal["hashed_words", "subwords"] = Field(
        default="hashed_words",
        description="instructions as the mean of hashed words, or as weighted parts of words",
    )
    num_word_buckets: int = Field(
        default=64, ge=2, description="hash buckets for words of hashed_words"
    )
    word_width: int = Field(default=16, ge=1, description="width of a word embedding")
    use_touch: bool = Field(
        default=True, description="predict touch; without it the tactile expert is left out"
    )
    action_conditioning: Literal["adaln", "cross_attention"] = Field(
        default="adaln",
        description="actions enter by the modulation of layer norms, or by cross-attention",
    )
    add_condition_to_tokens: bool = Field(
        default=True, description="add the conditions to the tokens, too"
    )
    use_pose_raster: bool = Field(
        default=True, description="condition on a raster of the projected hands, too"
    )
    use_scene_encoder: bool = Field(
        default=True,
        description="condition touch on an encoding of the first image and the hands' places, too",
    )
    use_contact_geometry: bool = Field(
        default=False,
        description="condition on the distances of hand points to the boxes of the objects, as "
        "they lie at a chunk's first step, too; needs episodes with object poses",
    )
    prediction: Literal["clean", "velocity"] = Field(
        default="clean",
        description="what the network predicts and the loss compares: the clean latents, or the "
        "flow's velocity",
    )
    video_target: Literal["residual", "plain"] = Field(
        default="residual",
        description="video latents: residuals from the first one, or the latents themselves",
    )
    tactile_target: Literal["residual", "plain"] = Field(
        default="residual",
        description="tactile latents: residuals from the first ones, or the latents themselves",
    )
    training_time_shift: float = Field(
        default=5.0, ge=1.0, description="shift of flow-matching times in training"
    )
    sampling_time_shift: float = Field(
        default=3.0, ge=1.0, description="shift of flow-matching times in sampling"
    )
    sampling_steps: int = Field(default=2, ge=1, le=64, description="network calls per chunk")
    sampler: Sampler = Field(
        default="euler",
        description="solver of the flow: unipc needs fewer steps for the same accuracy",
    )
    model_rate_hz: float = Field(default=15.0, gt=0, description="steps per second")
    wan: WanConfig | None = Field(default=None, description="sizes of Wan2.2 for its video expert")

    @model_validator(mode="after")
    def _sizes_fit(self) -> "NetworkConfig":
        if (self.max_steps - 1) % FRAMES_PER_LATENT:
            raise ValueError(f"max_steps: got {self.max_steps}, expected 1 + 4k")
        if not self.use_touch and self.tokenizer != "principal_axes":
            raise ValueError(f"tokenizer: got {self.tokenizer} without touch, expected the default")
        if self.image_px % (2 * self.patch_px):
            raise ValueError(
                f"image_px: got {self.image_px}, expected a multiple of {2 * self.patch_px} "
                "(tokens of two patches by two)"
            )
        return self

    @model_validator(mode="after")
    def _wan_fits(self) -> "NetworkConfig":
        if (self.video_expert == "wan") != (self.wan is not None):
            raise ValueError(
                f"wan: got {'sizes' if self.wan else 'none'} with video_expert "
                f"{self.video_expert}, expected them for wan only"
            )
        expected = {
            "patch_px": SPATIAL_FACTOR,
            "codec_channels": LATENT_CHANNELS,
            "video_width": self.num_heads * self.head_width,
            "use_pose_raster": False,
            "use_contact_geometry": False,
            "action_conditioning": "adaln",
            "prediction": "velocity",
            "video_target": "plain",
        }
        others = {
            name: (getattr(self, name), value)
            for name, value in expected.items()
            if getattr(self, name) != value
        }
        if self.wan is not None and others:
            raise ValueError(f"video_expert wan: got other sizes (got, expected): {others}")
        return self

    @property
    def tokens_across(self) -> int:
        """Visual tokens along one side of the image."""
        return self.image_px // (2 * self.patch_px)

    @property
    def tokens_per_latent(self) -> int:
        """Visual tokens of one latent frame."""
        return self.tokens_across**2

    @property
    def raster_cells(self) -> int:
        """Cells along one side of the pose raster: four per token."""
        return RASTER_CELLS_PER_TOKEN * self.tokens_across

    @property
    def video_channels(self) -> int:
        """Channels of one visual token: four patches."""
        return 4 * self.codec_channels

    @property
    def max_latents(self) -> int:
        """Latent frames of the longest window."""
        return num_latents(self.max_steps)


FRAMES_PER_LATENT = 4
RASTER_CELLS_PER_TOKEN = 4


def num_latents(num_steps: int) -> int:
    """Latent frames of 1 + 4k steps: the first step alone, then groups of four."""
    return 1 + (num_steps - 1) // FRAMES_PER_LATENT
