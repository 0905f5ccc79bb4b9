"""Streams of takes for calibrations, from a station's spool or an episode store."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import NotFoundError
from dextouch.schemas import Matrix
from dextouch.streams import SampleBatch, StreamDescriptor
from services.alignment.synchronization.stream_clock import time_stream


@dataclass(frozen=True)
class TakenStream:
    """All samples of one stream of a take, with the take's calibration."""

    take: str
    descriptor: StreamDescriptor
    batch: SampleBatch
    calibration: dict[str, Matrix]

    def number(self, name: str) -> float | None:
        """Value of a 1 × 1 matrix of the calibration; None if missing."""
        matrix = self.calibration.get(name)
        return None if matrix is None else float(matrix[0][0])

    def timed(self) -> tuple[Int64[np.ndarray, " n"], Shaped[np.ndarray, "n ..."]]:
        """Times on the host's clock without the calibrated latency, and the values at them.

        Raises:
            ClockFitError: no clock can be fitted to the stamps.
        """
        latency_ns = self.number(f"{self.descriptor.name}_latency_ns")
        timing = time_stream(self.batch, self.descriptor, latency_ns=round(latency_ns or 0.0))
        return timing.t_host_ns, self.batch.values[timing.kept]


def read_stream(take: str, name: str, store: str | None) -> TakenStream:
    """Read one stream of a spool folder, or of a recording in a store.

    Args:
        take: path of a spool folder, or id of a recording.
        name: name of the stream.
        store: URL of the store that has the recording; None for folders only.

    Raises:
        NotFoundError: no such take, or none with this stream.
    """
    reader: SpoolReader | RecordingReader
    if Path(take).is_dir():
        reader = SpoolReader(Path(take))
    elif store:
        reader = EpisodeStore(store).recording(take)
    else:
        raise NotFoundError(
            f"take {take!r}: no such folder; name a take of the station's spool, or add --store "
            "URL for the id of a recording"
        )
    if name not in reader.streams:
        raise NotFoundError(
            f"take {take!r}: has no {name!r}, only {', '.join(sorted(reader.streams))}"
        )
    calibration = dict(reader.attributes.calibration)
    return TakenStream(take, reader.streams[name], reader.read(name), calibration)
