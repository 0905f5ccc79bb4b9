"""Calibration folder, its age and accuracy, and inputs: CSV rows, poses, streams of takes."""

import codecs
import csv
import json
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float64, Int64, Shaped
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError, model_validator

from dextouch import __version__
from dextouch.clients import Reply
from dextouch.command_line import progress
from dextouch.episodes import EpisodeStore, RecordingReader, replace_file
from dextouch.episodes.spool import SpoolReader, read_attributes
from dextouch.errors import (
    CorruptDataError,
    InvalidInputError,
    NonFiniteError,
    NotFoundError,
    ShapeError,
)
from dextouch.geometry import transform_from_pose
from dextouch.schemas import Matrix, first_problems, matrix_rows
from dextouch.streams import SampleBatch, StreamDescriptor
from services.alignment.calibration.motion import WANTED_ROTATION_RAD, WANTED_TRANSLATION_M
from services.alignment.synchronization.stream_clock import TimedStream, time_stream

MATRICES_FILE = "calibration.json"
DETAILS_FILE = "calibration_details.json"
PICTURES = "pictures"
# Quaternion norm below which a pose counts as lost, since trackers then send zeros.
MIN_NORM = 0.5
# Tracker of each camera, by the stream names of recordings.
TRACKERS: Final = {"head": "head", "wrist_left": "left", "wrist_right": "right"}

Named = TypeVar("Named")
_MATRICES = TypeAdapter(dict[str, Matrix]).validate_json
_DETAILS = TypeAdapter(dict[str, object]).validate_json
TICK_S = 0.1
# Timeout of an upload.
UPLOAD_S = 120.0

Found = TypeVar("Found")
Request = Callable[..., Reply]
Say = Callable[[str], None]

# Learners need these, and alignment those of the recorded gloves.
NEEDED = ("K_head",)
LEVELS = {"OK": "green", "WARN": "yellow", "ERROR": "bold red"}
MAX_AGE_S = 7 * 86_400.0
# Limits of sigma (relative or absolute) above which there is a warning.
MAX_FOCAL_SIGMA = 0.003
MAX_GAIN_SIGMA = 0.05
MAX_TAXEL_FAULTS = {"WARN": 0.01, "ERROR": 0.05}
# Degrees and millimetres.
MOUNT_LIMITS = (float(np.rad2deg(WANTED_ROTATION_RAD)), WANTED_TRANSLATION_M * 1e3)
BASE_LIMITS = (0.2, 2.0)
# Column of a hand profile that holds the sigma of the knuckles, in metres.
PROFILE_SIGMA = 7
# Matrices of a glove that are metadata, or that are added by an episode.
_ABOUT_GLOVES = ("noise_counts", "taxel_state", "cells", "refused_taxels")

# What is wrong with a calibration: level and reason.
Problem = tuple[str, str]
Sigma = tuple[str, list[Problem]]


def write_entry(
    folder: Path,
    entry: str,
    matrices: Mapping[str, np.ndarray | float],
    facts: Mapping[str, object],
) -> None:
    """Write an entry of a calibration folder, measured now; other entries are kept.

    An entry is named as its main matrix, such as `K_head`; numbers and vectors become matrices of
    one row; the facts are details for humans, JSON. Raises NonFiniteError: NaN or infinity in a
    matrix; CorruptDataError: an existing file cannot be read.
    """
    for name, matrix in matrices.items():
        if not np.all(np.isfinite(matrix)):
            raise NonFiniteError(f"calibration {name!r}: NaN or infinity; nothing was written")
    # Whole seconds, which are exact in float64.
    now = datetime.now(UTC).replace(microsecond=0)
    old = read_matrices(folder) if (folder / MATRICES_FILE).exists() else {}
    details_path = folder / DETAILS_FILE
    details = _read(details_path, _DETAILS, "details by entry") if details_path.is_file() else {}
    stamped = {**matrices, f"{entry}_calibrated_at_unix_s": now.timestamp()}
    new = {name: matrix_rows(np.atleast_2d(matrix)) for name, matrix in stamped.items()}
    made = {"made_at": now.isoformat(timespec="seconds"), "software": f"dextouch {__version__}"}
    details[entry] = {**facts, **made, "matrices": sorted(new)}
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in ((details_path, details), (folder / MATRICES_FILE, {**old, **new})):
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        replace_file(path, text.encode())


