"""Guided calibration runs at a station: one at a time, each in a thread that asks its operator."""

import argparse
import threading
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Literal, NamedTuple

import numpy as np
import structlog
from pydantic import AwareDatetime, Field

from dextouch.clients import HttpLink, Reply
from dextouch.data_folder import practice_spool
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError, NotFoundError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel, example
from dextouch.schemas import PracticeStatus, StationHealth
from services.alignment.calibration.hand_eye import GaugeView
from services.alignment.calibration.tactile_tare import FULL_SCALE_COUNTS
from services.alignment.station_calibration import glove
from services.alignment.station_calibration.boards import (
    ENOUGH_VIEWS,
    MAX_FOCAL_SIGMA,
    BoardView,
    check_unambiguous,
    parse_board,
)
from services.alignment.station_calibration.camera_views import (
    Session,
    calibrate_photos,
    read_lens,
    station_arrivals,
)
from services.alignment.station_calibration.glove import Guide
from services.alignment.station_calibration.mount import (
    POSES_FILE,
    MountSession,
    calibrate_mount,
    station_sightings,
)
from services.alignment.station_calibration.record import TICK_S, TRACKERS, Question, TakeRecorder
from services.alignment.station_calibration.times import measure_times

logger = structlog.get_logger(__name__)

MAX_LINES = 40
PRESSURE_SIGMA = 0.02
PRACTICE = "practice"
# Task of the take of a shake, its duration, and the time to take everything in hand before it.
TIME_TASK, SHAKE_S, LEAD_S = "calibrate-time", 10.0, 3.0
SIDES, EVERYTHING = ("left", "right"), "all"

PRACTICE_PATH = "/practice"  # of practice devices, below the address of their station
_NO_QUESTION: dict[str, object] = {
    "question": "",
    "action": "",
    "takes_text": False,
    "choices": (),
    "countdown": None,
}
Order = Literal["take", "drop"]
RunState = Literal["running", "asking", "done", "failed", "cancelled"]
ENDED: frozenset[RunState] = frozenset({"done", "failed", "cancelled"})
Outline = tuple[tuple[float, float], ...]


class RunRequest(FrozenModel):
    """A guided run.

    `camera` measures the lens of a camera with a board, `mount` where it sits on its tracker with a
    fixed board, `glove` tare and gain of a glove, and `time` the path delays of `all` trackers and
    cameras. `is_resumed` goes on with the places of a mount's run that was ended.
    """

    model_config = example(kind="glove", subject="left")

    kind: Literal["camera", "mount", "glove", "time"]
    subject: Literal["head", "wrist_left", "wrist_right", "left", "right", "all"]
    board: FreeText = Field(default="", max_length=64)
    is_resumed: bool = False


class Answer(FrozenModel):
    """What the operator answers to the question of a run."""

    model_config = example(text="yes")

    text: FreeText = Field(max_length=200)


class ImageView(FrozenModel):
    """The newest image of a camera and the board's corners in it, in its pixels.

    `todo` is advice, most important first; `hint` says why the image was not kept.
    """

    image_index: int
    width_px: int
    height_px: int
    corners_px: Outline = ()
    todo: tuple[str, ...] = ()
    hint: str = ""


class CameraRunView(ImageView):
    """Live view of a camera run.

    `outlines_px` are those of the boards that were kept. `focal_sigma` is the standard deviation of
    the focal length that the views give, as a share of it, None where they give none; the run goes
    on until it is `focal_sigma_wanted`.
    """

    outlines_px: tuple[Outline, ...] = ()
    views_by_region: tuple[tuple[int, ...], ...] = ()
    num_views: int = 0
    num_wanted: int
    focal_sigma: float | None = None
    focal_sigma_wanted: float


