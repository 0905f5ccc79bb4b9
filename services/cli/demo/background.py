"""Service applications served from a background thread on loopback."""

import asyncio
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from fastapi import FastAPI

from dextouch.errors import UnavailableError
from services.cli.servers import Place, bind, serve_all

START_TIMEOUT_S = 60.0


@contextmanager
def served(apps: Mapping[str, FastAPI]) -> Iterator[dict[str, str]]:
    """Context manager that serves applications in a thread; yields their URLs by name.

    Raises:
        UnavailableError: they did not start, or one terminated unexpectedly.
    """
    placed = [(bind(name, host="127.0.0.1", port=0), app) for name, app in apps.items()]
    runner = _Runner(placed)
    runner.start()
    try:
        yield {place.name: place.url for place, _ in placed}
    finally:
        runner.stop()


class _Runner:
    def __init__(self, placed: list[tuple[Place, FastAPI]]) -> None:
        self._placed = placed
        self._ready = threading.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop: asyncio.Event | None = None
        self._failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="services", daemon=True)

    def start(self) -> None:
        self._thread.start()
        if not self._ready.wait(START_TIMEOUT_S) or self._failure is not None:
            raise UnavailableError(
                f"services {', '.join(place.name for place, _ in self._placed)} did not start "
                f"within {START_TIMEOUT_S:.0f} s; the log above says why"
            ) from self._failure

    def stop(self) -> None:
        if self._loop is not None and self._stop is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()
        if self._failure is not None:
            raise UnavailableError("a service ended by itself") from self._failure

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except (UnavailableError, OSError) as error:
            self._failure = error
        finally:
            self._ready.set()

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        answering = asyncio.Event()
        announce = asyncio.create_task(self._announce(answering))
        try:
            await serve_all(self._placed, stop=self._stop, ready=answering)
        finally:
            announce.cancel()

    async def _announce(self, answering: asyncio.Event) -> None:
        await answering.wait()
        self._ready.set()
