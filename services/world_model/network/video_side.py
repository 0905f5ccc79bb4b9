"""Video side of the joint model by its configuration: a small one, or the transformer of Wan2.2.

Both give a codec, a condition, an expert and the expert's blocks with the same methods, so that
the joint model and its training know only one.
"""

from services.world_model.network.conditioning import VideoCondition
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.joint_attention import Block
from services.world_model.network.video_expert import VideoExpert
from services.world_model.network.visual_codec import VisualCodec
from services.world_model.network.wan_codec import WanVideoCodec
from services.world_model.network.wan_video import WanBlock, WanVideoCondition, WanVideoExpert
from services.world_model.wan.configuration import WanConfig
from services.world_model.wan.networks import empty_transformer


class TinyVideoSide:
    """Small expert, trained from scratch, on the latents of a linear codec."""

    def __init__(self, config: NetworkConfig) -> None:
        self._config = config

    def codec(self) -> VisualCodec:
        """Principal axes of patches."""
        return VisualCodec(self._config)

    def condition(self) -> VideoCondition:
        """Time, actions, instruction and kind of action."""
        return VideoCondition(self._config)

    def expert(self) -> VideoExpert:
        """Embedding and prediction."""
        return VideoExpert(self._config)

    def block(self, _: int) -> Block:
        """A new block."""
        return VideoExpert.block(self._config)


class WanVideoSide:
    """Parts of the networks of Wan2.2, on the meta device until their weights are loaded."""

    def __init__(self, config: NetworkConfig, wan: WanConfig) -> None:
        self._config, self._wan = config, wan
        self._transformer = empty_transformer(
            wan,
            num_layers=config.num_layers,
            num_heads=config.num_heads,
            head_width=config.head_width,
        )

    def codec(self) -> WanVideoCodec:
        """Video autoencoder."""
        return WanVideoCodec(self._config, self._wan)

    def condition(self) -> WanVideoCondition:
        """Time, actions and text features."""
        return WanVideoCondition(self._config, self._wan, self._transformer.condition_embedder)

    def expert(self) -> WanVideoExpert:
        """Embedding and prediction."""
        return WanVideoExpert(self._config, self._transformer)

    def block(self, index: int) -> Block:
        """A block of the transformer."""
        return WanBlock(self._transformer.blocks[index])


def video_side(config: NetworkConfig) -> TinyVideoSide | WanVideoSide:
    """The video side that the configuration names."""
    return TinyVideoSide(config) if config.wan is None else WanVideoSide(config, config.wan)