class MountRunView(ImageView):
    """Live view of a mount's run.

    `places` are the kept ones in their order, True where they count: the solver leaves out those
    that are far from the others. The run ends by itself when all `gauges` are full. `problem` is
    why the solver refuses the places, `can_finish` says whether they determine the mount.
    """

    is_board_seen: bool
    is_tracked: bool
    is_still: bool
    places: tuple[bool, ...]
    gauges: tuple[GaugeView, ...]
    problem: str = ""
    can_finish: bool = False


class Choice(FrozenModel):
    """An answer to a question other than its action, and what it does."""

    label: str
    answer: str


class Countdown(FrozenModel):
    """What lasts for a known time, and how much of it is over."""

    label: str
    duration_s: float
    elapsed_s: float = 0.0


class RunStatus(FrozenModel):
    """State of a guided run; `lines` is what it said, `question` what it waits for.

    `action` is what an answer starts, such as "Record 10 s"; it is a text if `takes_text`, else
    empty. `choices` are other answers. `facts` are the results as in `calibration_details.json`.
    """

    run_id: str
    request: RunRequest
    state: RunState
    started_at: AwareDatetime
    question: str = ""
    action: str = ""
    takes_text: bool = False
    choices: tuple[Choice, ...] = ()
    lines: tuple[str, ...] = ()
    countdown: Countdown | None = None
    camera: CameraRunView | None = None
    mount: MountRunView | None = None
    facts: dict[str, object] = Field(default_factory=dict)
    problem: str = ""


class _CancelledError(Exception):
    """The operator ended the run."""


@dataclass(frozen=True)
class StationLocation:
    """Where a station and its practice devices answer, folders of takes and calibration."""

    url: str | None
    key: str | None
    folder: Path
    spool: Path
    store_url: str
    practice: Literal["unavailable", "off", "on"] = "unavailable"

    def link(self) -> HttpLink:
        """A connection to the station; raises InvalidInputError: no station is set."""
        if self.url is None:
            raise InvalidInputError(
                "calibration: no station_url is set; start the alignment service with "
                "DEXTOUCH_ALIGNMENT_STATION_URL=http://STATION:8083"
            )
        return HttpLink(self.url, api_key=self.key)

    def visited(self) -> "VisitedStation":
        """The place (of practice devices while they are on), and the station's streams."""
        with closing(self.link()) as link:
            reply = link.request("GET", "/v1/practice")
            practice = PracticeStatus.model_validate_json(reply.body, extra="ignore").state
            place, below = replace(self, practice=practice), ""
            if practice == "on":
                below = PRACTICE_PATH
                place = replace(place, url=f"{self.url}{below}", spool=practice_spool(self.spool))
            reply = link.request("GET", f"{below}/v1/health")
        health = StationHealth.model_validate_json(reply.body, extra="ignore")
        streams = tuple(stream.stream for stream in health.streams)
        is_simulated = any(device.simulated for device in health.devices)
        if is_simulated:
            place = replace(place, folder=self.folder / PRACTICE)
        return VisitedStation(place, streams, is_simulated)

    def mount_photos(self, camera: str) -> Path:
        """Folder of the places of a mount's run that is on, or was ended without a result."""
        return self.folder / "photos" / f"mount-{camera}"

    def switch_practice(self, *, is_on: bool) -> None:
        """Start or stop practice devices; raises ConflictError: the station has real ones."""
        with closing(self.link()) as link:
            link.request("POST", f"/v1/practice/{'start' if is_on else 'stop'}")


class VisitedStation(NamedTuple):
    """A station that answered: its place, the names of its streams, and whether it is simulated."""

    place: StationLocation
    streams: tuple[str, ...]
    is_simulated: bool


