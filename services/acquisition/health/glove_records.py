"""What a station's calibration says of gloves, by which their readings are pressures."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from dextouch.errors import InvalidInputError, NotFoundError
from dextouch.schemas import Matrix
from dextouch.streams import TAXEL_UNIT, StreamDescriptor

# In the calibration's map, of a taxel that no cell measures.
NO_CELL = -1


@dataclass(frozen=True)
class GloveRecord:
    """counts = tare + gain · pressure of each cell, and the cell of each of its taxels.

    The sigma of a tare that does not state it is 0.
    """

    tare_counts: Float64[np.ndarray, " cells"]
    gain_counts_per_kpa: Float64[np.ndarray, " cells"]
    tare_sigma_counts: Float64[np.ndarray, " cells"]
    cells: Int64[np.ndarray, " taxels"]

    def to_kpa(
        self, readings: np.ndarray, refused: Bool[np.ndarray, " taxels"] | None = None
    ) -> Float64[np.ndarray, "n taxels"]:
        """Pressures of readings [n, cells]; 0 below the tare, and of taxels refused or absent."""
        offsets = readings[:, self.cells] - self.tare_counts[self.cells]
        is_out = self.cells == NO_CELL
        if refused is not None:
            is_out = is_out | refused
        gain = np.where(is_out, np.inf, self.gain_counts_per_kpa[self.cells])
        return np.asarray(np.maximum(np.nan_to_num(offsets), 0.0) / gain)


def is_ours(descriptor: StreamDescriptor) -> bool:
    """Whether a stream holds counts of a glove whose layout wires its cells: they need no map."""
    layout = descriptor.tactile_layout
    return descriptor.unit == "counts" and descriptor.shape == (layout.num_raw_cells,)


def mapped_cells(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> Int64[np.ndarray, " taxels"] | None:
    """For each taxel the number of its cell, -1 for none; None where no map (1 x taxels) is known.

    The map of the calibration comes before that of the stream's layout; a stream that is already in
    kPa has its taxels in order.

    Raises:
        NotFoundError: the map is of another size.
        InvalidInputError: it names a cell that the glove has not.
    """
    num_cells, name = math.prod(descriptor.shape), f"{descriptor.name}_cells"
    if descriptor.layout is not None and descriptor.unit == TAXEL_UNIT:
        return np.arange(num_cells)
    if name not in calibration:
        layout, side = descriptor.layout, descriptor.side
        return None if layout is None or side is None else layout.raw_indices(side)
    cells = _row(calibration, name, descriptor.tactile_layout.num_taxels)
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
    if descriptor.kind != "tactile" or names[0] not in calibration:
        return None
    if descriptor.layout is not None and descriptor.unit == TAXEL_UNIT:
        return None
    layout = descriptor.tactile_layout
    kpa_per_unit = None if descriptor.layout is None else layout.nominal_kpa_per_unit
    if names[1] not in calibration and kpa_per_unit is None:
        return None
    num_cells = math.prod(descriptor.shape)
    cells = mapped_cells(descriptor, calibration)
    if cells is None:
        if not is_ours(descriptor):
            return None
        if descriptor.side is None:
            raise NotFoundError(f"stream {descriptor.name!r}: a glove without a side")
        cells = layout.raw_indices(descriptor.side)
    tare = _row(calibration, names[0], num_cells)
    if names[1] in calibration or kpa_per_unit is None:
        gain = _row(calibration, names[1], num_cells)
    else:
        gain = np.ones(num_cells)
        gain[cells[cells != NO_CELL]] = 1.0 / kpa_per_unit[cells != NO_CELL]
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


def refused_taxels(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix], record: GloveRecord
) -> Bool[np.ndarray, " taxels"]:
    """Taxels whose gain the calibration refused."""
    states = np.array(calibration.get(f"{descriptor.name}_taxel_state", ())).ravel()
    if states.shape != record.tare_counts.shape:
        states = np.zeros(len(record.tare_counts))
    return (states[record.cells] > 0) & (record.cells != NO_CELL)
