"""Service applications served from a background thread on loopback."""

import asyncio
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial

from fastapi import FastAPI

from dextouch.errors import UnavailableError
from services.cli.servers import bind, serve_all

START_TIMEOUT_S = 60.0


@contextmanager
def served(apps: Mapping[str, FastAPI]) -> Iterator[dict[str, str]]:
    """Context manager that serves applications in a thread; yields their URLs by name.

    Raises:
        UnavailableError: they did not start, or one terminated unexpectedly.
    """
    placed = [(bind(name, host="127.0.0.1", port=0), app) for name, app in apps.items()]
    answering = threading.Event()
    stopper: Future[Callable[[], object]] = Future()

    async def serve() -> None:
        stop = asyncio.Event()
        stopper.set_result(partial(asyncio.get_running_loop().call_soon_threadsafe, stop.set))
        await serve_all(placed, stop=stop, on_ready=answering.set)

    with ThreadPoolExecutor(1, "services") as pool:
        serving = pool.submit(asyncio.run, serve())
        serving.add_done_callback(lambda _: answering.set())
        has_begun = answering.wait(START_TIMEOUT_S) and not serving.done()
        try:
            if has_begun:
                yield {place.name: place.url for place, _ in placed}
        finally:
            # The loop is closed where they ended by themselves.
            with suppress(RuntimeError):
                stopper.result()()
            failure = serving.exception()
            if has_begun and failure is not None:
                raise UnavailableError("a service ended by itself") from failure
    if not has_begun:
        raise UnavailableError(
            f"services {', '.join(apps)} did not start within {START_TIMEOUT_S:.0f} s; the log "
            "above says why"
        ) from failure
