"""Inputs of calibrations: rows of CSV files, poses, and streams of takes."""

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError, NotFoundError, ShapeError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import Matrix, first_problems
from dextouch.streams import SampleBatch, StreamDescriptor
from services.alignment.synchronization.stream_clock import time_stream

Row = TypeVar("Row", bound=BaseModel)


class PhotoPose(BaseModel):
    """Pose of the tracker in the world at a photo: position (m) and unit quaternion."""

    model_config = ConfigDict(allow_inf_nan=False)

    image: str
    x_m: float
    y_m: float
    z_m: float
    qw: float
    qx: float
    qy: float
    qz: float

    @model_validator(mode="after")
    def _is_unit(self) -> "PhotoPose":
        length = float(np.linalg.norm(self.pose[3:]))
        if not abs(length - 1) <= 0.01:
            raise ValueError(f"quaternion of length {length:.3f}, expected 1 (order w x y z)")
        return self

    @property
    def pose(self) -> Float64[np.ndarray, "7"]:
        """x, y, z, qw, qx, qy, qz."""
        return np.array([self.x_m, self.y_m, self.z_m, self.qw, self.qx, self.qy, self.qz])


@dataclass(frozen=True)
class TakenStream:
    """All samples of one stream of a take, with the take's calibration."""

    take: str
    descriptor: StreamDescriptor
    batch: SampleBatch
    calibration: Mapping[str, Matrix]

    def number(self, name: str) -> float:
        """Value of a 1 × 1 matrix of the calibration; 0 if missing."""
        return float(self.calibration.get(name, ((0.0,),))[0][0])

    def timed(self) -> tuple[Int64[np.ndarray, " n"], Shaped[np.ndarray, "n ..."]]:
        """Times on the host's clock without the calibrated latency, and the values at them."""
        latency_ns = round(self.number(f"{self.descriptor.name}_latency_ns"))
        timing = time_stream(self.batch, self.descriptor, latency_ns=latency_ns)
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
    return TakenStream(take, reader.streams[name], reader.read(name), reader.attributes.calibration)


def read_rows(path: Path, kind: type[Row], item: str, expected: str) -> list[Row]:
    """Rows of a CSV file in UTF-8, at least one; empty cells count as absent.

    Args:
        path: file with a line of column names.
        kind: model of a row.
        item: what a row is, for messages.
        expected: columns of the file, for messages.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not such a CSV; the message names the line.
    """
    rows = []
    try:
        with _existing(path, expected).open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            for cells in reader:
                given = {str(column): cell for column, cell in cells.items() if cell}
                rows.append(kind.model_validate(given))
    except ValidationError as error:
        raise InvalidInputError(
            f"{path}: line {reader.line_num}: {first_problems(error)}; expected {expected}"
        ) from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            f"{path}: no CSV in UTF-8 ({error}); expected {expected}"
        ) from error
    if not rows:
        raise InvalidInputError(f"{path}: holds no {item}; expected {expected}")
    return rows


def read_pairs(path: Path, expected: str) -> Float64[np.ndarray, "n 2 4 4"]:
    """Pairs of 4x4 matrices from a JSON file, at least one.

    Raises:
        NotFoundError: no such file.
        InvalidInputError: not JSON, or not numbers.
        ShapeError: not pairs of 4x4.
    """
    try:
        pairs = np.array(json.loads(_existing(path, expected).read_bytes()), dtype=np.float64)
    except json.JSONDecodeError as error:
        raise InvalidInputError(f"{path}: no JSON ({error}); expected {expected}") from error
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"{path}: {error}; expected {expected}") from error
    if pairs.ndim != 4 or pairs.shape[1:] != (2, 4, 4):
        raise ShapeError(
            f"{path}: got {pairs.shape}, expected [n, 2, 4, 4], at least one pair: {expected}"
        )
    return pairs


def poses_of_photos(path: Path, expected: str) -> dict[str, np.ndarray]:
    """T_world_tracker by photo, from a CSV file; no photo may be named twice."""
    poses: dict[str, np.ndarray] = {}
    for row in read_rows(path, PhotoPose, "pose", expected):
        if row.image in poses:
            raise InvalidInputError(f"{path}: image {row.image!r} is named twice")
        poses[row.image] = transform_from_pose(row.pose)
    return poses


def _existing(path: Path, expected: str) -> Path:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file; expected {expected}")
    return path
