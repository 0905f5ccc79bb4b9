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
from typing import Literal

import numpy as np
import structlog
from pydantic import AwareDatetime, Field

from dextouch.clients import HttpLink
from dextouch.errors import ConflictError, DexTouchError, InvalidInputError, NotFoundError
from dextouch.free_text import FreeText
from dextouch.frozen_model import FrozenModel
from dextouch.schemas import StationHealth
from services.alignment.calibration.tactile_tare import FULL_SCALE_COUNTS
from services.alignment.station_calibration import glove
from services.alignment.station_calibration.boards import (
    ENOUGH_VIEWS,
    MAX_FOCAL_SIGMA,
    BoardView,
    parse_board,
)
from services.alignment.station_calibration.camera_views import (
    Session,
    calibrate_photos,
    station_arrivals,
)
from services.alignment.station_calibration.glove import Guide

logger = structlog.get_logger(__name__)

MAX_LINES = 40
PRESSURE_SIGMA = 0.02
PRACTICE = "practice"

RunState = Literal["running", "asking", "done", "failed", "cancelled"]
ENDED: frozenset[RunState] = frozenset({"done", "failed", "cancelled"})
Outline = tuple[tuple[float, float], ...]


class RunRequest(FrozenModel):
    """A guided run: intrinsics of a camera with a board, or tare and gain of a glove."""

    kind: Literal["camera", "glove"]
    subject: Literal["head", "wrist_left", "wrist_right", "left", "right"]
    board: FreeText = Field(default="", max_length=64)


class Answer(FrozenModel):
    """What the operator answers to the question of a run."""

    text: FreeText = Field(max_length=200)


class CameraRunView(FrozenModel):
    """Live view of a camera run: the newest image and what was seen in it, in its pixels.

    `corners_px` are those of the newest image, `outlines_px` those of the boards that were kept.
    `focal_sigma` is the standard deviation of the focal length that the views give, as a share of
    it, None where they give none; the run goes on until it is `focal_sigma_wanted`.
    """

    image_index: int
    width_px: int
    height_px: int
    corners_px: Outline = ()
    outlines_px: tuple[Outline, ...] = ()
    views_by_region: tuple[tuple[int, ...], ...] = ()
    num_views: int = 0
    num_wanted: int
    focal_sigma: float | None = None
    focal_sigma_wanted: float
    todo: tuple[str, ...] = ()
    hint: str = ""


class RunStatus(FrozenModel):
    """State of a guided run; `lines` is what it said, `question` what it waits for.

    `facts` are the results as in `calibration_details.json`.
    """

    run_id: str
    request: RunRequest
    state: RunState
    started_at: AwareDatetime
    question: str = ""
    lines: tuple[str, ...] = ()
    busy_s: float = 0.0
    camera: CameraRunView | None = None
    facts: dict[str, object] = Field(default_factory=dict)
    problem: str = ""


class _CancelledError(Exception):
    """The operator ended the run."""


@dataclass(frozen=True)
class StationLocation:
    """Where the station answers, where its takes are, and the folder of its calibration."""

    url: str | None
    key: str | None
    folder: Path
    spool: Path
    store_url: str

    def link(self) -> HttpLink:
        """A connection to the station.

        Raises:
            InvalidInputError: no station is set.
        """
        if self.url is None:
            raise InvalidInputError(
                "calibration: no station_url is set; start the alignment service with "
                "DEXTOUCH_ALIGNMENT_STATION_URL=http://STATION:8083"
            )
        return HttpLink(self.url, api_key=self.key)

    def visited(self) -> tuple["StationLocation", tuple[str, ...]]:
        """The place with the folder of its devices, and the names of the station's streams.

        Simulated devices have the folder `practice`, so that nobody records with their calibration.
        """
        with closing(self.link()) as link:
            reply = link.request("GET", "/v1/health")
        health = StationHealth.model_validate_json(reply.body, extra="ignore")
        streams = tuple(stream.stream for stream in health.streams)
        if any(device.simulated for device in health.devices):
            return replace(self, folder=self.folder / PRACTICE), streams
        return self, streams