class GuidedRun:
    """One run, which another thread watches, answers and ends."""

    def __init__(self, request: RunRequest, station: VisitedStation) -> None:
        self._place, self._streams, _ = station
        self._request = request
        now = datetime.now(UTC)
        self._lock = threading.Lock()
        # None ends the question that waits.
        self._answers: SimpleQueue[str | None] = SimpleQueue()
        self._status = RunStatus(
            run_id=f"{request.kind}-{request.subject}-{now:%Y%m%d-%H%M%S}",
            request=request,
            state="running",
            started_at=now,
        )
        self._is_cancelled = threading.Event()
        self._is_finished = threading.Event()
        self.image = b""
        self._orders: SimpleQueue[Order] = SimpleQueue()
        run = {
            "camera": self._camera,
            "mount": self._mount,
            "glove": self._glove,
            "time": self._time,
        }[request.kind]
        self._thread = threading.Thread(target=partial(self._work, run), name="calibration-run")
        self._thread.start()

    @property
    def status(self) -> RunStatus:
        """Present state."""
        return self._status

    def answer(self, text: str) -> RunStatus:
        """Answer the question of the run; raises ConflictError without, or InvalidInputError."""
        with self._lock:
            status = self._status
            if status.state != "asking":
                raise ConflictError(f"calibration run: {status.state}, it asks nothing")
            known = ("", *(choice.answer for choice in status.choices))
            if not status.takes_text and text not in known:
                raise InvalidInputError(
                    f"calibration run: got the answer {text!r}, expected one of {list(known)}; an "
                    f"empty one starts {status.action!r}"
                )
            self._set(state="running", **_NO_QUESTION)
            self._answers.put(text)
        return self._status

    def order(self, order: Order) -> RunStatus:
        """Keep the place of a mount once it is still, or drop one; raises ConflictError."""
        if self._request.kind != "mount" or self._status.state != "running":
            raise ConflictError(
                f"calibration run: {self._status.state}, it keeps no places that could be "
                "taken or dropped"
            )
        self._orders.put(order)
        return self._status

    def finish(self) -> RunStatus:
        """Calibrate a camera or its mount with the views so far."""
        self._is_finished.set()
        return self._status

    def cancel(self) -> RunStatus:
        """End the run without a result; a take is discarded, places of a mount are kept."""
        self._is_cancelled.set()
        self._answers.put(None)
        self._thread.join()
        return self._status

    def _work(self, run: Callable[[], dict[str, object]]) -> None:
        try:
            facts = run()
            self._set(state="done", facts=facts)
        except _CancelledError:
            self._set(state="cancelled", **_NO_QUESTION)
        except DexTouchError as error:
            self._set(state="failed", problem=error.message, **_NO_QUESTION)
        except Exception as error:
            # Supervisor of the run: the operator has to see that it ended.
            logger.exception("calibration_run_failed")
            problem = f"{type(error).__name__}: {error}"
            self._set(state="failed", problem=problem, **_NO_QUESTION)

    def _set(self, **changes: object) -> None:
        self._status = self._status.model_copy(update=changes)

    def _say(self, text: str) -> None:
        self._set(lines=(*self._status.lines, text)[-MAX_LINES:])

    def _ask(self, question: Question) -> str:
        self._set(
            state="asking",
            question=question.text,
            action=question.action,
            takes_text=question.takes_text,
            choices=tuple(Choice(label=label, answer=text) for label, text in question.choices),
            countdown=None,
        )
        text = self._answers.get()
        if text is None:
            raise _CancelledError
        return text

    def _wait(self, seconds: float) -> None:
        if self._is_cancelled.wait(seconds):
            raise _CancelledError
        countdown = self._status.countdown
        if countdown is not None:
            elapsed_s = min(countdown.elapsed_s + seconds, countdown.duration_s)
            self._set(countdown=countdown.model_copy(update={"elapsed_s": elapsed_s}))

    def _count_down(self, label: str, duration_s: float) -> None:
        self._set(countdown=Countdown(label=label, duration_s=duration_s))

    def _recorder(self, request: Callable[..., Reply], task: str) -> TakeRecorder:
        return TakeRecorder(
            request,
            task,
            spool=self._place.spool,
            store=self._place.store_url,
            is_practice=self._place.practice == "on",
            wait=self._wait,
            announce=partial(self._count_down, "Recording"),
        )

    def _glove(self) -> dict[str, object]:
        place, side = self._place, self._request.subject
        options = argparse.Namespace(
            side=side,
            to=place.folder,
            url=place.url,
            key=place.key,
            spool=place.spool,
            store=place.store_url,
            rest=None,
            presses=None,
            pressure_sigma=PRESSURE_SIGMA,
            full_scale=FULL_SCALE_COUNTS,
        )
        with closing(place.link()) as link:
            recorder = self._recorder(link.request, glove.TASK)
            guide = Guide(options, recorder, ask=self._ask, say=self._say)
            return glove.calibrate(options, guide, say=self._say)

    def _time(self) -> dict[str, object]:
        place = self._place
        record = f"Record {SHAKE_S:g} s"
        options = argparse.Namespace(
            take="", store=place.store_url, to=place.folder, streams=None, reference=None
        )
        answer = self._ask(
            Question(
                "Strap or hold all trackers and cameras together. Then turn them briskly and "
                "irregularly about all axes, cameras towards a room with edges.",
                record,
            )
        )
        number = 0
        while True:
            number += 1
            if not answer:
                options.take = self._shake(f"{self._status.run_id}-{number}")
            options.streams = answer or None
            try:
                return measure_times(options, say=self._say)
            except InvalidInputError as error:
                trackers = ",".join(name for name in self._streams if name in TRACKERS)
                choices = () if answer else (("Leave the cameras out", trackers),)
                answer = self._ask(
                    Question(f"Not measured: {error.message}", f"{record} again", choices=choices)
                )

    def _shake(self, name: str) -> str:
        self._count_down("Take everything in hand; recording begins in", LEAD_S)
        for _ in range(round(LEAD_S / TICK_S)):
            self._wait(TICK_S)
        with closing(self._place.link()) as link:
            recorder = self._recorder(link.request, TIME_TASK)
            words = "all trackers and cameras shaken together"
            take, _ = recorder.record(name, words, SHAKE_S, str)
        self._set(countdown=None)
        return take

    def _mount(self) -> dict[str, object]:
        camera, folder = self._request.subject, self._place.folder
        photos = self._place.mount_photos(camera)
        options = argparse.Namespace(
            camera=camera,
            board=self._request.board,
            to=folder,
            photos=photos,
            poses=photos / POSES_FILE,
            intrinsics=None,
            invert=None,
            check=False,
        )
        session = MountSession(options, is_resumed=self._request.is_resumed)
        with closing(self._place.link()) as link:
            sightings = station_sightings(link, camera, wait=self._wait)
            for index, sighting in enumerate(sightings):
                while not self._orders.empty():
                    {"take": session.take, "drop": session.drop}[self._orders.get()]()
                session.add(sighting)
                self.image = sighting.image or self.image
                self._set(mount=_mount_view(index, session))
                if session.progress.is_enough or self._is_finished.is_set():
                    break
        self._say(f"{session.num_kept} places: solving")
        facts = calibrate_mount(options, say=self._say)
        session.archive(self._status.run_id)
        return facts

    def _camera(self) -> dict[str, object]:
        camera, folder = self._request.subject, self._place.folder
        photos = folder / "photos" / self._status.run_id
        options = argparse.Namespace(
            camera=camera, board=self._request.board, to=folder, photos=photos, check=False
        )
        session = Session(options, photos, say=self._say)
        with closing(self._place.link()) as link:
            images = station_arrivals(link, camera, wait=self._wait)
            for index, (name, data) in enumerate(images):
                session.add(name, data)
                self.image = data
                self._set(camera=_camera_view(index, session))
                if session.is_enough or self._is_finished.is_set():
                    break
        if session.todo and not self._is_finished.is_set():
            raise InvalidInputError(
                f"lens: {len(session.views)} views are not enough ({session.todo[0]}); check that "
                f"the board is flat and its image sharp, and begin again; photos: {photos}"
            )
        self._say(f"{len(session.views)} views: solving")
        return calibrate_photos(options, say=self._say)


