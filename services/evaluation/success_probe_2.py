"""Network of success probes of kind 2, which saw the last image and touch only.

It is here for the checkpoint that comes with the package until that one is trained anew.
"""

import torch
from torch import nn

from services.evaluation.features import NUM_PAD_FEATURES
from services.evaluation.judge_network import ProbeBatch, ProbeShape, unit_images

KIND_2 = "success-probe-2"


class ProbeNetwork2(nn.Module):
    """Four strided convolutions on the last image, mean touch and task beside them."""

    def __init__(self, shape: ProbeShape) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = 3
        for width in (24, 32, 48, 48):
            layers.append(nn.Conv2d(channels, width, 3, stride=2, padding=1))
            layers += [nn.BatchNorm2d(width), nn.GELU()]
            channels = width
        side = -(-shape.image_size_px // 16)
        self.eye = nn.Sequential(*layers, nn.Flatten())
        self.task = nn.Embedding(len(shape.tasks), 8)
        self.head = nn.Sequential(
            nn.Dropout(0.3),
            nn.Linear(channels * side * side + NUM_PAD_FEATURES + 8, shape.hidden),
            nn.GELU(),
            nn.Linear(shape.hidden, 1),
        )

    def forward(self, batch: ProbeBatch) -> torch.Tensor:
        """Log odds [n, 1] of success; object poses are not looked at."""
        touch = batch.touch[:, :NUM_PAD_FEATURES]
        parts = [self.eye(unit_images(batch.images)), touch, self.task(batch.task)]
        return torch.as_tensor(self.head(torch.cat(parts, dim=1)))
