"""Shapes of the joint model, of the Wan2.2 networks and of the renderer, stored in checkpoints."""

from functools import cache
from operator import not_
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from pydantic import Field, model_validator
from pydantic_settings import CliSuppress

from dextouch.frozen_model import FrozenModel
from dextouch.tactile import LayoutDescription

if TYPE_CHECKING:
    import torch

    from dextouch.tactile.layout import TactileLayout
Sampler = Literal["euler", "unipc"]
Precision = Literal["float32", "bfloat16"]
TokenizerName = Literal["principal_axes", "split_hands", "grid"]
FurtherView = Literal["camera_wrist_left", "camera_wrist_right"]
PastChoice = Literal["nearest", "recent"]
Interpolation = Literal["bilinear", "bicubic"]
FRAMES_PER_LATENT = 4
RASTER_CELLS_PER_TOKEN = 4
# Fixed by the published autoencoder: it maps 1 + 4k images to 1 + k latents at a sixteenth of the
# resolution, and the transformer takes two by two of them as one token.
SPATIAL_FACTOR: Final = 16
LATENT_CHANNELS: Final = 48
PATCH: Final = (1, 2, 2)
# Mean and deviation of the latents by channel (`vae2_2.py` of Wan2.2).
LATENT_MEAN: Final = (
    -0.2289, -0.0052, -0.1323, -0.2339, -0.2799, 0.0174, 0.1838, 0.1557, -0.1382, 0.0542,
    0.2813, 0.0891, 0.1570, -0.0098, 0.0375, -0.1825, -0.2246, -0.1207, -0.0698, 0.5109,
    0.2665, -0.2108, -0.2158, 0.2502, -0.2055, -0.0322, 0.1109, 0.1567, -0.0729, 0.0899,
    -0.2799, -0.1230, -0.0313, -0.1649, 0.0117, 0.0723, -0.2839, -0.2083, -0.0520, 0.3748,
    0.0152, 0.1957, 0.1433, -0.2944, 0.3573, -0.0548, -0.1681, -0.0667,
)  # fmt: skip
LATENT_STD: Final = (
    0.4765, 1.0364, 0.4514, 1.1677, 0.5313, 0.4990, 0.4818, 0.5013, 0.8158, 1.0344,
    0.5894, 1.0901, 0.6885, 0.6165, 0.8454, 0.4978, 0.5759, 0.3523, 0.7135, 0.6804,
    0.5833, 1.4146, 0.8986, 0.5659, 0.7069, 0.5338, 0.4889, 0.4917, 0.4069, 0.4999,
    0.6866, 0.4093, 0.5709, 0.6065, 0.6415, 0.4944, 0.5726, 1.2042, 0.5458, 1.6887,
    0.3971, 1.0600, 0.3943, 0.5537, 0.5444, 0.4089, 0.7468, 0.7744,
)  # fmt: skip
# Parts of the transformer that stay in float32 whatever the precision of the others.
FLOAT32_PARTS: Final = ("time_embedder", "scale_shift_table", "norm1", "norm2", "norm3")


class WanFiles(FrozenModel):
    """Where the pretrained networks are; they are never downloaded."""

    folder: Path | None = Field(
        default=None, description="local folder of Wan2.2-TI2V-5B, for --network.video-expert wan"
    )
    text_cache: Path | None = Field(
        default=None, description="folder in which text features of instructions are kept"
    )
    latent_cache: Path | None = Field(
        default=None, description="file in which video latents of training images are kept"
    )
    max_memory_gb: float | None = Field(
        default=None, gt=0, description="limit of memory for one network; default: what there is"
    )

    @property
    def max_bytes(self) -> int | None:
        """The limit in bytes."""
        return None if self.max_memory_gb is None else int(self.max_memory_gb * 1e9)


