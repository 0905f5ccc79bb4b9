"""What is calibrated at a station, how well and for how long, and the next step for each."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from dextouch.episodes.spool import read_attributes
from dextouch.errors import DexTouchError
from dextouch.schemas import Matrix
from services.alignment.retargeting.hand_profile import profile_name
from services.alignment.station_calibration.record import DETAILS_FILE, MATRICES_FILE, read_matrices
from services.alignment.station_calibration.runs import StationLocation
from services.alignment.station_calibration.schemas import (
    CalibrationItem,
    CalibrationOverview,
    ItemState,
    RunRequest,
)

# Age and accuracy of everything in a calibration, and what is missing.

# Alignment refuses takes without these, or without those of the recorded gloves.
NEEDED = ("K_head",)
LEVELS = {"OK": "green", "WARN": "yellow", "ERROR": "bold red"}
MAX_AGE_S = 7 * 86_400.0
# Limits of sigma (relative or absolute) above which there is a warning.
MAX_FOCAL_SIGMA = 0.003
MAX_GAIN_SIGMA = 0.05
MAX_TAXEL_FAULTS = {"WARN": 0.01, "ERROR": 0.05}
# Degrees and millimetres.
MOUNT_LIMITS, BASE_LIMITS = (0.06, 0.8), (0.2, 2.0)
# Column of a hand profile that holds the sigma of the knuckles, in metres.
PROFILE_SIGMA = 7
# Matrices of a glove that are metadata, or that are added by an episode.
_ABOUT_GLOVES = ("noise_counts", "taxel_state", "cells", "refused_taxels")

# What is wrong with a calibration: level and reason.
Problem = tuple[str, str]
Sigma = tuple[str, list[Problem]]


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
    """Whether a matrix is metadata of another one."""
    if name.endswith("calibrated_at_unix_s") or "_sigma_" in name:
        return True
    side = name.removeprefix("tactile_").split("_")[0]
    if name in {f"tactile_{side}_{about}" for about in _ABOUT_GLOVES}:
        return True
    camera = name.removeprefix("distortion_").removeprefix("image_size_").removesuffix("_px")
    return camera != name and f"K_{camera}" in matrices


def _entry_of(name: str) -> str:
    """The entry that a matrix belongs to: its name without the unit."""
    for unit in ("_counts_per_kpa", "_counts", "_ns"):
        name = name.removesuffix(unit)
    return name


def _judge(name: str, matrices: Mapping[str, Matrix], now: datetime) -> Finding:
    reasons, made_at, age_days = [], None, None
    stamp = matrices.get(f"{_entry_of(name)}_calibrated_at_unix_s")
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
        return (
            "measured by the station where the device answers time requests, a camera's is its "
            "settings' latency_ms; else: dextouch station calibrate latency"
        )
    if name.startswith("T_tracker_") and "_wrist_" in name:
        return "not of this command: measure where the wrist sits on its tracker"
    return "calibrate again with this command"


def _sigma(name: str, matrices: Mapping[str, Matrix]) -> Sigma:
    """Description of the sigma, and problems with it."""
    prefix = f"{_entry_of(name)}_sigma_"
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
        state = matrices.get(f"{_entry_of(name).removesuffix('_gain')}_taxel_state", ())
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
    levels = [level for level, share in MAX_TAXEL_FAULTS.items() if num_faulty / 320 > share]
    problems += [(level, f"{num_faulty} of 320 taxels faulty") for level in levels[-1:]]
    return f"gain {relative:.2%}", problems


# Tracker of each camera, by the stream names of recordings.
TRACKERS: Final = {"head": "head", "wrist_left": "left", "wrist_right": "right"}
COMMAND: Final = "dextouch station calibrate"
# Pattern of a name; title, next step and kind of guided run.
KINDS: Final = (
    (
        r"tactile_(left|right)_tare_counts",
        "Glove {0}: zero",
        "Lay the glove down, untouched, for a minute; the run records 10 s.",
        "glove",
    ),
    (
        r"tactile_(left|right)_gain_counts_per_kpa",
        "Glove {0}: gain",
        "After the zero, press all taxels with two to four known pressures, such as a bladder's.",
        "glove",
    ),
    (
        r"K_([a-z0-9_]+)",
        "Camera {0}: lens",
        "Move a printed board through the whole image, and hold it still at each place.",
        "camera",
    ),
    (
        r"T_tracker_[a-z]+_camera_([a-z0-9_]+)",
        "Camera {0} on its tracker",
        "Take 20 photos of a fixed board with the tracker's poses, then: {command} hand-eye "
        "--camera {0} --photos FOLDER --poses poses.csv --board BOARD {to}",
        "",
    ),
    (
        r"hand_profile_(left|right)",
        "Hand {0}: bones",
        "Record ten seconds of a hand that opens, closes and spreads, then: {command} profile "
        "--side {0} --take TAKE {to}",
        "",
    ),
    (
        r"T_keypoints_(left|right)_wrist_(?:left|right)",
        "Hand {0}: wrist axes",
        "Record a second of the flat hand, then: {command} wrist --side {0} --take TAKE {to}",
        "",
    ),
    (
        r"T_world_base",
        "Robot base",
        "Write 20 pose pairs of tracker and effector, then: {command} robot-base --poses FILE {to}",
        "",
    ),
    (
        r"([a-z0-9_]+)_latency_ns",
        "Latency of {0}",
        "Record brisk motion or taps, then: {command} latency --stream {0} --reference STREAM "
        "--take TAKE {to}",
        "",
    ),
)
# Fact of an entry that is its residual: how it is written, and what it tells.
RESIDUALS: Final = {
    "rms_px": (
        "{:.2f} px",
        "distance of corners from the model; it does not measure accuracy, ± does",
    ),
    "board_scatter_rms_mm": ("{:.1f} mm", "scatter of the fixed board's place over the views"),
    "residual_rms_kpa": ("{:.2f} kPa", "deviation of the presses from straight lines"),
    "noise_median_counts": ("{:.1f} counts", "noise of one reading at rest"),
    "residual_rms_mm": ("{:.2f} mm", "scatter of the pose pairs"),
    "misfit_mm": ("{:.1f} mm", "distance of the hand's nodes from the mean hand"),
    "sigma_ms": ("± {:.2f} ms", "standard deviation of the delay"),
}


def overview(place: StationLocation) -> CalibrationOverview:
    """The calibration folder, and what the station's streams need besides."""
    note = ""
    streams: tuple[str, ...] = ()
    try:
        place, streams = place.visited()
    except DexTouchError as error:
        note = f"The station's devices are unknown: {error.message}"
    has_file = (place.folder / MATRICES_FILE).is_file()
    matrices: Mapping[str, Matrix] = read_matrices(place.folder) if has_file else {}
    known = {finding.name: finding for finding in judge(matrices)}
    details = _details(place.folder)
    wanted = _wanted(streams)
    names = [*wanted, *(name for name in known if name not in wanted)]
    items = tuple(_item(name, known.get(name), details, place) for name in names)
    return CalibrationOverview(folder=str(place.folder), items=items, note=note)


