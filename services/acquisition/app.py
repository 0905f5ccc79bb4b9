"""Application of one station, and of the practice station that a mock one starts when wanted."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING, Final

from fastapi import APIRouter, Depends, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from dextouch.data_folder import practice_spool
from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError, InvalidInputError, NotFoundError
from dextouch.schemas import PracticeStatus
from dextouch.serving import RequireScope, create_service_app, serve
from dextouch.tactile import TactileLayout, read_layout
from services.acquisition import retention, routes
from services.acquisition.clock import StationClock
from services.acquisition.devices import build_drivers, load_calibration
from services.acquisition.health.metrics import HealthCollector, RecorderCollector
from services.acquisition.recorder import Recorder, keep_for_life
from services.acquisition.settings import AcquisitionSettings, with_enrolment
from services.acquisition.station import Station
from services.acquisition.uploader import Uploader, ids_in_store, recover_spool
from services.acquisition.watches import MakeFollowCheck

if TYPE_CHECKING:
    from services.acquisition.mock_station import MockStation

PRACTICE_PATH: Final = "/practice"


class Practice:
    """An ASGI application that serves the practice station while there is one.

    `make` makes it; None where devices are real.
    """

    def __init__(self, make: Callable[[], FastAPI] | None) -> None:
        self._make = make
        self._lock = asyncio.Lock()
        self._running: AsyncExitStack | None = None
        self._app: FastAPI | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            NotFoundError: the practice devices are off.
        """
        if self._app is None:
            raise NotFoundError("practice devices: they are off; POST /v1/practice/start first")
        await self._app(scope, receive, send)

    @property
    def status(self) -> PracticeStatus:
        """Whether the practice devices run."""
        if self._make is None:
            return PracticeStatus(state="unavailable")
        return PracticeStatus(state="off" if self._app is None else "on")

    async def start(self) -> PracticeStatus:
        """Start the devices, which takes seconds; nothing happens if they run.

        Raises:
            ConflictError: the station has real devices.
        """
        if self._make is None:
            raise ConflictError(
                "practice devices: this station has real devices; practise with "
                "`dextouch up --mock` in another data folder"
            )
        async with self._lock:
            if self._app is None:
                app = await run_in_threadpool(self._make)
                self._running = AsyncExitStack()
                await self._running.enter_async_context(app.router.lifespan_context(app))
                self._app = app
        return self.status

    async def stop(self) -> PracticeStatus:
        """Stop the devices; nothing happens if they do not run."""
        async with self._lock:
            self._app, running, self._running = None, self._running, None
            if running is not None:
                await running.aclose()
        return self.status

    def router(self) -> APIRouter:
        """Routes that start and stop it."""
        router = APIRouter(
            prefix="/v1/practice", tags=["station"], dependencies=[Depends(RequireScope("station"))]
        )

        @router.get("")
        async def get_practice() -> PracticeStatus:
            """Whether devices to practise calibration with run, below `/practice`."""
            return self.status

        @router.post("/start")
        async def start_practice() -> PracticeStatus:
            """Start the practice devices."""
            return await self.start()

        @router.post("/stop")
        async def stop_practice() -> PracticeStatus:
            """Stop the practice devices."""
            return await self.stop()

        return router


def _real_station(settings: AcquisitionSettings, follow: MakeFollowCheck | None) -> Station:
    """A station of real devices; those that are absent are waited for in the background."""
    clock = StationClock()
    return Station(
        name=settings.station,
        drivers=build_drivers(settings.devices, clock),
        spool_root=settings.spool,
        clock=clock,
        calibration=load_calibration(settings.calibration),
        safety=settings,
        follow=follow,
    )


def practice_app(settings: AcquisitionSettings) -> FastAPI:
    """A mock station to practise calibration with.

    Its takes are not uploaded, so that those of the last time are removed.
    """
    from services.acquisition.mock_station import MockStation
    from services.acquisition.mocks import pattern
    from services.acquisition.mocks.faults import FaultScript

    spool = practice_spool(settings.spool)
    practice = settings.model_copy(update={"spool": spool, "episode_store_url": None})
    with disk_errors(f"make the spool {spool}"):
        spool.mkdir(parents=True, exist_ok=True)
    for take in retention.spooled_takes(spool):
        retention.remove_take(take)
    mock = MockStation(
        pattern.practice_streams(settings.seed, layout=_mock_layout(settings)),
        FaultScript(devices=pattern.PRACTICE_FAULTS),
        settings.seed,
        StationClock(),
        spool_root=spool,
        name=f"{settings.station} practice",
        links=settings.mock_links,
        safety=settings,
        unknown_delays=(*pattern.T_HEAD_WRISTS, "camera_head"),
    )
    return _station_app(
        practice, mock.station, mock, _make_uploader(practice, mock.station.recorder)
    )


def _mock_layout(settings: AcquisitionSettings) -> TactileLayout | None:
    """Layout of the mock gloves; None for `dextouch_v1`."""
    path = settings.mock_links.layout
    return None if path is None else read_layout(path)