def _camera_view(index: int, session: Session) -> CameraRunView:
    newest, coverage = session.newest, session.coverage
    width_px, height_px = session.size_px
    return CameraRunView(
        image_index=index,
        width_px=width_px,
        height_px=height_px,
        corners_px=_points(newest.pixels) if newest is not None else (),
        outlines_px=tuple(_outline(view) for view in session.views),
        views_by_region=tuple(map(tuple, coverage.views_by_region.tolist())) if coverage else (),
        num_views=len(session.views),
        num_wanted=ENOUGH_VIEWS,
        focal_sigma=coverage.focal_sigma if coverage and coverage.focal_sigma < 1 else None,
        focal_sigma_wanted=MAX_FOCAL_SIGMA,
        todo=session.todo,
        hint=session.hint,
    )


def _mount_view(index: int, session: MountSession) -> MountRunView:
    newest, progress = session.newest, session.progress
    width_px, height_px = session.size_px
    left_out = progress.result.left_out_views if progress.result else ()
    return MountRunView(
        image_index=index,
        width_px=width_px,
        height_px=height_px,
        corners_px=_points(newest.pixels) if newest is not None else (),
        todo=progress.todo,
        hint=session.hint,
        is_board_seen=newest is not None,
        is_tracked=session.is_tracked,
        is_still=session.is_still,
        places=tuple(place not in left_out for place in range(session.num_kept)),
        gauges=progress.gauges,
        problem=progress.problem,
        can_finish=progress.result is not None,
    )