def write_pose(
    folder: Path, name: str, T: np.ndarray, sigma: tuple[float, float], facts: dict[str, object]
) -> str:
    """Write a transform [4, 4] as an entry and say its sigma (rad, m), also in the facts."""
    rad, m = sigma
    facts |= {"sigma_rotation_deg": float(np.rad2deg(rad)), "sigma_translation_mm": m * 1e3}
    write_entry(folder, name, {name: T, f"{name}_sigma_rad": rad, f"{name}_sigma_m": m}, facts)
    return f"{name}: known to {np.rad2deg(rad):.3f}° and {m * 1e3:.2f} mm"


def read_matrices(folder: Path) -> dict[str, Matrix]:
    """Matrices of a folder or JSON file; raises NotFoundError or CorruptDataError."""
    path = folder / MATRICES_FILE if folder.is_dir() else folder
    if not path.is_file():
        raise NotFoundError(
            f"{path}: no calibration there; `dextouch station calibrate camera --help` begins one"
        )
    return _read(path, _MATRICES, "named matrices")


def _read(path: Path, validate: Callable[[bytes], Named], what: str) -> Named:
    try:
        return validate(path.read_bytes().removeprefix(codecs.BOM_UTF8))
    except ValidationError as error:
        raise CorruptDataError(f"{path}: no JSON of {what} ({first_problems(error)})") from error


def write_picture(folder: Path, name: str, svg: str) -> Path:
    """Write a picture beside the matrices and return its path."""
    path = folder / PICTURES / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(svg, encoding="utf-8")
    return path


def named_matrix(matrices: Mapping[str, Matrix], name: str, shape: tuple[int, int]) -> np.ndarray:
    """Get a matrix as float64."""
    if name not in matrices:
        raise NotFoundError(
            f"calibration: {name!r} is missing; there is {', '.join(sorted(matrices)) or 'nothing'}"
        )
    matrix = np.array(matrices[name], dtype=np.float64)
    if matrix.shape != shape:
        raise InvalidInputError(f"calibration {name!r}: got {matrix.shape}, expected {shape}")
    return matrix


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


def number_of(calibration: Mapping[str, Matrix], name: str, default: float = 0.0) -> float:
    """Value of a 1 × 1 matrix of a calibration, or the default."""
    return float(calibration[name][0][0]) if name in calibration else default


@dataclass(frozen=True)
class TakeStream:
    """All samples of one stream of a take, which `where` names, with the take's calibration."""

    where: str
    descriptor: StreamDescriptor
    batch: SampleBatch
    calibration: Mapping[str, Matrix]

    def number(self, name: str) -> float:
        """Value of a 1 × 1 matrix of the calibration; 0 if missing."""
        return number_of(self.calibration, name)

    def timing(self) -> TimedStream:
        """Times on the host's clock without the calibrated latency."""
        latency_ns = round(self.number(f"{self.descriptor.name}_latency_ns"))
        return time_stream(self.batch, self.descriptor, latency_ns=latency_ns)

    def timed(self) -> tuple[Int64[np.ndarray, " n"], Shaped[np.ndarray, "n ..."]]:
        """The times, and the values at them."""
        timing = self.timing()
        return timing.t_host_ns, self.batch.values[timing.kept]

    def poses(self) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 7"]]:
        """Times and poses of valid tracking; raises InvalidInputError: fewer than two."""
        t_ns, values = self.timed()
        poses = values.astype(np.float64)
        seen = np.isfinite(poses).all(axis=1) & (np.linalg.norm(poses[:, 3:], axis=1) > MIN_NORM)
        if np.count_nonzero(seen) < 2:
            raise InvalidInputError(
                f"{self.where}: {self.descriptor.name} has {np.count_nonzero(seen)} valid "
                "poses, expected two seconds of them; was the tracker visible?"
            )
        return t_ns[seen], poses[seen]


