"""Inputs of calibrations: rows of CSV files, poses, and streams of takes."""

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from pydantic import BaseModel, ValidationError, field_validator, model_validator

from dextouch.episodes import EpisodeStore, RecordingReader
from dextouch.episodes.spool import SpoolReader
from dextouch.errors import InvalidInputError, NotFoundError, ShapeError
from dextouch.geometry import transform_from_pose
from dextouch.schemas import Matrix, first_problems, matrix_rows
from dextouch.streams import SampleBatch, StreamDescriptor
from services.alignment.synchronization.stream_clock import time_stream

POSE_COLUMNS = ("x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")

Row = TypeVar("Row", bound=BaseModel)


class PhotoPose(BaseModel):
    """Pose of the tracker at a photo: a matrix, or instead the columns `POSE_COLUMNS`."""

    image: str
    T_world_tracker: Matrix

    @model_validator(mode="before")
    @classmethod
    def _matrix_of_columns(cls, given: object) -> object:
        if not isinstance(given, dict) or not set(POSE_COLUMNS) <= given.keys():
            return given
        pose = np.array([float(given[column]) for column in POSE_COLUMNS])
        length = float(np.linalg.norm(pose[3:]))
        if not abs(length - 1) <= 0.01:
            raise ValueError(f"quaternion of length {length:.3f}, expected 1 (order w x y z)")
        return {**given, "T_world_tracker": matrix_rows(transform_from_pose(pose))}

    @field_validator("T_world_tracker")
    @classmethod
    def _is_4_by_4(cls, rows: Matrix) -> Matrix:
        if np.shape(rows) != (4, 4):
            raise ValueError(f"got {np.shape(rows)}, expected 4 by 4")
        return rows


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
                rows.append(_checked(kind, given, f"{path}: line {reader.line_num}", expected))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            f"{path}: no CSV in UTF-8 ({error}); expected {expected}"
        ) from error
    if not rows:
        raise InvalidInputError(f"{path}: holds no {item}; expected {expected}")
    return rows


def read_json(path: Path, expected: str) -> list[object]:
    """Read a list from a JSON file."""
    try:
        content = json.loads(_existing(path, expected).read_text(encoding="utf-8"))
    except ValueError as error:
        raise InvalidInputError(f"{path}: no JSON ({error}); expected {expected}") from error
    if not isinstance(content, list) or not content:
        raise InvalidInputError(f"{path}: expected a list with at least one pose: {expected}")
    return content


def pairs_of(entries: list[object], path: Path, expected: str) -> Float64[np.ndarray, "n 2 4 4"]:
    """Pairs of 4x4 matrices from the content of a JSON file."""
    try:
        pairs = np.array(entries, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InvalidInputError(f"{path}: {error}; expected {expected}") from error
    if pairs.ndim != 4 or pairs.shape[1:] != (2, 4, 4):
        raise ShapeError(f"{path}: got {pairs.shape}, expected [n, 2, 4, 4]: {expected}")
    return pairs


def poses_of_photos(
    path: Path, entries: list[object] | None, expected: str
) -> dict[str, np.ndarray]:
    """T_world_tracker by photo, from the content of a JSON file, or else from the CSV at `path`."""
    if entries is None:
        rows = read_rows(path, PhotoPose, "pose", expected)
    else:
        rows = [
            _checked(PhotoPose, e, f"{path}: entry {n}", expected) for n, e in enumerate(entries)
        ]
    poses: dict[str, np.ndarray] = {}
    for row in rows:
        if row.image in poses:
            raise InvalidInputError(f"{path}: image {row.image!r} is named twice")
        poses[row.image] = np.array(row.T_world_tracker)
    return poses


def _existing(path: Path, expected: str) -> Path:
    if not path.is_file():
        raise NotFoundError(f"{path}: no such file; expected {expected}")
    return path


def _checked(kind: type[Row], given: object, where: str, expected: str) -> Row:
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        raise InvalidInputError(f"{where}: {first_problems(error)}; expected {expected}") from error
