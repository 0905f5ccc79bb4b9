"""Storage design: plain zarr-python arrays with one image per chunk."""

import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.store.designs import OpenStore, StreamStore
from benchmarks.store.workload import IMAGE_SHAPE, WINDOW_IMAGES, Workload

STAMPS = "_t_ref_ns"
_ZSTD_LEVEL = 1


@dataclass(frozen=True)
class ZarrDesign:
    """zarr-python with images as `kind`; numbers and timestamps in chunks of one second.

    Images are written one by one as they arrive. Numbers are written at once at the end, which
    avoids zarr's slow small appends. The arrays have their final length from the start.
    """

    kind: Literal["jpeg", "jpeg-pool", "raw"]
    reads: str | None = None

    @property
    def name(self) -> str:
        """`zarr-` and the kind of its images."""
        return f"zarr-{self.kind}"

    def missing(self) -> str | None:
        """zarr-python, if it is not installed."""
        return None if importlib.util.find_spec("zarr") else "package zarr (pip install zarr)"

    def write(self, workload: Workload, folder: Path) -> None:
        """Write image by image, then all numbers."""
        import zarr

        group = zarr.open_group(str(folder), mode="w")
        cameras = {
            name: group.create_array(
                name,
                shape=stream.values.shape,
                chunks=(1, *IMAGE_SHAPE),
                dtype="uint8",
                **self._image_codec(),
            )
            for name, stream in workload.images.items()
        }
        for index in range(workload.num_images):
            for name, stream in workload.images.items():
                cameras[name][index] = stream.values[index]
        columns = {name: stream.values for name, stream in workload.numbers.items()}
        streams = {**workload.images, **workload.numbers}
        columns |= {name + STAMPS: stream.t_ref_ns for name, stream in streams.items()}
        for name, column in columns.items():
            rows = min(len(column), streams[name.removesuffix(STAMPS)].rate_hz)
            array = group.create_array(
                name, shape=column.shape, chunks=(rows, *column.shape[1:]), dtype=column.dtype
            )
            array[:] = column

    def open(self, folder: Path) -> OpenStore:
        """The group's arrays."""
        return _OpenZarr(folder)

    def _image_codec(self) -> dict[str, Any]:
        from zarr.codecs import ZstdCodec

        from benchmarks.store.zarr_codec import JpegCodec, PooledJpegCodec, register

        if self.kind == "raw":
            return {"compressors": ZstdCodec(level=_ZSTD_LEVEL)}
        register()
        codec = JpegCodec() if self.kind == "jpeg" else PooledJpegCodec()
        return {"serializer": codec, "compressors": None}


class _OpenZarr(StreamStore):
    """Windows by slices of arrays that are opened once."""

    def __init__(self, folder: Path) -> None:
        import zarr

        from benchmarks.store.zarr_codec import register

        register()
        self._arrays: dict[str, Any] = dict(zarr.open_group(str(folder), mode="r").arrays())

    def images(self, camera: str, start: int) -> np.ndarray:
        return self.numbers(camera, start, WINDOW_IMAGES)

    def numbers(self, name: str, start: int, count: int) -> np.ndarray:
        return np.asarray(self._arrays[name][start : start + count])
