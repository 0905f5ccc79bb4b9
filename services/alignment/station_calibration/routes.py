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
from services.alignment.station_calibration.mount import num_kept_places
from services.alignment.station_calibration.record import (
    DETAILS_FILE,
    MATRICES_FILE,
    TRACKERS,
    Finding,
    entry_of,
    judge,
    read_matrices,
)
from services.alignment.station_calibration.runs import (
    EVERYTHING,
    SIDES,
    Answer,
    CalibrationRuns,
    RunRequest,
    RunStatus,
    StationLocation,
)

SCOPE = "calibrate"
ItemState = Literal["good", "due", "missing", "optional", "simulated"]
COMMAND: Final = "dextouch station calibrate"
# Row of the delays of all trackers and cameras, before any of them is measured.
PATH_DELAYS: Final = "path_delays"
TURN_TOGETHER: Final = "Turn all trackers and cameras together for ten seconds."
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
        "After the lens: fix the board, and hold the camera still at places all around it.",
        "mount",
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
        r"((?:tactile|keypoints)_[a-z0-9_]+)_latency_ns",
        "Latency of {0}",
        "Record ten taps on a hard table, then: {command} latency --stream {0} --reference TRACKER "
        "--take TAKE {to}",
        "",
    ),
    (r"([a-z0-9_]+)_latency_ns", "Latency of {0}", TURN_TOGETHER, "time"),
    (PATH_DELAYS, "Path delays", TURN_TOGETHER, "time"),
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
    async def get_calibration() -> CalibrationOverview:
        """What is calibrated, how well and for how long, and the next step for each."""
        return await run_in_threadpool(overview, runs.place)

    @router.post("/practice/start")
    async def start_practice() -> CalibrationOverview:
        """Start simulated devices and boards to practise with; 409 at a station of real ones."""
        await run_in_threadpool(runs.switch_practice, is_on=True)
        return await run_in_threadpool(overview, runs.place)

    @router.post("/practice/stop")
    async def stop_practice() -> CalibrationOverview:
        """Stop the practice devices; their calibration is kept."""
        await run_in_threadpool(runs.switch_practice, is_on=False)
        return await run_in_threadpool(overview, runs.place)

    @router.post("/runs", status_code=status.HTTP_202_ACCEPTED)
    async def start_calibration_run(request: RunRequest) -> RunStatus:
        """Begin a guided run; 409 while another one is on."""
        return await run_in_threadpool(runs.start, request)

    _add_run(router, runs)
    return router


def _add_run(router: APIRouter, runs: CalibrationRuns) -> None:
    @router.get("/run")
    async def get_calibration_run() -> RunStatus | None:
        """The run that is on, or the last one; null before the first."""
        return runs.status()

    @router.get(
        "/run/image", response_class=Response, responses={200: {"content": {"image/jpeg": {}}}}
    )
    async def get_calibration_image() -> Response:
        """The newest image of a camera run, to which its corners belong."""
        data = runs.present().image
        if not data:
            raise NotFoundError("calibration run: no image yet")
        return Response(data, media_type="image/jpeg")

    @router.post("/run/answer")
    async def answer_calibration_run(answer: Annotated[Answer, ...]) -> RunStatus:
        """Answer the question of the run."""
        return runs.present().answer(answer.text)

    @router.post("/run/take")
    async def keep_calibration_place() -> RunStatus:
        """Keep the present place of a mount's run as soon as the camera is still."""
        return runs.present().order("take")

    @router.post("/run/drop")
    async def drop_calibration_place() -> RunStatus:
        """Forget the last place of a mount's run."""
        return runs.present().order("drop")

    @router.post("/run/finish")
    async def finish_calibration_run() -> RunStatus:
        """Calibrate a camera or its mount with the views so far."""
        return runs.present().finish()

    @router.post("/run/cancel")
    async def cancel_calibration_run() -> RunStatus:
        """End the run without a result; the places of a mount are kept."""
        return await run_in_threadpool(runs.present().cancel)


