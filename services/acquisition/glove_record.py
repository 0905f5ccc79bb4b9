"""Calibration record of a glove: tare and gain of its cells, and the cell of each of its taxels."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import Matrix
from dextouch.streams import StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, raw_indices

# In the calibration's map, of a taxel that no cell measures.
NO_CELL = -1


@dataclass(frozen=True)
class GloveRecord:
    """counts = tare + gain · pressure of each cell, and the cell of each of the 320 taxels.

    The sigma of a tare that does not state it is 0.
    """

    tare_counts: Float64[np.ndarray, " cells"]
    gain_counts_per_kpa: Float64[np.ndarray, " cells"]
    tare_sigma_counts: Float64[np.ndarray, " cells"]
    cells: Int64[np.ndarray, "320"]


def is_ours(descriptor: StreamDescriptor) -> bool:
    """Whether a stream is that of our own glove, whose cells need no map."""
    return descriptor.unit == "counts" and descriptor.shape == (NUM_RAW_TAXELS,)


def mapped_cells(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> Int64[np.ndarray, "320"] | None:
    """For each taxel the number of its cell, -1 for none; None where no map (1 x 320) is known.

    Raises:
        NotFoundError: the map is of another size.
        InvalidInputError: it names a cell that the glove has not.
    """
    num_cells, name = math.prod(descriptor.shape), f"{descriptor.name}_cells"
    if name not in calibration:
        return None
    cells = _row(calibration, name, NUM_TAXELS)
    wrong = (cells != np.rint(cells)) | (cells < NO_CELL) | (cells >= num_cells)
    if wrong.any():
        taxel = int(np.argmax(wrong))
        raise InvalidInputError(
            f"calibration {name!r}: got {cells[taxel]:g} for taxel {taxel}, expected a whole "
            f"number -1 … {num_cells - 1}, the cell of the {descriptor.side} glove that measures it"
        )
    return cells.astype(np.int64)


def glove_record(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> GloveRecord | None:
    """What makes pressures of a glove's readings; None where the calibration does not say it.

    Raises:
        NotFoundError: a row of another size, or a glove without a side.
        InvalidInputError: a map that names a cell that the glove has not.
    """
    names = [f"{descriptor.name}_{what}" for what in ("tare_counts", "gain_counts_per_kpa")]
    if descriptor.kind != "tactile" or not set(names) <= calibration.keys():
        return None
    num_cells = math.prod(descriptor.shape)
    cells = mapped_cells(descriptor, calibration)
    if cells is None:
        if not is_ours(descriptor):
            return None
        if descriptor.side is None:
            raise NotFoundError(f"stream {descriptor.name!r}: a glove without a side")
        cells = raw_indices(side=descriptor.side)
    tare, gain = (_row(calibration, name, num_cells) for name in names)
    name = f"{descriptor.name}_tare_sigma_counts"
    stated = np.size(calibration.get(name, ())) > 0
    sigma = _row(calibration, name, num_cells) if stated else np.zeros(num_cells)
    return GloveRecord(tare, gain, sigma, cells)


def _row(calibration: Mapping[str, Matrix], name: str, size: int) -> Float64[np.ndarray, " size"]:
    row = np.array(calibration[name], dtype=np.float64).ravel()
    if row.shape != (size,):
        raise NotFoundError(
            f"calibration {name!r}: got {row.size} numbers, expected {size}; "
            "calibrate the glove and give the station its record"
        )
    return row