class GuidedRun:
    """One run, which another thread watches, answers and ends.

    Args:
        request: what is calibrated.
        place: the station.
    """

    def __init__(self, request: RunRequest, place: StationLocation) -> None:
        self._place, self._request = place, request
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
        run = {"camera": self._camera, "glove": self._glove}[request.kind]
        self._thread = threading.Thread(target=partial(self._work, run), name="calibration-run")
        self._thread.start()

    @property
    def status(self) -> RunStatus:
        """Present state."""
        return self._status

    def answer(self, text: str) -> RunStatus:
        """Answer the question of the run.

        Raises:
            ConflictError: it asks nothing.
        """
        with self._lock:
            if self._status.state != "asking":
                raise ConflictError(f"calibration run: {self._status.state}, it asks nothing")
            self._set(state="running", question="", busy_s=0.0)
            self._answers.put(text)
        return self._status

    def finish(self) -> RunStatus:
        """Calibrate a camera with the views so far."""
        self._is_finished.set()
        return self._status

    def cancel(self) -> RunStatus:
        """End the run; nothing is written, a take that is being recorded is discarded."""
        self._is_cancelled.set()
        self._answers.put(None)
        self._thread.join()
        return self._status

    def _work(self, run: Callable[[], dict[str, object]]) -> None:
        try:
            facts = run()
            self._set(state="done", facts=facts)
        except _CancelledError:
            self._set(state="cancelled", question="")
        except DexTouchError as error:
            self._set(state="failed", question="", problem=error.message)
        except Exception as error:
            # Supervisor of the run: the operator has to see that it ended.
            logger.exception("calibration_run_failed")
            self._set(state="failed", question="", problem=f"{type(error).__name__}: {error}")

    def _set(self, **changes: object) -> None:
        self._status = self._status.model_copy(update=changes)

    def _say(self, text: str) -> None:
        self._set(lines=(*self._status.lines, text)[-MAX_LINES:])

    def _ask(self, question: str) -> str:
        self._set(state="asking", question=question)
        text = self._answers.get()
        if text is None:
            raise _CancelledError
        return text

    def _wait(self, seconds: float) -> None:
        if self._is_cancelled.wait(seconds):
            raise _CancelledError
        self._set(busy_s=self._status.busy_s + seconds)

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
            guide = Guide(options, link.request, ask=self._ask, say=self._say, wait=self._wait)
            return glove.calibrate(options, guide, say=self._say)

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
        """Begin a run.

        Raises:
            ConflictError: another one is not done.
            InvalidInputError: no such board, subject or station.
        """
        expected = ("left", "right") if request.kind == "glove" else ("head", "wrist_left")
        is_hand = request.subject in {"left", "right"}
        if is_hand != (request.kind == "glove"):
            raise InvalidInputError(
                f"calibration run of a {request.kind}: got {request.subject!r}, expected one such "
                f"as {' or '.join(expected)}"
            )
        if request.kind == "camera":
            parse_board(request.board)
        place, _ = self.place.visited()
        with self._lock:
            if self._run is not None and self._run.status.state not in ENDED:
                raise ConflictError(
                    f"calibration run {self._run.status.run_id!r} is not done; end it first"
                )
            self._run = GuidedRun(request, place)
            return self._run.status

    def status(self) -> RunStatus | None:
        """The run that is on, or the last one; None before the first."""
        return None if self._run is None else self._run.status

    def present(self) -> GuidedRun:
        """The run that is on, or the last one.

        Raises:
            NotFoundError: none was begun.
        """
        if self._run is None:
            raise NotFoundError("calibration run: none was begun; start one first")
        return self._run

    def close(self) -> None:
        """End the run that is on."""
        if self._run is not None:
            self._run.cancel()