def _outline(view: BoardView) -> Outline:
    """The four corners that are outermost on the board, in turn."""
    x, y = view.points_board[:, 0], view.points_board[:, 1]
    return _points(view.pixels[[np.argmin(s) for s in (x + y, y - x, -x - y, x - y)]])


def _points(pixels: np.ndarray) -> Outline:
    return tuple((round(float(u), 1), round(float(v), 1)) for u, v in pixels)


class CalibrationRuns:
    """The runs of one station: at most one at a time; the last one stays to be looked at."""

    def __init__(self, place: StationLocation) -> None:
        self.place = place
        self._run: GuidedRun | None = None
        self._lock = threading.Lock()

    def start(self, request: RunRequest) -> RunStatus:
        """Begin a run; raises ConflictError while one is on, InvalidInputError for its subject."""
        subjects = {"glove": SIDES, "time": (EVERYTHING,)}.get(request.kind, tuple(TRACKERS))
        if request.subject not in subjects:
            raise InvalidInputError(
                f"calibration run of kind {request.kind}: got {request.subject!r}, expected "
                f"{' or '.join(subjects)}"
            )
        if request.kind in {"camera", "mount"}:
            board = parse_board(request.board)
            if request.kind == "mount":
                check_unambiguous(board, request.board)
        station = self.place.visited()
        if request.kind == "mount":
            read_lens(station.place.folder, request.subject)
        with self._lock:
            if self._run is not None and self._run.status.state not in ENDED:
                raise ConflictError(
                    f"calibration run {self._run.status.run_id!r} is not done; end it first"
                )
            self._run = GuidedRun(request, station)
            return self._run.status

    def switch_practice(self, *, is_on: bool) -> None:
        """Start or stop practice devices; raises ConflictError at real ones, or in a run."""
        with self._lock:
            if self._run is not None and self._run.status.state not in ENDED:
                raise ConflictError(
                    f"practice devices: calibration run {self._run.status.run_id!r} is on; end it"
                )
            self.place.switch_practice(is_on=is_on)
            self._run = None

    def status(self) -> RunStatus | None:
        """The run that is on, or the last one; None before the first."""
        return None if self._run is None else self._run.status

    def present(self) -> GuidedRun:
        """The run that is on, or the last one; raises NotFoundError: none was begun."""
        if self._run is None:
            raise NotFoundError("calibration run: none was begun; start one first")
        return self._run

    def close(self) -> None:
        """End the run that is on."""
        if self._run is not None:
            self._run.cancel()