def open_take(take: str, store: str | None) -> SpoolReader | RecordingReader:
    """Open a take by its spool folder, or by id in the store; raises NotFoundError."""
    if Path(take).is_dir():
        return SpoolReader(Path(take))
    if store:
        return EpisodeStore(store).recording(take)
    raise NotFoundError(
        f"take {take!r}: no such folder; name a take of the station's spool, or add --store URL "
        "for the id of a recording"
    )


def read_stream(take: str, name: str, store: str | None) -> TakeStream:
    """Read one stream of a take (`open_take`); raises NotFoundError for a take without it."""
    reader = open_take(take, store)
    if name not in reader.streams:
        raise NotFoundError(
            f"take {take!r}: has no {name!r}, only {', '.join(sorted(reader.streams))}"
        )
    where = f"take {take!r}"
    return TakeStream(where, reader.streams[name], reader.read(name), reader.attributes.calibration)


def read_rows(path: Path, kind: type[Row], item: str, expected: str) -> list[Row]:
    """Rows of a CSV file in UTF-8, at least one, of a kind; empty cells count as absent.

    `item` and `expected` are a row and the columns in messages. Raises NotFoundError: no such file;
    InvalidInputError: not such a CSV; the message names the line.
    """
    rows = []
    try:
        with _existing(path, expected).open(encoding="utf-8-sig", newline="") as file:
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
    """Pairs of 4x4 matrices of a JSON file; raises NotFoundError, InvalidInputError, ShapeError."""
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


class Question(NamedTuple):
    """Question to an operator; an answer starts `action`, is a text, or one of `choices`."""

    text: str
    action: str
    takes_text: bool = False
    choices: tuple[tuple[str, str], ...] = ()


Ask = Callable[[Question], str]


def ask_at_terminal(question: Question) -> str:
    """Put a question to the operator of a command."""
    others = "".join(f"; {does}: {answer or 'Enter alone'}" for does, answer in question.choices)
    how = "" if question.takes_text else "Enter: "
    return input(f"{question.text} ({how}{question.action}{others}) ")


class TakeRecorder:
    """Records takes with a station's recorder; interrupted and invalid ones are discarded.

    `request` is as `HttpLink.request`, `spool` the folder of takes of a station on this machine,
    `store` what takes are uploaded to, but those of practice devices; `announce` is called with the
    duration of a take (s) when it begins, `wait` sleeps.
    """

    def __init__(  # noqa: PLR0913 - all but two by name
        self,
        request: Request,
        task: str,
        *,
        spool: Path,
        store: str | None,
        is_practice: bool = False,
        wait: Callable[[float], None] = time.sleep,
        announce: Callable[[float], None] = lambda _: None,
    ) -> None:
        self._request, self._task = request, task
        self._spool, self._store, self._is_practice = spool, store, is_practice
        self._wait, self._announce = wait, announce

    def record(
        self, name: str, words: str, seconds: float, check: Callable[[str], Found]
    ) -> tuple[str, Found]:
        """Record a valid take; interrupted and invalid ones are discarded.

        `words` are for the operator, and the take's instruction. `check` raises an error for an
        invalid take; of takes that are only in the store, after they are saved. Returns the take's
        folder in the spool, or its id in the store, and the result of the check. Raises
        ConflictError: the recorder is busy with another take; save or discard that.
        """
        self._act("arm", {"task": self._task, "instruction": words})
        self._act("record", {"recording_id": name})
        take, found = str((self._spool / name).resolve()), None
        with ExitStack() as undo:
            undo.callback(self._act, "discard", {"recording_id": name})
            self._announce(seconds)
            num_ticks = round(seconds / TICK_S)
            for _ in progress(range(num_ticks), words, num_ticks):
                self._wait(TICK_S)
            self._act("stop", {"recording_id": name})
            if Path(take).is_dir():
                found = check(take)
            undo.pop_all()
        # Other devices may be absent; `check` sees whether the needed ones are there.
        self._act("save", {"recording_id": name, "accept_incomplete": True})
        if found is None:
            take = self._await_upload(name)
            found = check(take)
        return take, found

    def _act(self, action: str, body: dict[str, object]) -> None:
        self._request("POST", f"/v1/recorder/{action}", body=json.dumps(body).encode())

    def _await_upload(self, name: str) -> str:
        if self._is_practice:
            raise NotFoundError(
                f"take {name!r}: not in {self._spool.resolve()}, and takes of practice devices are "
                "not uploaded; run the alignment service on the station's machine, with "
                "--station-spool of the station's own spool (DEXTOUCH_ALIGNMENT_STATION_SPOOL)"
            )
        if self._store is None:
            raise NotFoundError(
                f"take {name!r}: not in {self._spool.resolve()}; name the station's spool "
                "with --spool, or on another machine its store with --store URL"
            )
        num_tries = round(UPLOAD_S)
        for _ in progress(range(num_tries), "waiting for the upload", num_tries):
            uploads = json.loads(self._request("GET", "/v1/uploads").body)
            for take in uploads:
                if take["recording_id"] == name and take["uploaded"]:
                    return str(take.get("stored_as") or name)
            self._wait(1.0)
        raise NotFoundError(
            f"take {name!r}: the station did not upload it within {UPLOAD_S:g} s; look at its "
            "uploads, then calibrate from the recording in the store"
        )


