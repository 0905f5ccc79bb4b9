"""Features of taxel pressures for small networks: a few numbers per pad."""

import numpy as np
from jaxtyping import Float32

from dextouch.errors import NonFiniteError, ShapeError
from dextouch.tactile.layout import NUM_TAXELS, split_pads

NUM_PAD_FEATURES = 24


def pad_features(tactile_kpa: np.ndarray) -> Float32[np.ndarray, "*batch 24"]:
    """Mean and maximum of √kPa / 4 per hand and pad: where the hand touches, and how hard.

    Args:
        tactile_kpa: [..., 2, 320]; small negative readings count as zero.

    Raises:
        ShapeError: not [..., 2, 320].
        NonFiniteError: NaN or infinity.
    """
    taxels = np.asarray(tactile_kpa, dtype=np.float32)
    if taxels.shape[-2:] != (2, NUM_TAXELS):
        raise ShapeError(f"tactile: got shape {taxels.shape}, expected [..., 2, {NUM_TAXELS}]")
    if not np.isfinite(taxels).all():
        raise NonFiniteError("tactile: NaN or infinite pressure; expected finite kPa")
    tips, palm = split_pads(np.sqrt(np.maximum(taxels, 0.0)) / 4)
    parts = [tips.mean((-2, -1)), palm.mean((-2, -1))[..., None]]
    parts += [tips.max((-2, -1)), palm.max((-2, -1))[..., None]]
    features = np.concatenate(parts, axis=-1)
    return features.reshape(*features.shape[:-2], NUM_PAD_FEATURES)
