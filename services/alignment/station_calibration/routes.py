"""Routes under /v1/calibration: what is calibrated at a station and how well, and guided runs."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

from fastapi import APIRouter, Depends, Response, status
from starlette.concurrency import run_in_threadpool

from dextouch.errors import DexTouchError, NotFoundError
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import Matrix
from dextouch.serving import RequireScope
from services.alignment.retargeting.hand_retargeter import profile_name
from services.alignment.station_calibration.judgement import Finding, entry_of, judge
from services.alignment.station_calibration.record import (
    DETAILS_FILE,
    MATRICES_FILE,
    TRACKERS,
    read_matrices,
)
from services.alignment.station_calibration.runs import (
    Answer,
    CalibrationRuns,
    RunRequest,
    RunStatus,
    StationLocation,
)

SCOPE = "calibrate"
ItemState = Literal["good", "due", "missing", "optional"]
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
        "Shake trackers and cameras together for ten seconds, then: {command} time --take TAKE "
        "{to}; gloves: tap a table, then: {command} latency --stream {0} --reference STREAM "
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


def calibration_router(runs: CalibrationRuns) -> APIRouter:
    """Create the router."""
    router = APIRouter(
        prefix="/v1/calibration", tags=["calibration"], dependencies=[Depends(RequireScope(SCOPE))]
    )

    @router.get("")
    async def everything() -> CalibrationOverview:
        """What is calibrated, how well and for how long, and the next step for each."""
        return await run_in_threadpool(overview, runs.place)

    @router.post("/runs", status_code=status.HTTP_202_ACCEPTED)
    async def start(request: RunRequest) -> RunStatus:
        """Begin a guided run; 409 while another one is on."""
        return await run_in_threadpool(runs.start, request)

    @router.get("/run")
    async def run() -> RunStatus | None:
        """The run that is on, or the last one; null before the first."""
        return runs.status()

    @router.get(
        "/run/image", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}}
    )
    async def image() -> Response:
        """The newest image of a camera run, to which its corners belong."""
        data = runs.present().image
        if not data:
            raise NotFoundError("calibration run: no image yet")
        return Response(data, media_type="image/jpeg")

    @router.post("/run/answer")
    async def answer(answer: Annotated[Answer, ...]) -> RunStatus:
        """Answer the question of the run."""
        return runs.present().answer(answer.text)

    @router.post("/run/finish")
    async def finish() -> RunStatus:
        """Calibrate a camera with the views so far."""
        return runs.present().finish()

    @router.post("/run/cancel")
    async def cancel() -> RunStatus:
        """End the run without a result."""
        return await run_in_threadpool(runs.present().cancel)

    return router


class CalibrationItem(FrozenModel):
    """One calibration: how old and how accurate it is, and the next step.

    `sigma` and `residual` are in words, empty where unknown; `meaning` says what a residual tells.
    `views_by_region` counts views of the board in each ninth of the image. `run` starts the guided
    run, where there is one; `step` says what to do otherwise.
    """

    name: str
    title: str
    state: ItemState
    age_days: float | None = None
    sigma: str = ""
    residual: str = ""
    meaning: str = ""
    reasons: tuple[str, ...] = ()
    step: str
    run: RunRequest | None = None
    views_by_region: tuple[tuple[int, ...], ...] = ()


class CalibrationOverview(FrozenModel):
    """Everything that is or should be calibrated at a station; `note` says what is unknown."""

    folder: str
    items: tuple[CalibrationItem, ...]
    note: str = ""


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
    facts = details.get(entry_of(name), {})
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


def _details(folder: Path) -> Mapping[str, object]:
    """Facts by entry; none where the file is absent or damaged, since they are for people only."""
    try:
        found = json.loads((folder / DETAILS_FILE).read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
