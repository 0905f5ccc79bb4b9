"""The application of one station; its devices, recorder and uploads live as long as it."""

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from fastapi import FastAPI
from starlette.concurrency import run_in_threadpool

from dextouch.episodes import disk_errors
from dextouch.serving import create_service_app, serve
from services.acquisition.clock import RealClock
from services.acquisition.devices import build_drivers, load_calibration
from services.acquisition.memory import keep_for_life
from services.acquisition.routes import recorder_router, station_router
from services.acquisition.settings import AcquisitionSettings
from services.acquisition.station import Station
from services.acquisition.supervisor import SpoolSafety
from services.acquisition.uploader import Uploader, recover_spool


class _RealStation:
    """A station of real devices with the life cycle of a mock one."""

    def __init__(self, settings: AcquisitionSettings) -> None:
        clock = RealClock()
        self.station = Station(
            name=settings.station,
            drivers=build_drivers(settings.devices, clock),
            spool_root=settings.spool,
            clock=clock,
            calibration=load_calibration(settings.calibration),
            safety=_spool_safety(settings),
        )

    def start(self) -> None:
        """Start; devices that are absent are waited for in the background."""
        self.station.start()

    def stop(self) -> None:
        """Stop."""
        self.station.stop()


class _MockStation:
    """A station whose mock devices play round and round."""

    def __init__(self, settings: AcquisitionSettings) -> None:
        from services.acquisition.mock_station import MockStation
        from services.acquisition.mocks.faults import FaultScript
        from services.acquisition.mocks.pattern import pattern_calibration, pattern_streams

        streams, calibration = pattern_streams(), load_calibration(settings.calibration)
        calibration = {**pattern_calibration(), **calibration}
        if settings.mock_store is not None and settings.mock_episode_id is not None:
            from dextouch.episodes import EpisodeStore
            from services.acquisition.mocks.episode import replay_calibration, replay_streams

            episode = EpisodeStore(settings.mock_store).open(settings.mock_episode_id)
            streams = replay_streams(episode)
            calibration = {**replay_calibration(episode), **calibration}
        faults = FaultScript()
        if settings.mock_faults == "first_light":
            faults = FaultScript.first_light()
        self._mock = MockStation(
            streams,
            faults,
            settings.seed,
            RealClock(),
            spool_root=settings.spool,
            name=settings.station,
            calibration=calibration,
            links=settings.mock_links,
            safety=_spool_safety(settings),
        )
        self.station = self._mock.station

    def start(self) -> None:
        """Start and play."""
        self._mock.start()
        self._mock.play_forever()

    def stop(self) -> None:
        """Stop."""
        self._mock.stop()


def _spool_safety(settings: AcquisitionSettings) -> SpoolSafety:
    return SpoolSafety(settings.flush_period_s, settings.min_free_bytes)


def _make_uploader(settings: AcquisitionSettings) -> Uploader:
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
        keep_uploaded=settings.keep_uploaded,
    )


def create_app(settings: AcquisitionSettings, uploader: Uploader | None = None) -> FastAPI:
    """A station; takes that an earlier process left unfinished are closed first.

    Args:
        settings: devices, spool and store.
        uploader: how takes reach the store; made from the settings when not given.

    Raises:
        InvalidInputError: neither devices nor mocks, or an unknown episode to play.
        StorageError: the folder of the takes cannot be made.
    """
    with disk_errors(f"make the spool {settings.spool}"):
        settings.spool.mkdir(parents=True, exist_ok=True)
    recover_spool(settings.spool)
    running = _MockStation(settings) if settings.mock else _RealStation(settings)
    uploads = uploader or _make_uploader(settings)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await run_in_threadpool(running.start)
        uploads.start()
        try:
            yield
        finally:
            await run_in_threadpool(uploads.stop)
            await run_in_threadpool(running.stop)

    async def missing() -> Sequence[str]:
        supervisors = running.station.supervisors
        return [s.driver.name for s in supervisors if not s.counters.is_connected]

    return create_service_app(
        name="acquisition",
        settings=settings,
        routers=[recorder_router(running.station), station_router(running.station, uploads)],
        lifespan=lifespan,
        readiness=missing,
    )


def main(argv: Sequence[str]) -> int:
    """Run a station until SIGINT or SIGTERM."""

    def create(settings: AcquisitionSettings) -> FastAPI:
        app = create_app(settings)
        keep_for_life()
        return app

    return serve("acquisition", AcquisitionSettings, create, argv)