class CalibrationItem(FrozenModel):
    """One calibration: how old and how accurate it is, and the next step.

    `sigma` and `residual` are in words, empty where unknown; `meaning` says what a residual tells.
    `views_by_region` counts views of the board in each ninth of the image. `run` starts the guided
    run, where there is one; `step` says what to do otherwise. `num_kept_places` are of a mount's
    run that was ended, and can be resumed.
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
    num_kept_places: int = 0
    views_by_region: tuple[tuple[int, ...], ...] = ()


class CalibrationOverview(FrozenModel):
    """Everything that is or should be calibrated at a station; `note` says what is unknown.

    Of a station with `is_simulated` devices nothing has to be calibrated. While its `practice`
    devices are on, the calibration is theirs.
    """

    folder: str
    items: tuple[CalibrationItem, ...]
    is_simulated: bool = False
    practice: Literal["unavailable", "off", "on"] = "unavailable"
    note: str = ""


def overview(place: StationLocation) -> CalibrationOverview:
    """The calibration folder, and what the station's streams need besides."""
    note = ""
    streams: tuple[str, ...] = ()
    is_simulated = False
    try:
        place, streams, is_simulated = place.visited()
    except DexTouchError as error:
        note = f"The station's devices are unknown: {error.message}"
    has_file = (place.folder / MATRICES_FILE).is_file()
    matrices: Mapping[str, Matrix] = read_matrices(place.folder) if has_file else {}
    known = {finding.name: finding for finding in judge(matrices)}
    details = _details(place.folder)
    wanted = _wanted(streams)
    # Two trackers or more can be shaken together.
    if not any(map(_is_path_delay, known)) and sum(name in TRACKERS for name in streams) > 1:
        wanted.append(PATH_DELAYS)
    names = [*wanted, *(name for name in known if name not in wanted)]
    items = [_item(name, known.get(name), details, place) for name in names]
    if is_simulated:
        items = [_simulated(item, is_practised=place.practice == "on") for item in items]
    return CalibrationOverview(
        folder=str(place.folder),
        items=tuple(items),
        is_simulated=is_simulated,
        practice=place.practice,
        note=note,
    )


def _is_path_delay(name: str) -> bool:
    """Whether this is what a shake measures; delays of gloves are not."""
    stream = name.removesuffix("_latency_ns")
    return stream != name and (stream in TRACKERS or stream.startswith("camera_"))


def _simulated(item: CalibrationItem, *, is_practised: bool) -> CalibrationItem:
    """Simulated devices need no calibration, and only those to practise with show a board."""
    changes: dict[str, object] = {"state": "simulated"} if item.state == "missing" else {}
    if not is_practised:
        changes |= {"run": None, "step": ""}
    elif item.name.endswith("_gain_counts_per_kpa"):
        changes |= {
            "run": None,
            "step": "Practice gloves lie untouched: they show no gain.",
        }
    return item.model_copy(update=changes)


def _wanted(streams: Sequence[str]) -> list[str]:
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
    groups = ("tactile", "K_", "T_", "hand")
    return sorted(names, key=lambda name: [not name.startswith(group) for group in groups])


def _item(
    name: str, finding: Finding | None, details: Mapping[str, object], place: StationLocation
) -> CalibrationItem:
    is_optional = name.startswith("hand_profile_") or name == PATH_DELAYS
    state: ItemState = "optional" if is_optional else "missing"
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
        num_kept_places=(
            num_kept_places(place.mount_photos(run.subject)) if run and run.kind == "mount" else 0
        ),
        views_by_region=tuple(map(tuple, regions)) if isinstance(regions, list) else (),
    )


def _words(name: str, place: StationLocation) -> tuple[str, str, RunRequest | None]:
    for pattern, title, step, kind in KINDS:
        if matched := re.fullmatch(pattern, name):
            subject = matched[1] if matched.groups() else ""
            words = step.format(subject, command=COMMAND, to=f"--to {place.folder}")
            subjects = {"glove": SIDES, "time": (EVERYTHING,)}.get(kind, tuple(TRACKERS))
            of = EVERYTHING if kind == "time" else subject
            run = None
            if kind and of in subjects:
                run = RunRequest.model_validate({"kind": kind, "subject": of})
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