@dataclass(frozen=True)
class Finding:
    """Age and accuracy of a calibration: OK, WARN or ERROR by `reasons`, which say what to do."""

    name: str
    shape: str
    made_at: str | None
    age_days: float | None
    sigma: str
    level: str
    reasons: tuple[str, ...]


def judge(matrices: Mapping[str, Matrix], now: datetime | None = None) -> list[Finding]:
    """Age and accuracy of every calibration, by name."""
    return [
        _judge(name, matrices, now or datetime.now(UTC))
        for name in sorted(matrices)
        if not _is_companion(name, matrices)
    ]


def load_matrices(path: Path) -> dict[str, Matrix]:
    """Matrices of a calibration folder or file, or of a spooled take."""
    if (path / "recording.json").is_file():
        return dict(read_attributes(path).calibration)
    return read_matrices(path)


def missing_names(matrices: Mapping[str, Matrix]) -> list[str]:
    """Missing required matrices; a glove needs both tare and gain."""
    missing = [name for name in NEEDED if name not in matrices]
    for side in ("left", "right"):
        pair = (f"tactile_{side}_tare_counts", f"tactile_{side}_gain_counts_per_kpa")
        absent = [name for name in pair if name not in matrices]
        missing += absent if len(absent) == 1 else []
    return missing


def _is_companion(name: str, matrices: Mapping[str, Matrix]) -> bool:
    if name.endswith("calibrated_at_unix_s") or "_sigma_" in name:
        return True
    side = name.removeprefix("tactile_").split("_")[0]
    if name in {f"tactile_{side}_{about}" for about in _ABOUT_GLOVES}:
        return True
    camera = name.removeprefix("distortion_").removeprefix("image_size_").removesuffix("_px")
    return camera != name and f"K_{camera}" in matrices


def entry_of(name: str) -> str:
    """The entry that a matrix belongs to: its name without the unit."""
    for unit in ("_counts_per_kpa", "_counts", "_ns"):
        name = name.removesuffix(unit)
    return name