def _wanted(streams: Sequence[str]) -> list[str]:
    """Names of the calibrations that these streams need or gain by."""
    names = [] if any(name == "camera_head" for name in streams) else ["K_head"]
    for stream in streams:
        kind, _, subject = stream.partition("_")
        if kind == "tactile":
            names += [f"{stream}_tare_counts", f"{stream}_gain_counts_per_kpa"]
        elif kind == "camera":
            names.append(f"K_{subject}")
            tracker = TRACKERS.get(subject)
            names += [f"T_tracker_{tracker}_camera_{subject}"] if tracker else []
        elif kind == "keypoints":
            names.append(profile_name(subject))
    return sorted(names, key=lambda name: ("tactile", "K_", "T_", "hand").index(_group(name)))


def _group(name: str) -> str:
    return next(group for group in ("tactile", "K_", "T_", "hand") if name.startswith(group))


def _item(
    name: str, finding: Finding | None, details: Mapping[str, object], place: StationLocation
) -> CalibrationItem:
    state: ItemState = "optional" if name.startswith("hand_profile_") else "missing"
    if finding is not None:
        state = "good" if finding.level == "OK" else "due"
    title, step, run = _words(name, place)
    facts = details.get(_entry(name), {})
    facts = facts if isinstance(facts, dict) else {}
    residual, meaning = _residual(name, facts)
    regions = facts.get("views_by_region") if name.startswith("K_") else None
    return CalibrationItem(
        name=name,
        title=title,
        state=state,
        age_days=finding.age_days if finding else None,
        sigma=finding.sigma if finding else "",
        residual=residual,
        meaning=meaning,
        reasons=finding.reasons if finding else (),
        step=step,
        run=run,
        views_by_region=tuple(map(tuple, regions)) if isinstance(regions, list) else (),
    )


def _words(name: str, place: StationLocation) -> tuple[str, str, RunRequest | None]:
    """Title, next step and guided run of a calibration."""
    for pattern, title, step, kind in KINDS:
        if matched := re.fullmatch(pattern, name):
            subject = matched[1] if matched.groups() else ""
            words = step.format(subject, command=COMMAND, to=f"--to {place.folder}")
            run = None
            if kind == "glove" or (kind == "camera" and subject in TRACKERS):
                run = RunRequest.model_validate({"kind": kind, "subject": subject})
            return title.format(subject.replace("_", " ")), words, run
    return name, f"See {COMMAND} --help", None


def _residual(name: str, facts: Mapping[str, object]) -> tuple[str, str]:
    keys = [key for key in RESIDUALS if isinstance(facts.get(key), int | float)]
    if "_tare_" in name:
        keys = [key for key in keys if key == "noise_median_counts"]
    if not keys:
        return "", ""
    pattern, meaning = RESIDUALS[keys[0]]
    return pattern.format(facts[keys[0]]), meaning


def _entry(name: str) -> str:
    for unit in ("_counts_per_kpa", "_counts", "_ns"):
        name = name.removesuffix(unit)
    return name


def _details(folder: Path) -> Mapping[str, object]:
    """Facts by entry; none where the file is absent or damaged, since they are for people only."""
    try:
        found = json.loads((folder / DETAILS_FILE).read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
