"""A recording in, its streams dated on the host's clock and converted to episode units out."""

from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int64, Shaped

from dextouch.errors import InvalidInputError
from dextouch.geometry.transforms import pose_from_transform, transform_from_pose
from dextouch.schemas.episodes import Matrix, matrix_rows
from dextouch.schemas.recordings import RecordingAttributes
from dextouch.streams.descriptors import StreamDescriptor
from dextouch.streams.samples import SampleBatch
from dextouch.tactile.layout import NUM_TAXELS
from services.alignment.calibration.tactile_baseline import REASONS, TactileCalibration
from services.alignment.synchronization.stream_clock import TimedStream, time_stream

# Where the tracked body sits in what the tracker follows, by stream.
MOUNTS = {
    "wrist_left": "T_tracker_left_wrist_left",
    "wrist_right": "T_tracker_right_wrist_right",
    "head": "T_tracker_head_camera_head",
}


@runtime_checkable
class Recording(Protocol):
    """What alignment reads of a recording (`dextouch.episodes.RecordingReader`)."""

    @property
    def attributes(self) -> RecordingAttributes:
        """Task, calibration, domain."""

    @property
    def streams(self) -> dict[str, StreamDescriptor]:
        """Descriptors by name."""

    @property
    def content_sha256(self) -> str:
        """Content hash."""

    def read(self, name: str) -> SampleBatch:
        """All samples of a stream."""


@dataclass(frozen=True)
class AlignedStream:
    """One stream on a common clock, in the units of an episode.

    `values` may hold NaN (keypoints that were not seen); `quality` are figures for the record, and
    `calibration` matrices that the episode carries beside those of the recording.
    """

    descriptor: StreamDescriptor
    t_ns: Int64[np.ndarray, " n"]
    values: Shaped[np.ndarray, "n ..."]
    timing: TimedStream
    quality: dict[str, float]
    calibration: dict[str, Matrix] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The stream's name."""
        return self.descriptor.name

    def complete(self) -> "AlignedStream":
        """Without samples that hold NaN or infinity."""
        if self.values.dtype.kind != "f":
            return self
        whole = np.isfinite(self.values).reshape(len(self.values), -1).all(axis=1)
        return replace(self, t_ns=self.t_ns[whole], values=self.values[whole])


def read_stream(recording: Recording, name: str) -> AlignedStream:
    """Read, date and convert one stream.

    Raises:
        ClockFitError: its stamps fit no clock.
        InvalidInputError: calibration is missing or of the wrong shape.
        UnknownNameError: the recording has no such stream.
    """
    descriptor, batch = recording.streams[name], recording.read(name)
    calibration = recording.attributes.calibration
    latency_ns = _nanoseconds(calibration, f"{name}_latency_ns")
    timing = time_stream(
        batch,
        descriptor,
        latency_ns=round(latency_ns or 0.0),
        latency_sigma_ns=_nanoseconds(calibration, f"{name}_latency_sigma_ns"),
    )
    values = batch.values[timing.kept]
    if descriptor.kind == "tactile" and descriptor.unit != "kPa":
        raw = AlignedStream(descriptor, timing.t_host_ns, values, timing, {})
        return _pressures(raw, calibration)
    if descriptor.kind == "keypoints":
        descriptor = descriptor.model_copy(update={"dtype": "float64"})
        values = values.astype(np.float64)
    elif descriptor.kind == "pose" and MOUNTS.get(name) in calibration:
        values = _move_to_body(values, calibration[MOUNTS[name]])
    elif descriptor.kind == "image":
        descriptor = descriptor.model_copy(update={"unit": "rgb8"})
    return AlignedStream(descriptor, timing.t_host_ns, values, timing, {})


def _nanoseconds(calibration: dict[str, Matrix], name: str) -> float | None:
    """A number of the calibration; None where it is not known."""
    matrix = calibration.get(name)
    if matrix is None:
        return None
    if np.shape(matrix) != (1, 1):
        raise InvalidInputError(f"calibration {name!r}: got {np.shape(matrix)}, expected (1, 1)")
    return float(matrix[0][0])


def _pressures(stream: AlignedStream, calibration: dict[str, Matrix]) -> AlignedStream:
    """Raw readings of any maker's glove as kPa; what is not measured is zero, named and counted."""
    name, side = stream.name, stream.descriptor.side
    if side is None:
        raise InvalidInputError(f"stream {name!r}: has no side, expected left or right")
    if len(stream.descriptor.shape) != 1:
        raise InvalidInputError(
            f"stream {name!r}: got samples of {stream.descriptor.shape}, expected a row of cells"
        )
    num_cells = stream.descriptor.shape[0]
    glove = TactileCalibration.from_record(calibration, side, num_cells=num_cells)
    refused = glove.refused_taxels(stream.values)
    numbers = np.bincount(refused, minlength=len(REASONS)).tolist()
    counted = {
        f"{name}_num_{reason}_taxels": float(number)
        for reason, number in zip(REASONS[1:], numbers[1:], strict=True)
        if number
    }
    return replace(
        stream,
        descriptor=stream.descriptor.model_copy(
            update={"shape": (NUM_TAXELS,), "dtype": "float32", "unit": "kPa"}
        ),
        values=glove.to_kpa(stream.values, refused=refused),
        quality={f"{name}_num_refused_taxels": float(np.count_nonzero(refused))} | counted,
        calibration={f"{name}_refused_taxels": matrix_rows(refused[None].astype(np.float64))},
    )


def _move_to_body(poses: np.ndarray, mount: Matrix) -> np.ndarray:
    T_tracker_body = np.array(mount)
    if T_tracker_body.shape != (4, 4):
        raise InvalidInputError(f"calibration: a mount is {T_tracker_body.shape}, expected (4, 4)")
    return pose_from_transform(transform_from_pose(poses) @ T_tracker_body)