def _mock_station(settings: AcquisitionSettings, follow: MakeFollowCheck | None) -> "MockStation":
    from services.acquisition.mock_station import MockStation
    from services.acquisition.mocks.faults import FaultScript
    from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams

    layout = _mock_layout(settings)
    streams, known = pattern_streams(layout=layout), pattern_calibration()
    if settings.mock_store is not None and settings.mock_episode_id is not None:
        from dextouch.episodes import EpisodeStore
        from services.acquisition.mocks.replay import replay_streams

        if layout is not None:
            raise InvalidInputError(
                f"mock station: got layout {layout.name!r} and an episode to play, expected one of "
                "them: an episode says the layout of its gloves"
            )
        episode = EpisodeStore(settings.mock_store).open(settings.mock_episode_id)
        streams, known = replay_streams(episode), {**known, **episode.attributes.matrices()}
    scripts = {"first_light": FaultScript.first_light, "worn_glove": FaultScript.worn_glove}
    return MockStation(
        streams,
        scripts.get(settings.mock_faults, FaultScript)(),
        settings.seed,
        StationClock(),
        spool_root=settings.spool,
        name=settings.station,
        calibration={**known, **load_calibration(settings.calibration)},
        links=settings.mock_links,
        safety=settings,
        follow=follow,
    )


def _make_uploader(settings: AcquisitionSettings, recorder: Recorder) -> Uploader:
    store = None
    if settings.episode_store_url is not None:
        from dextouch.clients import EpisodeStoreClient

        key = settings.episode_store_key
        store = EpisodeStoreClient(
            settings.episode_store_url, api_key=None if key is None else key.get_secret_value()
        )
    return Uploader(
        settings.spool,
        store,
        period_s=settings.upload_period_s,
        retention=settings,
        deleted=retention.DeletedTakes(
            settings.spool,
            settings.station,
            stored_as=ids_in_store,
            operators=retention.OperatorNames(recorder.session.operators, recorder.session.forget),
        ),
    )


def create_app(
    settings: AcquisitionSettings,
    uploader: Uploader | None = None,
    *,
    follow: MakeFollowCheck | None = None,
) -> FastAPI:
    """A station; takes that an earlier process left unfinished are closed first.

    The uploader is made from the settings where none is given; `follow` is as of `Station`.

    Raises:
        InvalidInputError: neither devices nor mocks, or an unknown episode to play.
        StorageError: the folder of the takes cannot be made.
    """
    settings = with_enrolment(settings)
    with disk_errors(f"make the spool {settings.spool}"):
        settings.spool.mkdir(parents=True, exist_ok=True)
    recover_spool(settings.spool)
    mock = _mock_station(settings, follow) if settings.mock else None
    station = _real_station(settings, follow) if mock is None else mock.station
    uploads = uploader or _make_uploader(settings, station.recorder)
    is_required = settings.require_consent
    station.recorder.needs_consent = not settings.mock if is_required is None else is_required
    practice = Practice(partial(practice_app, settings) if settings.mock else None)
    return _station_app(settings, station, mock, uploads, practice)


def _station_app(
    settings: AcquisitionSettings,
    station: Station,
    mock: "MockStation | None",
    uploads: Uploader,
    practice: Practice | None = None,
) -> FastAPI:
    """The application around a station; `practice` is what runs below its `/practice`."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        # /metrics shows the station's health for as long as the application runs.
        collectors = (
            HealthCollector(station.health.report, station.health.raised),
            RecorderCollector(station.recorder.status, uploads.counts, uploads.retention),
        )
        for collector in collectors:
            app.state.registry.register(collector)
        await run_in_threadpool((mock or station).start)
        if mock is not None:
            mock.play_forever()
        uploads.start()
        try:
            yield
        finally:
            if practice is not None:
                await practice.stop()
            await run_in_threadpool(uploads.stop)
            await run_in_threadpool((mock or station).stop)
            for collector in collectors:
                app.state.registry.unregister(collector)

    async def missing() -> Sequence[str]:
        spool = station.recorder.spool_folder.problem(writing=True)
        silent = [s.driver.name for s in station.supervisors if not s.connected.is_set()]
        return silent if spool is None else [spool, *silent]

    app = create_service_app(
        name="acquisition",
        settings=settings,
        routers=[
            routes.recorder_router(station),
            routes.station_router(station, uploads),
            routes.uploads_router(uploads),
            routes.live_router(station),
            routes.faults_router(mock),
            *([practice.router()] if practice is not None else []),
        ],
        lifespan=lifespan,
        readiness=missing,
    )
    app.state.is_working = station.is_working
    if practice is not None:
        app.mount(PRACTICE_PATH, practice)
    return app


def main(argv: Sequence[str], *, follow: MakeFollowCheck | None = None) -> int:
    """Run a station until SIGINT or SIGTERM; `follow` as of `Station`."""

    def create(settings: AcquisitionSettings) -> FastAPI:
        app = create_app(settings, follow=follow)
        keep_for_life()
        return app

    return serve("acquisition", AcquisitionSettings, create, argv)
