"""Age and accuracy of everything in a calibration, and what is missing."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dextouch.episodes.spool import read_attributes
from dextouch.schemas import Matrix
from services.alignment.calibration.motion import WANTED_ROTATION_RAD, WANTED_TRANSLATION_M
from services.alignment.station_calibration.record import read_matrices

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


def load(path: Path) -> dict[str, Matrix]:
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
