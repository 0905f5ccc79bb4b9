"""Clean tokens of a chunk, computed once for all steps of the sampler.

Clean tokens (first latent frame and first touch) attend to each other only and have flow time 0, so
that in every layer their keys and values are the same at every step. Noisy tokens attend to these
and to each other, which needs no mask.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from services.world_model.network.joint_attention import JointLayer, KeysValues, Stream


@dataclass(frozen=True)
class CleanTokens:
    """Clean tokens of both streams after the last layer, and the keys and values of each layer."""

    video: Stream
    tactile: Stream | None
    layers: tuple[KeysValues, ...]

    @classmethod
    def through(
        cls, layers: Iterable[JointLayer], video: Stream, tactile: Stream | None
    ) -> "CleanTokens":
        """Clean tokens that enter the first layer, taken through all of them."""
        kept = []
        for layer in layers:
            video, tactile, keys_values = layer.update_after(None, video, tactile)
            kept.append(keys_values)
        return cls(video, tactile, tuple(kept))

    def update(
        self, layers: Iterable[JointLayer], video: Stream, tactile: Stream | None
    ) -> tuple[Stream, Stream | None]:
        """All tokens after the last layer; of those given, only the noisy ones are computed."""
        video = video.split(self.video.tokens.shape[1])[1]
        if tactile is not None and self.tactile is not None:
            tactile = tactile.split(self.tactile.tokens.shape[1])[1]
        for layer, past in zip(layers, self.layers, strict=True):
            video, tactile, _ = layer.update_after(past, video, tactile)
        if tactile is None or self.tactile is None:
            return _joined(self.video, video), None
        return _joined(self.video, video), _joined(self.tactile, tactile)


def _joined(clean: Stream, noisy: Stream) -> Stream:
    """All tokens; modulation and so on are those of the noisy ones."""
    return replace(noisy, tokens=torch.cat([clean.tokens, noisy.tokens], dim=1))