class WanConfig(FrozenModel):
    """Sizes of the Wan2.2 networks beyond layers, heads and width, which `NetworkConfig` has."""

    ffn_width: int = Field(default=14336, ge=1, description="feed-forward width of a layer")
    time_width: int = Field(default=256, ge=2, description="sines and cosines of the time")
    text_width: int = Field(default=4096, ge=1, description="width of the text features")
    text_tokens: int = Field(default=512, ge=1, description="length that texts are padded to")
    vae_width: int = Field(default=160, ge=1, description="first width of the video encoder")
    vae_decoder_width: int = Field(default=256, ge=1, description="last width of the decoder")
    vae_blocks: int = Field(default=2, ge=1, description="residual blocks per resolution")
    precision: Precision = Field(
        default="bfloat16", description="of the weights; norms, times and modulation are float32"
    )
    # Of a checkpoint whose adapters are not merged; `--lora.rank` of a training.
    lora_rank: CliSuppress[int] = Field(default=0, ge=0, exclude_if=not_)
    lora_scale: CliSuppress[float] = Field(default=1.0, gt=0, exclude_if=lambda scale: scale == 1.0)

    @property
    def dtype(self) -> "torch.dtype":
        """Kind of number of the weights."""
        # Settings can be read and shown without torch.
        import torch

        return torch.float32 if self.precision == "float32" else torch.bfloat16

    def transformer_sizes(
        self, *, num_layers: int, num_heads: int, head_width: int
    ) -> dict[str, object]:
        """Arguments of `diffusers.WanTransformer3DModel`."""
        return {
            "patch_size": PATCH,
            "num_attention_heads": num_heads,
            "attention_head_dim": head_width,
            "in_channels": LATENT_CHANNELS,
            "out_channels": LATENT_CHANNELS,
            "text_dim": self.text_width,
            "freq_dim": self.time_width,
            "ffn_dim": self.ffn_width,
            "num_layers": num_layers,
            "cross_attn_norm": True,
            "qk_norm": "rms_norm_across_heads",
            "eps": 1e-6,
        }

    def autoencoder_sizes(self) -> dict[str, object]:
        """Arguments of `diffusers.AutoencoderKLWan`."""
        return {
            "base_dim": self.vae_width,
            "decoder_base_dim": self.vae_decoder_width,
            "z_dim": LATENT_CHANNELS,
            "dim_mult": [1, 2, 4, 4],
            "num_res_blocks": self.vae_blocks,
            "attn_scales": [],
            "temperal_downsample": [False, True, True],
            "latents_mean": list(LATENT_MEAN),
            "latents_std": list(LATENT_STD),
            "is_residual": True,
            # The images are cut into two by two pixels first.
            "in_channels": 12,
            "out_channels": 12,
            "patch_size": 2,
            "scale_factor_temporal": 4,
            "scale_factor_spatial": SPATIAL_FACTOR,
        }