def _judge(name: str, matrices: Mapping[str, Matrix], now: datetime) -> Finding:
    reasons, made_at, age_days = [], None, None
    stamp = matrices.get(f"{entry_of(name)}_calibrated_at_unix_s")
    if stamp is None:
        reasons.append(f"age unknown; {_where_from(name)}")
    else:
        made = datetime.fromtimestamp(float(stamp[0][0]), tz=UTC)
        made_at, age_s = made.isoformat(timespec="seconds"), (now - made).total_seconds()
        age_days = age_s / 86_400
        if age_s > MAX_AGE_S:
            reasons.append(f"{age_days:.0f} days old, expected at most 7; calibrate again")
        if age_s < -60:
            reasons.append("made in the future; set the clock of one of the two machines")
    sigma, doubts = _sigma(name, matrices)
    problems = [*(("WARN", reason) for reason in reasons), *doubts]
    level = max((level for level, _ in problems), key=list(LEVELS).index, default="OK")
    shape = "x".join(str(n) for n in np.shape(matrices[name]))
    stated = tuple(reason for _, reason in problems)
    return Finding(name, shape, made_at, age_days, sigma, level, stated)


def _where_from(name: str) -> str:
    """Advice for a matrix of unknown age, which may not come from this command."""
    if name.endswith("_latency_ns"):
        # Gloves do not show how they turn, but when they are tapped.
        command = "latency" if name.startswith(("tactile_", "keypoints_")) else "time"
        return (
            "measured by the station where the device answers time requests, a camera's is its "
            f"settings' latency_ms; else: dextouch station calibrate {command}"
        )
    if name.startswith("T_tracker_") and "_wrist_" in name:
        return "not of this command: measure where the wrist sits on its tracker"
    return "calibrate again with this command"


def _sigma(name: str, matrices: Mapping[str, Matrix]) -> Sigma:
    prefix = f"{entry_of(name)}_sigma_"
    found = {
        key.removeprefix(prefix): np.array(m)
        for key, m in matrices.items()
        if key.startswith(prefix)
    }
    matrix = np.array(matrices[name])
    if name.startswith("hand_profile_"):
        return f"knuckles {matrix[:, PROFILE_SIGMA].max() * 1e3:.1f} mm", []
    if "px" in found:
        relative = float((found["px"][0, :2] / np.diag(matrix)[:2]).max())
        wrong = f"focal length known to {relative:.2%}, expected {MAX_FOCAL_SIGMA:.1%}; add views"
        return f"focal length {relative:.2%}", [("WARN", wrong)] * (relative > MAX_FOCAL_SIGMA)
    if "rad" in found and "m" in found:
        max_deg, max_mm = BASE_LIMITS if name == "T_world_base" else MOUNT_LIMITS
        deg, mm = float(np.rad2deg(found["rad"].max())), float(found["m"].max()) * 1e3
        good = deg <= max_deg and mm <= max_mm
        wrong = f"expected {max_deg:g}° and {max_mm:g} mm; add views, turned further"
        return f"{deg:.3f}°, {mm:.2f} mm", [("WARN", wrong)] * (not good)
    if "counts_per_kpa" in found:
        state = matrices.get(f"{entry_of(name).removesuffix('_gain')}_taxel_state", ())
        return _gain_sigma(matrix, found["counts_per_kpa"], int(np.count_nonzero(state)))
    if "ns" in found:
        words = f"{found['ns'].max() * 1e-6:.2f} ms"
    elif "rad" in found:
        words = f"{np.rad2deg(found['rad'].max()):.2f}°"
    elif "counts" in found:
        words = f"{np.median(found['counts']):.2f} counts"
    else:
        return "unknown", [("WARN", "sigma unknown")]
    return words, []


def _gain_sigma(gain: np.ndarray, sigma: np.ndarray, num_faulty: int) -> Sigma:
    known = sigma > 0
    if not known.any():
        return "unknown", [("WARN", "sigma unknown")]
    relative = float(np.median(sigma[known] / gain[known]))
    wrong = f"gain known to {relative:.1%}, expected {MAX_GAIN_SIGMA:.0%}; press harder"
    problems = [("WARN", wrong)] * (relative > MAX_GAIN_SIGMA)
    # Faulty taxels, and cells without one, have the sigma 0.
    num_taxels = int(known.sum()) + num_faulty
    levels = [level for level, share in MAX_TAXEL_FAULTS.items() if num_faulty / num_taxels > share]
    problems += [(level, f"{num_faulty} of {num_taxels} taxels faulty") for level in levels[-1:]]
    return f"gain {relative:.2%}", problems
