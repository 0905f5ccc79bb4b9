"""Video expert: embeds video latents for the joint layers and predicts clean ones."""

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from services.world_model.network.axes import split_axis
from services.world_model.network.conditioning import Condition
from services.world_model.network.configuration import (
    FRAMES_PER_LATENT,
    RASTER_CELLS_PER_TOKEN,
    NetworkConfig,
)
from services.world_model.network.joint_attention import (
    NUM_MODULATIONS,
    ExpertBlock,
    Stream,
    modulated_norm,
    zero_linear,
)


class VideoExpert(nn.Module):
    """Visual stream: `tokens_per_latent` tokens per latent frame; the first frame is clean."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.video_width
        self.tokens_across = config.tokens_across
        self.use_pose_raster = config.use_pose_raster
        self.add_condition = config.add_condition_to_tokens
        self.is_anchored = config.video_target == "residual"
        raster_width = 2 * FRAMES_PER_LATENT * RASTER_CELLS_PER_TOKEN**2
        # Residuals come with the latent that they are relative to.
        self.embed = nn.Linear((1 + self.is_anchored) * config.video_channels, width)
        self.embed_raster = nn.Linear(raster_width, width, bias=False)
        self.places = nn.Parameter(0.02 * torch.randn(config.tokens_per_latent, width))
        self.frames = nn.Parameter(0.02 * torch.randn(config.max_latents, 1, width))
        self.modulate = nn.Sequential(nn.SiLU(), zero_linear(width, NUM_MODULATIONS * width))
        self.modulate_out = nn.Sequential(nn.SiLU(), zero_linear(width, 2 * width))
        self.predict = zero_linear(width, config.video_channels)

    @staticmethod
    def block(config: NetworkConfig) -> ExpertBlock:
        """This expert's block of one joint layer."""
        return ExpertBlock(
            width=config.video_width,
            num_heads=config.num_heads,
            head_width=config.head_width,
            ffn_ratio=config.ffn_ratio,
            attends_to_actions=config.action_conditioning == "cross_attention",
        )

    def start(
        self,
        noisy: Float32[Tensor, "batch latents tokens channels"],
        first: Float32[Tensor, "batch tokens channels"],
        condition: Condition,
        raster: Float32[Tensor, "batch time 2 cells cells"],
    ) -> Stream:
        """Tokens before the first layer.

        `noisy` are residuals, the first one zero, or plain latents, the first one clean.
        """
        num_latents, dtype = noisy.shape[1], self.places.dtype
        condition = condition.to(dtype)
        if self.is_anchored:
            noisy = torch.cat([noisy, first[:, None].expand_as(noisy)], dim=-1)
        tokens = self.embed(noisy.to(dtype)) + self.places + self.frames[:num_latents]
        if self.add_condition:
            tokens = tokens + condition.vector[:, :, None]
        if self.use_pose_raster:
            tokens = tokens + self.embed_raster(self.raster_tokens(raster).to(dtype))
        modulation = split_axis(self.modulate(condition.vector), -1, (NUM_MODULATIONS, -1))
        per_token = modulation.repeat_interleave(noisy.shape[2], dim=1)
        return Stream(tokens.flatten(1, 2), per_token, actions=condition.actions)

    def finish(
        self, stream: Stream, condition: Condition
    ) -> Float32[Tensor, "batch latents tokens channels"]:
        """Predict the clean latents, or the velocity, as the configuration says."""
        condition = condition.to(self.places.dtype)
        tokens = split_axis(stream.tokens, 1, (condition.vector.shape[1], -1))
        shift, scale = (
            self.modulate_out(condition.vector)[:, :, None]
            .expand(-1, -1, tokens.shape[2], -1)
            .chunk(2, dim=-1)
        )
        return self.predict(modulated_norm(tokens, shift, scale)).float()

    def raster_tokens(
        self, raster: Float32[Tensor, "batch time 2 cells cells"]
    ) -> Float32[Tensor, "batch latents tokens values"]:
        """The raster cut into image tokens: four steps, four by four cells and two hands each."""
        first = raster[:, :1].expand(-1, FRAMES_PER_LATENT, -1, -1, -1)
        padded = torch.cat([first, raster[:, 1:]], dim=1)
        groups = split_axis(padded, 1, (-1, FRAMES_PER_LATENT))
        cells = (self.tokens_across, RASTER_CELLS_PER_TOKEN)
        grid = split_axis(split_axis(groups, 5, cells), 4, cells)
        # [B, L, 4, 2, rows, 4, cols, 4] -> [B, L, rows, cols, 4, 2, 4, 4]
        return grid.permute(0, 1, 4, 6, 2, 3, 5, 7).flatten(4).flatten(2, 3)
