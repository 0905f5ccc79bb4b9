"""Grid tokenizer: palm and fingertips on one canvas under one network, the paper's baseline.

On the canvas of 20 by 20 cells, rows 0 to 3 hold the fingertips side by side, thumb to little
finger in columns 0 to 19. Rows 4 to 18 hold the palm in columns 2 to 17. The other 80 cells are
empty. Inside every pad rows run from distal to proximal and columns from radial to ulnar. The
canvas makes neighbours of taxels that are far apart on the hand.
"""

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from dextouch.tactile.layout import (
    NUM_FINGERTIPS,
    PALM_SHAPE,
    TIP_SHAPE,
    join_pads,
)
from services.world_model.network.configuration import NetworkConfig
from services.world_model.network.learned_tokenizer import LearnedTokenizer
from services.world_model.network.pad_autoencoder import MapDecoder, MapEncoder, MapShape

CANVAS_SHAPE = (20, 20)
_PALM_COLUMN = 2


def canvas_cells() -> np.ndarray:
    """Cell of the canvas, counted row by row, of each of the 320 taxels."""
    cells = np.arange(CANVAS_SHAPE[0] * CANVAS_SHAPE[1]).reshape(CANVAS_SHAPE)
    rows, columns = TIP_SHAPE
    tips = [cells[:rows, columns * finger :][:, :columns] for finger in range(NUM_FINGERTIPS)]
    palm = cells[rows : rows + PALM_SHAPE[0], _PALM_COLUMN : _PALM_COLUMN + PALM_SHAPE[1]]
    return join_pads(np.stack(tips), palm)


class GridTokenizer(LearnedTokenizer):
    """One autoencoder for the canvas, with as many weights and latents as Split-Hands."""

    _cells: Tensor

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        # The most accurate of three sizes with as many weights as Split-Hands.
        shape = MapShape(
            *CANVAS_SHAPE, num_maps=1, channels=config.tactile_channels, width=24, hidden=90,
            num_halvings=2,
        )  # fmt: skip
        self.encoder, self.decoder = MapEncoder(shape), MapDecoder(shape)
        self.register_buffer("_cells", torch.from_numpy(canvas_cells()), persistent=False)

    def encode_roots(self, roots: Float32[Tensor, "n 320"]) -> Float32[Tensor, "n latents"]:
        """Latents of the canvas."""
        canvas = roots.new_zeros(len(roots), CANVAS_SHAPE[0] * CANVAS_SHAPE[1])
        canvas[:, self._cells] = roots
        return self.encoder(canvas.reshape(-1, 1, *CANVAS_SHAPE)).flatten(1)

    def decode_roots(self, latents: Float32[Tensor, "n latents"]) -> Float32[Tensor, "n 320"]:
        """Root pressures at the taxels' cells."""
        return self.decoder(latents[:, None]).flatten(1)[:, self._cells]
