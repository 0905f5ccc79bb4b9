"""Command `dextouch up`: runs every service in one process, which locks the data folder."""

import asyncio
import fcntl
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fastapi import FastAPI
from pydantic import ValidationError

from dextouch.command_line import write_result
from dextouch.episodes import disk_errors
from dextouch.errors import ConflictError, InvalidInputError, UnknownNameError
from dextouch.serving import configure_logging, explained, load_settings
from services.cli.extras import missing_package
from services.cli.standard_streams import discard_output
from services.cli.up_settings import UpSettings
from services.pipelines.servers import (
    BoundAddress,
    bind,
    run_on_event_loop,
    serve_all,
    stop_on_signals,
)

if TYPE_CHECKING:
    from services.acquisition.settings import AcquisitionSettings

LOOPBACK = "127.0.0.1"
NEEDED = ("episode_store", "acquisition", "dashboard")
# Makes the app of one service from the settings and the addresses of all services.
Builder = Callable[[UpSettings, Mapping[str, str]], FastAPI]
LOCK_FILE: Final = "up.lock"
MAX_HOLDER_BYTES: Final = 1000


def ports_of_up() -> dict[str, int]:
    """Port of each service that `dextouch up` starts, from the environment and dextouch.toml.

    Raises InvalidInputError for invalid settings.
    """
    settings = load_settings(UpSettings, [])
    enabled = _enabled(settings)
    fields = (name for name in UpSettings.model_fields if name.endswith("_port"))
    return {
        name: getattr(settings, field)
        for field in fields
        if (name := field.removesuffix("_port")) in enabled
    }


def main(argv: Sequence[str]) -> int:
    """Serve until SIGINT or SIGTERM."""
    settings = load_settings(UpSettings, list(argv))
    configure_logging(service="up", log_format="auto", level=settings.log_level)
    return run_on_event_loop(run(settings))


async def run(settings: UpSettings, stop: asyncio.Event | None = None) -> int:
    """Build and serve all services until `stop` is set (tests) or a signal arrives."""
    if stop is None:
        stop = asyncio.Event()
        stop_on_signals(stop)
    builders = _enabled(settings)
    with ExitStack() as held:
        tell = held.enter_context(held_data_folder(settings.data))
        # Explicit ports first, so that no default takes one of them.
        given = settings.model_fields_set
        bound = {}
        for name in sorted(builders, key=lambda name: f"{name}_port" not in given):
            bound[name] = _bind(name, settings)
            held.callback(bound[name].socket.close)
        urls = {name: bound[name].url for name in builders}
        tell(urls["dashboard"])
        placed = [(bound[name], _build(name, settings, urls)) for name in builders]
        await serve_all(placed, stop=stop, on_ready=partial(_announce, settings, urls))
    return 0


def _bind(name: str, settings: UpSettings) -> BoundAddress:
    field = f"{name}_port"
    port: int = getattr(settings, field)
    try:
        return bind(name, host=LOOPBACK, port=port)
    except ConflictError:
        if field in settings.model_fields_set:
            raise
        print(f"{name}: port {port} is taken, so it gets any free one", file=sys.stderr)
        return bind(name, host=LOOPBACK, port=0)


def _build(name: str, settings: UpSettings, urls: Mapping[str, str]) -> FastAPI:
    try:
        return BUILDERS[name](settings, urls)
    except ValidationError as error:
        raise InvalidInputError(f"settings of {name}: {explained(error, name)}") from error
    except ModuleNotFoundError as error:
        otherwise = f", or leave this service out with --without {name}"
        refusal = missing_package(error, "" if name in NEEDED else otherwise)
        if refusal is None:
            raise
        raise refusal from error


def _enabled(settings: UpSettings) -> Mapping[str, Builder]:
    optional = [name for name in BUILDERS if name not in NEEDED]
    for name in settings.without:
        if name not in optional:
            raise UnknownNameError("service to leave out", name, optional)
    return {name: build for name, build in BUILDERS.items() if name not in settings.without}


def _announce(settings: UpSettings, urls: Mapping[str, str]) -> None:
    try:
        for name, url in urls.items():
            print(f"{name:<14}{url}")
        print(f"data          {settings.data.resolve()}")
        print(f"\nOpen {urls['dashboard']} · stop with Ctrl-C", flush=True)
    except OSError:
        # Nobody reads it, which is no reason to end the services.
        discard_output()
    write_result(settings.json_path, dict(urls))


# Services are imported lazily, to keep `dextouch --help` fast.


def _episode_store(settings: UpSettings, _: Mapping[str, str]) -> FastAPI:
    from services.episode_store.app import create_app
    from services.episode_store.settings import EpisodeStoreSettings

    return create_app(EpisodeStoreSettings(store_url=settings.store_url))