class NetworkConfig(FrozenModel):
    """Shape and sampling of the joint model; stored in every checkpoint."""

    video_expert: Literal["tiny", "wan"] = Field(
        default="tiny", description="video expert and codec: small, or Wan2.2 from --wan.folder"
    )
    image_px: int = Field(default=64, ge=16, le=1024, description="side of the square head image")
    patch_px: int = Field(default=8, description="side of a visual patch")
    max_steps: int = Field(default=17, ge=5, description="longest window: 1 + 4k steps")
    codec_channels: int = Field(default=48, ge=1, le=768, description="latents per visual patch")
    tokenizer: TokenizerName = Field(
        default="principal_axes", description="tactile tokenizer; the learned ones need --tokenizer"
    )
    tactile_tokens: Literal["hand", "pad"] = Field(
        default="hand", description="tactile tokens: one per hand, or with split_hands one per pad"
    )
    palm_channels: int = Field(
        default=48, ge=1, le=240, description="latents per palm pad of principal_axes"
    )
    tactile_channels: int = Field(
        default=192, ge=6, le=1920, multiple_of=6, description="latents per hand of learned ones"
    )
    video_width: int = Field(default=96, ge=8, description="width of the visual expert")
    tactile_width: int = Field(default=96, ge=8, description="width of the tactile expert")
    num_layers: int = Field(default=3, ge=1, description="layers of each expert")
    num_heads: int = Field(default=3, ge=1, description="attention heads")
    head_width: int = Field(default=32, ge=4, description="width of an attention head")
    ffn_ratio: int = Field(default=3, ge=1, description="feed-forward width per expert's width")
    instruction_encoder: Literal["hashed_words", "subwords"] = Field(
        default="hashed_words", description="mean of hashed words, or weighted parts of words"
    )
    num_word_buckets: int = Field(default=64, ge=2, description="buckets of hashed_words")
    word_width: int = Field(default=16, ge=1, description="width of a word embedding")
    use_touch: bool = Field(default=True, description="predict touch, with a tactile expert")
    action_conditioning: Literal["adaln", "cross_attention"] = Field(
        default="adaln", description="actions enter by the layer norms, or by cross-attention"
    )
    add_condition_to_tokens: bool = Field(
        default=True, description="add the conditions to the tokens, too"
    )
    use_pose_raster: bool = Field(
        default=True, description="condition on a raster of the projected hands, too"
    )
    use_scene_encoder: bool = Field(
        default=True, description="condition touch on the first image and the hands' places, too"
    )
    use_contact_geometry: bool = Field(
        default=False,
        description="condition on distances of hands to the boxes of objects at a chunk's first "
        "step, too; needs episodes with object poses",
    )
    prediction: Literal["clean", "velocity"] = Field(
        default="clean", description="what is predicted: the clean latents, or the flow's velocity"
    )
    video_target: Literal["residual", "plain"] = Field(
        default="residual", description="video latents: residuals from the first, or themselves"
    )
    tactile_target: Literal["residual", "plain"] = Field(
        default="residual", description="tactile latents: residuals from the first, or themselves"
    )
    further_views: tuple[FurtherView, ...] = Field(
        default=(), exclude_if=not_, description="wrist cameras that are seen and predicted, too"
    )
    past_images: int = Field(
        default=0,
        ge=0,
        le=16,
        exclude_if=not_,
        description="images before the first one that a chunk is predicted from, too; 0: none",
    )
    past_choice: PastChoice = Field(
        default="nearest",
        exclude_if="nearest".__eq__,
        description="which: taken nearest to where the actions lead, or the most recent",
    )
    past_stride: int = Field(
        default=16,
        ge=4,
        le=256,
        multiple_of=4,
        exclude_if=(16).__eq__,
        description="steps between the images that are remembered",
    )
    training_time_shift: float = Field(
        default=5.0, ge=1.0, description="shift of flow-matching times in training"
    )
    sampling_time_shift: float = Field(
        default=3.0, ge=1.0, description="shift of flow-matching times in sampling"
    )
    sampling_steps: int = Field(default=1, ge=1, le=64, description="network calls per chunk")
    sampler: Sampler = Field(
        default="euler", description="solver of the flow: unipc needs fewer steps"
    )
    model_rate_hz: float = Field(default=15.0, gt=0, description="steps per second")
    wan: WanConfig | None = Field(default=None, description="sizes of Wan2.2 for its video expert")
    # Of another glove than `dextouch_v1`; training data say it.
    layout: CliSuppress[LayoutDescription | None] = Field(default=None, exclude_if=not_)

    @property
    def tactile_layout(self) -> "TactileLayout":
        """Layout of the taxels that the network feels."""
        return _layout(self.layout)

    def with_layout(self, layout: "TactileLayout") -> "NetworkConfig":
        """The configuration of a network for the taxels of another glove."""
        return self.model_copy(update={"layout": None if layout == _layout(None) else layout})

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
        if len(set(self.further_views)) != len(self.further_views):
            raise ValueError(f"further_views: got {self.further_views}, expected each once")
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
        given = {name: getattr(self, name) for name in expected}
        others = {
            name: (given[name], value) for name, value in expected.items() if given[name] != value
        }
        if self.wan is not None and others:
            raise ValueError(f"video_expert wan: got other sizes (got, expected): {others}")
        return self

    def adapted(self, rank: int, scale: float = 1.0) -> "NetworkConfig":
        """The configuration with adapters of this rank for Wan2.2; 0 for none."""
        if self.wan is None:
            return self
        wan = self.wan.model_copy(update={"lora_rank": rank, "lora_scale": scale})
        return self.model_copy(update={"wan": wan})

    @property
    def adapters(self) -> tuple[int, float] | None:
        """Rank and scale of the adapters of the pretrained video expert, if it has some."""
        wan = self.wan
        return (wan.lora_rank, wan.lora_scale) if wan is not None and wan.lora_rank else None

    @property
    def tokens_across(self) -> int:
        """Visual tokens along one side of the image."""
        return self.image_px // (2 * self.patch_px)

    @property
    def tokens_per_latent(self) -> int:
        """Visual tokens of one view in one latent frame."""
        return self.tokens_across**2

    @property
    def num_views(self) -> int:
        """Cameras: that of the head, then the further ones."""
        return 1 + len(self.further_views)

    @property
    def tokens_per_frame(self) -> int:
        """Visual tokens of one latent frame of all views, those of the head first."""
        return self.num_views * self.tokens_per_latent

    @property
    def num_clean_frames(self) -> int:
        """Latent frames without noise: the past images, then the first one."""
        return self.past_images + 1

    @property
    def raster_cells(self) -> int:
        """Cells along one side of the pose raster: four per token."""
        return RASTER_CELLS_PER_TOKEN * self.tokens_across

    @property
    def video_channels(self) -> int:
        """Channels of one visual token: four patches."""
        return 4 * self.codec_channels


def num_latents(num_steps: int) -> int:
    """Latent frames of 1 + 4k steps: the first step alone, then groups of four."""
    return 1 + (num_steps - 1) // FRAMES_PER_LATENT


@cache
def _layout(description: LayoutDescription | None) -> "TactileLayout":
    from dextouch.tactile.layout import DEXTOUCH_V1, TactileLayout  # not for a parser

    known = None if description is None else description.model_dump()
    return DEXTOUCH_V1 if known is None else TactileLayout.model_validate(known)


class RendererConfig(FrozenModel):
    """Shape of the renderer's network; image sides must be divisible by 2^(number of widths)."""

    widths: tuple[int, ...] = Field(
        default=(32, 64, 96), min_length=1, max_length=4, description="channels at 1/2, 1/4, …"
    )
    depths: tuple[int, ...] = Field(
        default=(1, 1, 2), min_length=1, max_length=4, description="residual blocks per level"
    )
    stem_px: int = Field(default=1, ge=1, le=5, description="kernel size of the first convolution")
    interpolation: Interpolation = Field(default="bicubic", description="of the warped start image")
    redraws_table: bool = Field(
        default=True, description="redraw the whole image when only the camera moves"
    )
