"""Calibration folder: named matrices for recordings, with accuracy, age and provenance.

Stations read `calibration.json` (DEXTOUCH_ACQUISITION_CALIBRATION). Sigma and time of a matrix are
stored as matrices too (`…_sigma…`, `…_calibrated_at_unix_s`), so that every recording contains
them.
"""

import json
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from dextouch import __version__
from dextouch.episodes import replace_file
from dextouch.errors import CorruptDataError, InvalidInputError, NonFiniteError, NotFoundError
from dextouch.schemas import Matrix, first_problems, matrix_rows

MATRICES_FILE = "calibration.json"
DETAILS_FILE = "calibration_details.json"
PICTURES = "pictures"

Named = TypeVar("Named")
_MATRICES = TypeAdapter(dict[str, Matrix]).validate_json
_DETAILS = TypeAdapter(dict[str, object]).validate_json


def write_entry(
    folder: Path,
    entry: str,
    matrices: Mapping[str, np.ndarray | float],
    facts: Mapping[str, object],
) -> None:
    """Write an entry of a calibration folder, measured now; other entries are kept.

    Args:
        folder: created if absent.
        entry: name of the main matrix, such as `K_head`; its time is stored as
            `<entry>_calibrated_at_unix_s`.
        matrices: finite; a number or a vector becomes a matrix of one row.
        facts: sigma, inputs and similar details for humans; JSON.

    Raises:
        NonFiniteError: NaN or infinity in a matrix.
        CorruptDataError: an existing file cannot be read.
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
    """Write a transform as an entry and say how well it is known.

    Args:
        folder: of the calibration.
        name: of the transform.
        T: [4, 4] transform.
        sigma: of its rotation (rad) and translation (m); the facts are extended by it.
        facts: as in `write_entry`.
    """
    rad, m = sigma
    facts |= {"sigma_rotation_deg": float(np.rad2deg(rad)), "sigma_translation_mm": m * 1e3}
    write_entry(folder, name, {name: T, f"{name}_sigma_rad": rad, f"{name}_sigma_m": m}, facts)
    return f"{name}: known to {np.rad2deg(rad):.3f}° and {m * 1e3:.2f} mm"


def read_matrices(folder: Path) -> dict[str, Matrix]:
    """Read the matrices of a folder or a JSON file.

    Raises:
        NotFoundError: no calibration.
        CorruptDataError: not a JSON file of matrices.
    """
    path = folder / MATRICES_FILE if folder.is_dir() else folder
    if not path.is_file():
        raise NotFoundError(
            f"{path}: no calibration there; `dextouch station calibrate camera --help` begins one"
        )
    return _read(path, _MATRICES, "named matrices")


def _read(path: Path, validate: Callable[[bytes], Named], what: str) -> Named:
    try:
        return validate(path.read_bytes())
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
