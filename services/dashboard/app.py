"""Application factory of the dashboard."""

from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry, Gauge

from dextouch.serving import create_service_app, serve
from services.dashboard import routes
from services.dashboard.audit import AuditLog, AuditTrail
from services.dashboard.comparison import Comparisons
from services.dashboard.feeds import Feeds
from services.dashboard.fleet import Fleet
from services.dashboard.pages import Sessions, page_router, refusal_page
from services.dashboard.rollout_feeds import RolloutFeeds
from services.dashboard.settings import DashboardSettings
from services.dashboard.system import System
from services.dashboard.upstream import Upstream, upstream_histogram

STATIC = Path(__file__).parent / "static"


def create_app(
    settings: DashboardSettings, upstreams: Mapping[str, Upstream] | None = None
) -> FastAPI:
    """The dashboard's application; clients are made from the settings' URLs if none are given."""
    upstreams, stations = _clients(settings, upstreams)
    clients = (*upstreams.values(), *stations.values())
    feeds = {
        name: Feeds({"acquisition": client, **upstreams}, settings)
        for name, client in stations.items()
    }
    fleet = Fleet(feeds or {settings.station: Feeds(upstreams, settings)}, settings)
    shared = fleet.of()
    comparisons = Comparisons(shared, period_s=settings.station_period_s)
    system = System(stations, upstreams)
    audit_log = AuditLog(settings.audit_folder, max_bytes=settings.audit_max_bytes)
    sessions = Sessions(
        needs_key=bool(settings.api_keys),
        lifetime_s=3600 * settings.session_hours,
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        yield
        await comparisons.stop()
        for client in clients:
            await client.close()

    app = create_service_app(
        name="dashboard",
        settings=settings,
        routers=[
            page_router(settings, sessions),
            routes.api_router(settings, fleet, sessions),
            routes.forwarding_router(fleet, sessions),
            routes.comparison_router(comparisons, sessions),
            routes.system_router(system, audit_log, sessions, upstreams.get("episode_store")),
            routes.live_router(
                fleet,
                [
                    comparisons.topics.get,
                    RolloutFeeds(shared, settings).topic,
                    {system.topic.name: system.topic}.get,
                ],
                sessions,
            ),
        ],
        lifespan=lifespan,
        admits=sessions.allows,
    )
    app.add_middleware(
        AuditTrail, log=audit_log, sessions=sessions, station=next(iter(fleet.names))
    )
    seconds = upstream_histogram()
    for client in clients:
        client.seconds = seconds
    registry: CollectorRegistry = app.state.registry
    registry.register(seconds)
    num_sessions = Gauge("dextouch_dashboard_sessions", "Signed-in browsers.", registry=registry)
    num_sessions.set_function(lambda: sessions.num_open)
    app.state.sessions = sessions
    # The same keys, also after they were exchanged.
    sessions.access = app.state.access
    app.state.refusal_page = partial(refusal_page, settings.station)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    return app


def _clients(
    settings: DashboardSettings, upstreams: Mapping[str, Upstream] | None
) -> tuple[Mapping[str, Upstream], dict[str, Upstream]]:
    if upstreams is not None:
        station = upstreams.get("acquisition")
        return upstreams, {} if station is None else {settings.station: station}
    connect = partial(
        Upstream.connect, key=settings.upstream_key, timeout_s=settings.upstream_timeout_s
    )
    return (
        {name: connect(name, url) for name, url in settings.upstream_urls().items()},
        {name: connect("acquisition", url) for name, url in settings.station_urls().items()},
    )


def main(argv: Sequence[str]) -> int:
    """Serve the dashboard until SIGINT or SIGTERM."""
    return serve("dashboard", DashboardSettings, create_app, argv)