def _alignment(settings: UpSettings, urls: Mapping[str, str]) -> FastAPI:
    from services.alignment.app import create_app
    from services.alignment.settings import AlignmentSettings

    return create_app(
        AlignmentSettings(
            store_url=settings.store_url,
            align_new=settings.align_new,
            station_url=urls.get("acquisition"),
            station_spool=settings.data / "spool",
            calibration_folder=settings.data / "calibration",
            log_level=settings.log_level,
        )
    )


def _acquisition(settings: UpSettings, urls: Mapping[str, str]) -> FastAPI:
    from services.acquisition.app import create_app
    from services.pipelines.station import load_robot_check

    station = _station(settings, episode_store_url=urls["episode_store"])
    return create_app(station, follow=load_robot_check)


def _station(settings: UpSettings, **given: object) -> "AcquisitionSettings":
    from services.acquisition.settings import AcquisitionSettings

    if settings.mock or "station" in settings.model_fields_set:
        given["station"] = settings.station
    if settings.mock_faults is not None:
        given["mock_faults"] = settings.mock_faults
    if settings.mock_episode_id is not None:
        given |= {"mock_store": settings.store_url, "mock_episode_id": settings.mock_episode_id}
    station = AcquisitionSettings.model_validate(
        {"spool": settings.data / "spool", "mock": settings.mock} | given
    )
    if not station.mock and not station.devices:
        raise InvalidInputError(
            "up: got --no-mock and no devices, expected them in DEXTOUCH_ACQUISITION_DEVICES "
            "(docs/stations.md)"
        )
    calibrated = settings.data / "calibration" / "calibration.json"
    if not station.mock and station.calibration is None and calibrated.is_file():
        return station.model_copy(update={"calibration": calibrated})
    return station


def _twin(_: UpSettings, __: Mapping[str, str]) -> FastAPI:
    from dextouch.worlds import create_world_app
    from services.twin.settings import TwinServiceSettings
    from services.twin.world import twin_worlds

    settings = TwinServiceSettings()
    return create_world_app(twin_worlds(settings.scene), settings, name="twin")


def _world_model(_: UpSettings, __: Mapping[str, str]) -> FastAPI:
    from dextouch.worlds import create_world_app
    from services.world_model.command_line import open_model
    from services.world_model.settings import WorldModelSettings

    settings = WorldModelSettings()
    world = open_model(settings.checkpoint, settings)
    return create_world_app({settings.world_name: world}, settings, name="world_model")


def _studies(settings: UpSettings, _: Mapping[str, str]) -> FastAPI:
    from services.evaluation.settings import StudyServiceSettings
    from services.evaluation.studies.app import create_app

    return create_app(StudyServiceSettings(studies=settings.data / "studies"))


def _dashboard(settings: UpSettings, urls: Mapping[str, str]) -> FastAPI:
    from services.dashboard.app import create_app
    from services.dashboard.settings import DashboardSettings

    station = _station(settings).station
    upstreams = {f"{name}_url": url for name, url in urls.items() if name != "dashboard"}
    given = {"station": station, "audit_folder": settings.data / "audit"}
    return create_app(DashboardSettings.model_validate(given | upstreams))


# In the order of the data flow; stopped in reverse.
BUILDERS: Mapping[str, Builder] = {
    "episode_store": _episode_store,
    "alignment": _alignment,
    "acquisition": _acquisition,
    "twin": _twin,
    "world_model": _world_model,
    "studies": _studies,
    "dashboard": _dashboard,
}


@contextmanager
def held_data_folder(folder: Path) -> Iterator[Callable[[str], None]]:
    """Context manager that holds the lock of a data folder, which is created if needed.

    It yields a function by which the file tells others the address of the dashboard. The kernel
    releases the lock when the process ends, however it does. Raises ConflictError if another
    process holds it, and StorageError if the folder cannot be created or written.
    """
    path = folder / LOCK_FILE
    with disk_errors(
        f"use the data folder {folder}", advice="free space, or choose another --data"
    ):
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, MAX_HOLDER_BYTES, 0).decode(errors="replace")
            raise ConflictError(
                f"the data folder {folder.resolve()} is in use by another `dextouch up` "
                f"({holder or 'which is just starting'}); stop that one with Ctrl-C or kill, or "
                "give this one a folder of its own with --data"
            ) from error
        tell = partial(_tell, descriptor)
        tell("an address that is not known yet")
        yield tell
    finally:
        os.close(descriptor)


def _tell(descriptor: int, dashboard_url: str) -> None:
    text = f"process {os.getpid()}, dashboard at {dashboard_url}"
    with disk_errors("write the lock of the data folder"):
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, text.encode(), 0)
