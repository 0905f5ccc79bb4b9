"""Application that serves worlds over HTTP, in one process or several."""

from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from functools import partial
from typing import Any, Final

from fastapi import FastAPI
from prometheus_client.core import GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from dextouch.serving import (
    SPANS,
    check_address,
    configure_logging,
    create_service_app,
    open_state,
    reload_keys_at_hangup,
    run,
    run_workers,
    server_options,
    settings_with_keys,
)
from dextouch.worlds.openpi import openpi_router
from dextouch.worlds.records import RecordStore, RolloutWatch
from dextouch.worlds.rollouts import Reopen, RolloutService
from dextouch.worlds.routes import ChunkShortcut, rollout_router, watch_router
from dextouch.worlds.settings import WorldServiceSettings
from dextouch.worlds.world import World

# Limits of the buckets of a metric; a batch has 32 rollouts at most.
BATCH_SIZES: Final = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)


class WorldMetrics(Collector):
    """Prometheus metrics of the worlds of a process: queues, rollouts and sizes of batches."""

    def __init__(self, service: RolloutService) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        """All metrics of this moment."""
        queues = self._service.queues()
        text = "Chunks that wait for their world."
        waiting = GaugeMetricFamily("dextouch_rollout_queue_chunks", text, labels=("world",))
        text = "Chunks that may wait; more are refused."
        limit = GaugeMetricFamily("dextouch_rollout_queue_limit_chunks", text, labels=("world",))
        for world, (num_waiting, max_waiting) in queues.items():
            waiting.add_metric((world,), num_waiting)
            limit.add_metric((world,), max_waiting)
        yield from (waiting, limit)
        text = "Rollouts whose state this process holds."
        yield GaugeMetricFamily("dextouch_live_rollouts", text, self._service.num_live)
        text = "Rollouts that all processes together may hold; further starts are refused."
        most = self._service.limits.max_rollouts
        yield GaugeMetricFamily("dextouch_rollouts_limit", text, most)
        text = "1 while the process refuses new rollouts because it is about to end."
        yield GaugeMetricFamily("dextouch_draining", text, float(self._service.is_draining))
        text = "Rollouts of a batch."
        batches = HistogramMetricFamily("dextouch_batch_rollouts", text, labels=("world",))
        for world, sizes in self._service.num_batches().items():
            within = [
                (str(most), sum(n for size, n in sizes.items() if size <= most))
                for most in BATCH_SIZES
            ]
            within.append(("+Inf", sizes.total()))
            batches.add_metric((world,), within, sum(size * n for size, n in sizes.items()))
        yield batches


def create_world_app(
    worlds: Mapping[str, World[Any]],
    settings: WorldServiceSettings,
    *,
    name: str = "worlds",
    reopen: Reopen | None = None,
    warm_up: bool = False,
) -> FastAPI:
    """Create the application; its shutdown ends the worlds' threads.

    `reopen` opens a world by name and digest, for rollouts that began in an earlier one; with
    `warm_up` a first chunk of each world is computed before the application is ready.
    `app.state.drain()` of the application refuses new rollouts and makes it not ready.
    """
    store = open_state(settings.state_url)
    service = RolloutService(worlds, store, settings.limits, reopen=reopen)
    shortcut = ChunkShortcut(service)
    watch = RolloutWatch(RecordStore(store, ttl_s=settings.limits.ttl_s))

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        if warm_up:
            await service.warm_up()
        yield
        service.close()
        await store.close()

    async def readiness() -> list[str]:
        await store.ping()
        return ["shutdown"] if service.is_draining else []

    app = create_service_app(
        name=name,
        settings=settings,
        routers=[rollout_router(service, shortcut), watch_router(watch), openpi_router(service)],
        lifespan=lifespan,
        readiness=readiness,
    )
    app.state.shortcut = shortcut
    app.state.drain = service.drain
    app.state.registry.register(WorldMetrics(service))
    return app


def serve_worlds(
    open_worlds: Callable[[], Mapping[str, World[Any]]],
    settings: WorldServiceSettings,
    *,
    name: str = "worlds",
    reopen: Reopen | None = None,
    load: Callable[[], WorldServiceSettings] | None = None,
) -> None:
    """Serve worlds until SIGINT or SIGTERM, with as many processes as the settings say.

    `open_worlds` is called in each process; it and `reopen` (see `create_world_app`) are picklable.
    At SIGHUP a single process accepts the `api_keys` that `load` gives then; several are replaced,
    one after another, by ones that do, or all stay if the settings have a mistake.
    """
    check_address(name, settings)
    configure_logging(service=name, log_format=settings.log_format, level=settings.log_level)

    def factory(settings: WorldServiceSettings) -> Callable[[], FastAPI]:
        return partial(create_serving_app, open_worlds, settings, name, reopen)

    def renewed() -> Callable[[], FastAPI] | None:
        if load is None or not settings.api_keys:
            return factory(settings)
        now = settings_with_keys(load, has_keys=True)
        if now is None:
            return None
        return factory(settings.model_copy(update={"api_keys": now.api_keys}))

    if settings.workers == 1:
        app = factory(settings)()
        if load is not None:
            reload_keys_at_hangup(app, load)
        run(app, settings, drain=app.state.drain, drain_s=settings.drain_s)
        return
    run_workers(
        factory(settings),
        host=settings.host,
        port=settings.port,
        num_workers=settings.workers,
        options=server_options(settings, grace_s=settings.shutdown_grace_s),
        renewed=renewed,
    )


def create_serving_app(
    open_worlds: Callable[[], Mapping[str, World[Any]]],
    settings: WorldServiceSettings,
    name: str,
    reopen: Reopen | None = None,
) -> FastAPI:
    """The application of one of several processes, which computes a first chunk in each world."""
    configure_logging(service=name, log_format=settings.log_format, level=settings.log_level)
    SPANS.configure(name)
    app = create_world_app(open_worlds(), settings, name=name, reopen=reopen, warm_up=True)
    return SPANS.close_with(app)
