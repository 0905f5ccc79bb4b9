"""Pressures of one hand come in; a glove that sends bare float32s and a tail goes out."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int64

from dextouch.errors import InvalidInputError
from dextouch.tactile.layout import NUM_TAXELS
from services.acquisition.drivers.glove_justfloat import TAIL
from services.acquisition.mocks.replay import ReplayStream

COUNTS_PER_KPA = 40.0


class JustFloatGloveSource:
    """Packets of one glove: the taxels' counts, then zeros in the slots that mean nothing.

    Args:
        stream: float32 [n, 320] in kPa.
        num_values: float32s of a packet, at least 320.
        full_scale: the largest reading.
        dead_taxels: places in the packet that read zero.
    """

    def __init__(
        self,
        stream: ReplayStream,
        *,
        num_values: int,
        full_scale: float,
        dead_taxels: Sequence[int] = (),
    ) -> None:
        if num_values < NUM_TAXELS:
            raise InvalidInputError(f"num_values: got {num_values}, expected at least {NUM_TAXELS}")
        # No device sends the negative zero that rounding leaves of noise.
        counts = np.clip(np.rint(COUNTS_PER_KPA * stream.values), 0.0, full_scale) + 0.0
        self._stream = stream
        self._values = np.zeros((len(counts), num_values), dtype="<f4")
        self._values[:, :NUM_TAXELS] = counts
        self._values[:, list(dead_taxels)] = 0.0

    @property
    def t_ns(self) -> Int64[np.ndarray, " n"]:
        """When each sample is taken."""
        return self._stream.t_ns

    def units(self, index: int, sequence: int, t_device_ns: int) -> list[bytes]:
        """One packet; the device tells neither number nor time."""
        del sequence, t_device_ns
        return [encode_justfloat(self._values[index])]


def encode_justfloat(values: Float32[np.ndarray, " n"]) -> bytes:
    """Bytes of one packet."""
    return values.astype("<f4").tobytes() + TAIL
