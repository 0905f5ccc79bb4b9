"""Applications of all services, for tests of what they have in common."""

import httpx

from dextouch.episodes import EpisodeStore
from dextouch.worlds import CopyFirstWorld, WorldServiceSettings, create_world_app
from services.acquisition.settings import AcquisitionSettings
from services.alignment.settings import AlignmentSettings
from services.dashboard.settings import DashboardSettings
from services.episode_store.settings import EpisodeStoreSettings
from services.evaluation.settings import RatingSettings
from tests.unit.evaluation import toy
from tests.unit.evaluation.toy_store import write
from tests.unit.worlds.fakes import SumWorld

RUBRICS = """
[reach]
[[reach.criteria]]
name = "touched"
points = 2
milestone = "touched"
description = "The hand touched the spot."
"""


def acquisition(folder, **settings):
    from services.acquisition.app import create_app

    return create_app(AcquisitionSettings(mock=True, spool=folder / "spool", **settings))


def alignment(folder, **settings):
    from services.alignment.app import create_app

    return create_app(AlignmentSettings(store_url=str(folder), **settings))


def dashboard(_, *, upstreams=None, **settings):
    from services.dashboard.app import create_app

    return create_app(DashboardSettings(**settings), upstreams or {})


def episode_store(folder, **settings):
    from services.episode_store.app import create_app

    return create_app(EpisodeStoreSettings(store_url=str(folder), **settings))


def worlds(_, **settings):
    world = SumWorld()
    served = {"sum": world, "copy-first": CopyFirstWorld.beside(world.description)}
    return create_world_app(served, WorldServiceSettings(**settings))


def studies(folder, **settings):
    from services.evaluation.settings import StudyServiceSettings
    from services.evaluation.studies.app import create_app

    return create_app(StudyServiceSettings(studies=folder, **settings))


def rating(folder, **settings):
    from services.evaluation.rating.app import create_rating_app

    url, rubrics = str(folder / "rated"), folder / "rubrics.toml"
    if not rubrics.exists():
        write(EpisodeStore(url), toy.demonstration("reach", 1, name="dream-1"), origin="imagined")
        rubrics.write_text(RUBRICS)
    paths = {"store_url": url, "marks": folder / "marks.sqlite", "rubrics": rubrics}
    return create_rating_app(RatingSettings(**paths, **settings))


def teleoperation(_, **settings):
    from services.pipelines.teleoperation.app import create_app
    from services.pipelines.teleoperation.settings import TeleoperationSettings

    return create_app(TeleoperationSettings(**settings))


# The services of `dextouch up` by name.
UP = {
    "acquisition": acquisition,
    "alignment": alignment,
    "dashboard": dashboard,
    "episode_store": episode_store,
    "studies": studies,
    "twin": worlds,
    "world_model": worlds,
}
# Each kind of application once: the two services that serve worlds have the same routes.
APPS = {name: make for name, make in UP.items() if make is not worlds} | {
    "worlds": worlds,
    "rating": rating,
    "teleoperation": teleoperation,
}


def client_of(app, base_url="http://127.0.0.1:8000"):
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    return httpx.AsyncClient(transport=transport, base_url=base_url)


async def open_websocket(app, path, **given):
    """First message of the service to a WebSocket of its own page, which closes at once."""
    made = httpx.Request("GET", f"http://127.0.0.1:8000{path}", **given)
    sent = []
    messages = [{"type": "websocket.connect"}, {"type": "websocket.disconnect", "code": 1000}]

    async def receive():
        return messages.pop(0)

    async def send(message):
        sent.append(message)

    headers = [(name.lower(), value) for name, value in made.headers.raw]
    headers = [*headers, (b"origin", b"http://127.0.0.1:8000")]
    scope = {"type": "websocket", "scheme": "ws", "path": path, "raw_path": path.encode()}
    scope |= {"headers": headers, "query_string": made.url.query, "root_path": ""}
    await app(scope | {"subprotocols": [], "state": {}, "app": app}, receive, send)
    return sent[0]


def all_routes(app):
    """Routes of an application, also those that are not in its OpenAPI document."""
    for route in app.routes:
        included = getattr(route, "original_router", None)
        if included is None:
            yield route
        else:
            yield from all_routes(included)
