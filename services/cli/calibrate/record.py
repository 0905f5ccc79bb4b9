"""Calibration folder: named matrices for recordings, with accuracy, age and provenance.

Stations read `calibration.json` (DEXTOUCH_ACQUISITION_CALIBRATION). Sigma and time of a matrix are
stored as matrices too (`…_sigma…`, `…_calibrated_at_unix_s`), so that every recording contains
them.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
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
MAX_AGE_S = 7 * 86_400.0

Named = TypeVar("Named")
_MATRICES: TypeAdapter[dict[str, Matrix]] = TypeAdapter(dict[str, Matrix])
_DETAILS: TypeAdapter[dict[str, object]] = TypeAdapter(dict[str, object])

# Limits of sigma (relative or absolute) above which `show` warns.
MAX_FOCAL_SIGMA = 0.003
# Column of a hand profile that holds the sigma of the knuckles, in metres.
PROFILE_SIGMA = 7
# Degrees and millimetres.
MOUNT_LIMITS = (0.06, 0.8)
BASE_LIMITS = (0.2, 2.0)
MAX_GAIN_SIGMA = 0.05
MAX_TAXEL_FAULTS = (0.01, 0.05)
# Matrices of a glove that are metadata, or that are added by an episode.
_ABOUT_GLOVES = ("noise_counts", "taxel_state", "cells", "refused_taxels")


@dataclass(frozen=True)
class Finding:
    """Assessment of one calibration: age and accuracy.

    `level` is OK, WARN or ERROR; `reasons` explain a level other than OK and what to do.
    """

    name: str
    shape: str
    made_at: str | None
    age_days: float | None
    sigma: str
    level: str
    reasons: tuple[str, ...]


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
    details = _read_details(folder)
    stamped = {**matrices, f"{entry}_calibrated_at_unix_s": now.timestamp()}
    new = {name: matrix_rows(np.atleast_2d(matrix)) for name, matrix in stamped.items()}
    details[entry] = {
        **facts,
        "made_at": now.isoformat(timespec="seconds"),
        "software": f"dextouch {__version__}",
        "matrices": sorted(new),
    }
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / DETAILS_FILE, details)
    _write(folder / MATRICES_FILE, {**old, **new})


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
    return _read(path, _MATRICES.validate_json, "named matrices")


def _read_details(folder: Path) -> dict[str, object]:
    path = folder / DETAILS_FILE
    return _read(path, _DETAILS.validate_json, "details by entry") if path.is_file() else {}


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
    """Get a matrix as float64.

    Raises:
        NotFoundError: missing.
        InvalidInputError: of another shape.
    """
    if name not in matrices:
        raise NotFoundError(
            f"calibration: {name!r} is missing; there is {', '.join(sorted(matrices)) or 'nothing'}"
        )
    matrix = np.array(matrices[name], dtype=np.float64)
    if matrix.shape != shape:
        raise InvalidInputError(f"calibration {name!r}: got {matrix.shape}, expected {shape}")
    return matrix


def judge(matrices: Mapping[str, Matrix], *, now: datetime) -> list[Finding]:
    """Assess age and sigma of every calibration among the matrices."""
    return [
        _judge_one(name, matrices, now)
        for name in sorted(matrices)
        if not _is_companion(name, matrices)
    ]


def _is_companion(name: str, matrices: Mapping[str, Matrix]) -> bool:
    """Whether a matrix is metadata of another one."""
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


def _judge_one(name: str, matrices: Mapping[str, Matrix], now: datetime) -> Finding:
    entry, reasons = entry_of(name), []
    made_at = age_days = None
    if f"{entry}_calibrated_at_unix_s" in matrices:
        made = datetime.fromtimestamp(
            float(matrices[f"{entry}_calibrated_at_unix_s"][0][0]), tz=UTC
        )
        made_at, age_s = made.isoformat(timespec="seconds"), (now - made).total_seconds()
        age_days = age_s / 86_400
        if age_s > MAX_AGE_S:
            reasons.append(f"{age_days:.0f} days old, expected at most 7; calibrate again")
        if age_s < -60:
            reasons.append("made in the future; set the clock of one of the two machines")
    else:
        reasons.append(f"age unknown; {_where_from(name)}")
    sigma, sigma_reasons = _sigma(name, matrices)
    reasons += sigma_reasons
    level = "WARN" if reasons else "OK"
    if any(reason.startswith("ERROR ") for reason in reasons):
        level = "ERROR"
    shape = "x".join(str(n) for n in np.shape(matrices[name]))
    stated = tuple(reason.removeprefix("ERROR ") for reason in reasons)
    return Finding(name, shape, made_at, age_days, sigma, level, stated)


def _where_from(name: str) -> str:
    """Advice for a matrix of unknown age, which may not come from this command."""
    if name.endswith("_latency_ns"):
        return (
            "measured by the station where the device answers time requests, a camera's is its "
            "settings' latency_ms; else: dextouch station calibrate latency"
        )
    if name.startswith("T_tracker_") and "_wrist_" in name:
        return "not of this command: measure where the wrist sits on its tracker"
    return "calibrate again with this command"


def _sigma(name: str, matrices: Mapping[str, Matrix]) -> tuple[str, list[str]]:
    """Description of the sigma, and problems with it."""
    found = {
        suffix: np.array(matrices[f"{entry_of(name)}_sigma_{suffix}"])
        for suffix in ("px", "rad", "m", "counts", "counts_per_kpa", "ns")
        if f"{entry_of(name)}_sigma_{suffix}" in matrices
    }
    if name.startswith("hand_profile_"):
        return f"knuckles {np.array(matrices[name])[:, PROFILE_SIGMA].max() * 1e3:.1f} mm", []
    if not found:
        return "unknown", ["sigma unknown"]
    if "px" in found:
        relative = float((found["px"][0, :2] / np.diag(matrices[name])[:2]).max())
        limit = MAX_FOCAL_SIGMA
        wrong = f"focal length known to {relative:.2%}, expected {limit:.1%}; add views"
        return f"focal length {relative:.2%}", [wrong] if relative > limit else []
    if "rad" in found and "m" in found:
        limits = BASE_LIMITS if name == "T_world_base" else MOUNT_LIMITS
        return _pose_sigma(float(found["rad"].max()), float(found["m"].max()), limits)
    if "counts_per_kpa" in found:
        return _gain_sigma(name, found["counts_per_kpa"], matrices)
    return _plain_sigma(found), []


def _plain_sigma(found: Mapping[str, np.ndarray]) -> str:
    if "ns" in found:
        return f"{found['ns'].max() * 1e-6:.2f} ms"
    if "rad" in found:
        return f"{np.rad2deg(found['rad'].max()):.2f}°"
    return f"{np.median(found['counts']):.2f} counts"


def _pose_sigma(
    rotation_rad: float, translation_m: float, limits: tuple[float, float]
) -> tuple[str, list[str]]:
    stated = f"{np.rad2deg(rotation_rad):.3f}°, {translation_m * 1e3:.2f} mm"
    max_deg, max_mm = limits
    good = np.rad2deg(rotation_rad) <= max_deg and translation_m * 1e3 <= max_mm
    reason = f"expected {max_deg:g}° and {max_mm:g} mm; add views, turned further"
    return stated, [] if good else [reason]


def _gain_sigma(
    name: str, sigma: np.ndarray, matrices: Mapping[str, Matrix]
) -> tuple[str, list[str]]:
    known = sigma > 0
    if not known.any():
        return "unknown", ["sigma unknown"]
    relative = float(np.median(sigma[known] / np.array(matrices[name])[known]))
    reasons = []
    if relative > MAX_GAIN_SIGMA:
        reasons.append(f"gain known to {relative:.1%}, expected {MAX_GAIN_SIGMA:.0%}; press harder")
    state = np.array(matrices.get(f"{entry_of(name).removesuffix('_gain')}_taxel_state", [[0.0]]))
    share = np.count_nonzero(state) / 320
    if share > MAX_TAXEL_FAULTS[0]:
        worst = "ERROR " if share > MAX_TAXEL_FAULTS[1] else ""
        reasons.append(f"{worst}{np.count_nonzero(state)} of 320 taxels faulty")
    return f"gain {relative:.2%}", reasons


def _write(path: Path, content: object) -> None:
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    replace_file(path, text.encode())
