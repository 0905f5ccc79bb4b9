"""The newest pressures and images of a station for viewers, and its samples for its health."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from jaxtyping import Float32, Float64, Int64

from dextouch.errors import InvalidInputError, NotFoundError, StaleDataError
from dextouch.schemas import Matrix
from dextouch.streams import H264_UNIT, Sample, StreamDescriptor
from dextouch.tactile.layout import NUM_RAW_TAXELS, NUM_TAXELS, Side, raw_indices, select_taxels
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.image_encoding import GroupPreview
from services.acquisition.health_blocks import SampleBlocks
from services.acquisition.health_cells import NO_CELL
from services.acquisition.health_taxels import GloveRecord
from services.acquisition.schemas import CameraLive

MAX_AGE_NS = 500_000_000


@dataclass(frozen=True)
class _LiveGlove:
    """counts = tare + gain · pressure of each cell, and the cell of each of the 320 taxels."""

    tare_counts: Float64[np.ndarray, " cells"]
    gain_counts_per_kpa: Float64[np.ndarray, " cells"]
    cells: Int64[np.ndarray, "320"]


class LiveView:
    """Keeps the newest sample of each stream; nothing is computed until it is requested."""

    def __init__(self, drivers: Sequence[Driver], calibration: Mapping[str, Matrix]) -> None:
        self._descriptors: dict[str, StreamDescriptor] = {
            d.name: d for driver in drivers for d in driver.descriptors
        }
        self._newest: dict[str, Sample] = {}
        self._num_images: dict[str, int] = {}
        self._previews = {
            name: GroupPreview((d.shape[0], d.shape[1]))
            for name, d in self._descriptors.items()
            if d.unit == H264_UNIT
        }
        self.blocks = SampleBlocks(self._descriptors)
        self.calibration = dict(calibration)
        # Without a calibration the station starts all the same: it records the takes for one.
        self._gloves = {
            name: glove
            for name, descriptor in self._descriptors.items()
            if (glove := _live_glove(descriptor, calibration)) is not None
        }

    def accept(self, device: str, readings: Readings) -> None:
        """Remember (called by the reader threads)."""
        del device
        for name, samples in readings.items():
            if name in self._previews:
                for sample in samples:
                    self._previews[name].add(bytes(sample.values.item()))
            self._newest[name] = samples[-1]
            self._num_images[name] = self._num_images.get(name, 0) + len(samples)
            self.blocks.add(name, samples)

    def glove(self, stream: str) -> GloveRecord | None:
        """Tare and gain of the 320 taxels of a glove of ours; None for other streams."""
        glove = self._gloves.get(stream)
        if glove is None or not _is_ours(self._descriptors[stream]):
            return None
        side = _side(self._descriptors[stream])
        sigma = np.array(self.calibration.get(f"{stream}_tare_sigma_counts", ()))
        sigma_counts = sigma.ravel() if sigma.size else np.zeros(NUM_RAW_TAXELS)
        return GloveRecord(
            side,
            select_taxels(glove.tare_counts, side=side),
            select_taxels(glove.gain_counts_per_kpa, side=side),
            select_taxels(sigma_counts.astype(np.float64), side=side),
        )

    def pressures_kpa(self, now_ns: int) -> dict[str, Float32[np.ndarray, "320"]]:
        """Newest pressures by stream, of gloves heard within the last 0.5 s; never older ones.

        Taxels that the glove has not, or from which it has no reading, are 0.
        """
        pressures: dict[str, np.ndarray] = {}
        for name, glove in self._gloves.items():
            sample = self._newest.get(name)
            if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
                continue
            cells_kpa = (sample.values.ravel() - glove.tare_counts) / glove.gain_counts_per_kpa
            taxels = np.where(glove.cells == NO_CELL, 0.0, cells_kpa[glove.cells])
            pressures[name] = np.maximum(np.nan_to_num(taxels), 0.0).astype(np.float32)
        return pressures

    def cameras(self, now_ns: int) -> list[CameraLive]:
        """Cameras that have sent an image."""
        found = []
        for name, descriptor in sorted(self._descriptors.items()):
            sample = self._newest.get(name)
            if descriptor.kind == "image" and sample is not None:
                found.append(
                    CameraLive(
                        name=name,
                        image_index=self._num_images[name],
                        age_s=(now_ns - sample.t_host_ns) / 1e9,
                        height_px=descriptor.shape[0],
                        width_px=descriptor.shape[1],
                    )
                )
        return found

    def jpeg(self, camera: str, now_ns: int) -> bytes:
        """Newest image of a camera as JPEG.

        Raises:
            NotFoundError: no such camera, or no image yet (of H.264: no key frame yet).
            StaleDataError: the newest image is older than 0.5 s.
        """
        from dextouch.images import encode_jpeg

        descriptor = self._descriptors.get(camera)
        sample = self._newest.get(camera)
        if descriptor is None or descriptor.kind != "image" or sample is None:
            raise NotFoundError(f"camera {camera!r}: not there, or no image yet")
        age_s = (now_ns - sample.t_host_ns) / 1e9
        if age_s * 1e9 > MAX_AGE_NS:
            raise StaleDataError(f"camera {camera!r}: the newest image is {age_s:.1f} s old")
        if descriptor.unit == "jpeg":
            return bytes(sample.values.item())
        if camera in self._previews:
            return encode_jpeg(self._previews[camera].image())
        return encode_jpeg(sample.values)


def _is_ours(descriptor: StreamDescriptor) -> bool:
    """Whether a stream is that of our own glove, whose cells need no map."""
    return descriptor.unit == "counts" and descriptor.shape == (NUM_RAW_TAXELS,)


def _live_glove(
    descriptor: StreamDescriptor, calibration: Mapping[str, Matrix]
) -> _LiveGlove | None:
    """What makes pressures of a glove's readings; None where the calibration does not say it."""
    tare, gain = (f"{descriptor.name}_{what}" for what in ("tare_counts", "gain_counts_per_kpa"))
    if descriptor.kind != "tactile" or not {tare, gain} <= calibration.keys():
        return None
    num_cells = math.prod(descriptor.shape)
    cells_name = f"{descriptor.name}_cells"
    if cells_name in calibration:
        cells = _row(calibration, cells_name, NUM_TAXELS).astype(np.int64)
        if cells.min() < NO_CELL or cells.max() >= num_cells:
            raise InvalidInputError(
                f"calibration {cells_name!r}: got cells {cells.min()} … {cells.max()}, expected "
                f"-1 … {num_cells - 1}"
            )
    elif _is_ours(descriptor):
        cells = raw_indices(side=_side(descriptor))
    else:
        return None
    return _LiveGlove(_row(calibration, tare, num_cells), _row(calibration, gain, num_cells), cells)


def _row(calibration: Mapping[str, Matrix], name: str, size: int) -> np.ndarray:
    """So many numbers of a glove's calibration.

    Raises:
        NotFoundError: they are missing or of another size.
    """
    row = np.array(calibration.get(name, ()), dtype=np.float64).ravel()
    if row.shape != (size,):
        raise NotFoundError(
            f"calibration {name!r}: got {row.size} numbers, expected {size}; "
            "calibrate the glove and give the station its record"
        )
    return row


def _side(descriptor: StreamDescriptor) -> Side:
    for side in get_args(Side):
        if descriptor.side == side:
            return side
    raise NotFoundError(f"stream {descriptor.name!r}: a glove without a side")
