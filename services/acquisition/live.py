"""Readings come in; the newest pressures and images go out for viewers, blocks for the health."""

from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np
from jaxtyping import Float32

from dextouch.errors import NotFoundError, StaleDataError
from dextouch.schemas.episodes import Matrix
from dextouch.streams.checks import H264_UNIT
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import Sample
from dextouch.tactile.layout import NUM_RAW_TAXELS, Side, select_taxels
from services.acquisition.drivers.base import Driver, Readings
from services.acquisition.drivers.image_encoding import GroupPreview
from services.acquisition.health_blocks import SampleBlocks
from services.acquisition.health_taxels import GloveRecord
from services.acquisition.schemas import CameraLive

MAX_AGE_NS = 500_000_000


class LiveView:
    """Keeps the newest sample of each stream; nothing is computed until someone looks."""

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
        self._gloves = {
            name: (
                calibration_row(calibration, f"{name}_tare_counts"),
                calibration_row(calibration, f"{name}_gain_counts_per_kpa"),
            )
            for name, d in self._descriptors.items()
            # Without a calibration the station starts all the same: it records the takes for one.
            if d.kind == "tactile"
            and d.unit == "counts"
            and d.shape == (NUM_RAW_TAXELS,)
            and {f"{name}_tare_counts", f"{name}_gain_counts_per_kpa"} <= calibration.keys()
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
        if stream not in self._gloves:
            return None
        side = _side(self._descriptors[stream])
        tare_counts, gain_counts_per_kpa = self._gloves[stream]
        sigma = np.array(self.calibration.get(f"{stream}_tare_sigma_counts", ()))
        sigma_counts = sigma.ravel() if sigma.size else np.zeros(NUM_RAW_TAXELS)
        return GloveRecord(
            side,
            select_taxels(tare_counts, side=side),
            select_taxels(gain_counts_per_kpa, side=side),
            select_taxels(sigma_counts.astype(np.float64), side=side),
        )

    def tactile_streams(self) -> list[str]:
        """Names of the glove streams."""
        return sorted(self._gloves)

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
        if camera in self._previews:
            return encode_jpeg(self._previews[camera].image())
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
