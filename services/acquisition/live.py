"""Readings come in; the newest pressures and images go out, for viewers."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np
from jaxtyping import Float32, UInt16

from dextouch.errors import NotFoundError, StaleDataError
from dextouch.schemas.episodes import Matrix
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import Sample
from dextouch.tactile.layout import NUM_RAW_TAXELS, Side, select_taxels
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.schemas import CameraLive

BLOCK_SAMPLES = 120
MAX_AGE_NS = 500_000_000


class LiveView:
    """Keeps the newest sample of each stream; nothing is computed until someone looks."""

    def __init__(self, drivers: Sequence[Driver], calibration: Mapping[str, Matrix]) -> None:
        self._descriptors: dict[str, StreamDescriptor] = {
            d.name: d for driver in drivers for d in driver.descriptors
        }
        self._newest: dict[str, Sample] = {}
        self._counts: dict[str, deque[np.ndarray]] = {
            name: deque(maxlen=BLOCK_SAMPLES)
            for name, d in self._descriptors.items()
            if d.kind == "tactile"
        }
        self._gloves = {
            name: (
                calibration_row(calibration, f"{name}_tare_counts"),
                calibration_row(calibration, f"{name}_gain_counts_per_kpa"),
            )
            for name in self._counts
        }

    def accept(self, device: str, readings: Readings) -> None:
        """Remember (called by the reader threads)."""
        del device
        for name, samples in readings.items():
            self._newest[name] = samples[-1]
            if name in self._counts:
                self._counts[name].extend(sample.values for sample in samples)

    def take_counts(self, stream: str) -> UInt16[np.ndarray, "n 360"]:
        """Counts that came since the last call (the newest 2 s of them)."""
        queue = self._counts[stream]
        block = [queue.popleft() for _ in range(len(queue))]
        if not block:
            return np.empty((0, NUM_RAW_TAXELS), dtype=np.uint16)
        return np.stack(block).astype(np.uint16)

    def tactile_streams(self) -> list[str]:
        """Names of the glove streams."""
        return sorted(self._counts)

    def pressures_kpa(self, now_ns: int) -> dict[str, Float32[np.ndarray, "320"]]:
        """Newest pressures by stream, of gloves heard within the last 0.5 s; never older ones."""
        pressures: dict[str, np.ndarray] = {}
        for name, (tare_counts, gain_counts_per_kpa) in self._gloves.items():
            sample = self._newest.get(name)
            if sample is None or now_ns - sample.t_host_ns > MAX_AGE_NS:
                continue
            raw_kpa = (sample.values.astype(np.float64) - tare_counts) / gain_counts_per_kpa
            taxels = select_taxels(raw_kpa, side=_side(self._descriptors[name]))
            pressures[name] = np.maximum(taxels, 0.0).astype(np.float32)
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
                        image_index=sample.sequence,
                        age_s=(now_ns - sample.t_host_ns) / 1e9,
                        height_px=descriptor.shape[0],
                        width_px=descriptor.shape[1],
                    )
                )
        return found

    def jpeg(self, camera: str, now_ns: int) -> bytes:
        """Newest image of a camera as JPEG.

        Raises:
            NotFoundError: no such camera, or no image yet.
            StaleDataError: the newest image is older than 0.5 s.
        """
        from dextouch.images.jpeg import encode_jpeg

        descriptor = self._descriptors.get(camera)
        sample = self._newest.get(camera)
        if descriptor is None or descriptor.kind != "image" or sample is None:
            raise NotFoundError(f"camera {camera!r}: not there, or no image yet")
        age_s = (now_ns - sample.t_host_ns) / 1e9
        if age_s * 1e9 > MAX_AGE_NS:
            raise StaleDataError(f"camera {camera!r}: the newest image is {age_s:.1f} s old")
        if descriptor.unit == "jpeg":
            return bytes(sample.values.item())
        return encode_jpeg(sample.values)


def calibration_row(calibration: Mapping[str, Matrix], name: str) -> np.ndarray:
    """360 numbers of a glove's calibration.

    Raises:
        NotFoundError: it is missing or of another size.
    """
    row = np.array(calibration.get(name, ()), dtype=np.float64).ravel()
    if row.shape != (NUM_RAW_TAXELS,):
        raise NotFoundError(
            f"calibration {name!r}: got {row.size} numbers, expected {NUM_RAW_TAXELS}; "
            "calibrate the glove and give the station its record"
        )
    return row


def _side(descriptor: StreamDescriptor) -> Side:
    for side in get_args(Side):
        if descriptor.side == side:
            return side
    raise NotFoundError(f"stream {descriptor.name!r}: a glove without a side")
