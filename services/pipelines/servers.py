"""Several service applications served from one event loop, or from a background thread."""

import asyncio
import gc
import signal
import socket
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import uvicorn
from fastapi import FastAPI

from dextouch.errors import ConflictError, UnavailableError
from dextouch.serving import ServiceSettings, bound_socket, server_options

BACKLOG = 128  # as the kernel's usual somaxconn of before
START_TIMEOUT_S = 60.0  # chosen: for imports of torch on a busy machine
START_CHECK_S = 0.01  # chosen: less than anyone notices
GRACE_S = 10  # chosen: for requests in flight

T = TypeVar("T")


class Server(uvicorn.Server):
    """Server of one service that leaves signal handling to its owner."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start; a failure ends this server instead of the whole process."""
        try:
            await super().startup(sockets)
        except SystemExit as error:
            raise UnavailableError("the service did not start") from error

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave the process's signal handlers alone."""
        yield


def _server(app: FastAPI, grace_s: int) -> Server:
    settings: ServiceSettings = getattr(app.state, "settings", None) or ServiceSettings()
    options = server_options(settings, grace_s=grace_s)
    return Server(uvicorn.Config(app, backlog=BACKLOG, **options))


@dataclass(frozen=True)
class BoundAddress:
    """A bound socket, whose URL is known before the service exists."""

    name: str
    socket: socket.socket

    @property
    def url(self) -> str:
        """URL of the service."""
        host, port = self.socket.getsockname()[:2]
        return f"http://{host}:{port}"


def bind(name: str, *, host: str, port: int) -> BoundAddress:
    """Bind a port; 0 selects a free one. Raises ConflictError if it is taken (`bound_socket`)."""
    flag = f"--{name.replace('_', '-')}-port"
    advice = f"choose another port with {flag}, or 0 for any free one"
    listener = bound_socket(name, host, port, advice=advice)
    try:
        # At once: until the socket listens, others could bind the same port.
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise ConflictError(
            f"{name}: cannot listen on {host}:{port} ({error.strerror}); {advice}"
        ) from error
    return BoundAddress(name, listener)


def run_on_event_loop(main: Coroutine[Any, Any, T]) -> T:
    """`asyncio.run` on the event loop that uvicorn selects: uvloop's where it is installed."""
    loop_factory = uvicorn.Config("", log_config=None).get_loop_factory()
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(main)


async def serve_all(
    placed: Sequence[tuple[BoundAddress, FastAPI]],
    *,
    stop: asyncio.Event,
    on_ready: Callable[[], None],
    grace_s: int = GRACE_S,
) -> None:
    """Serve until `stop` is set; `on_ready` is called once all services respond.

    Raises UnavailableError if a service ended unexpectedly; the others were shut down.
    """
    servers = {place.name: _server(app, grace_s) for place, app in placed}
    # A full collection would visit all modules and hold up every request for some 60 ms.
    gc.collect()
    gc.freeze()
    tasks = {
        place.name: asyncio.create_task(servers[place.name].serve(sockets=[place.socket]))
        for place, _ in placed
    }
    stopping = asyncio.create_task(stop.wait())
    announcing = asyncio.create_task(_announce(list(servers.values()), on_ready))
    await asyncio.wait([stopping, *tasks.values()], return_when=asyncio.FIRST_COMPLETED)
    ended = [name for name, task in tasks.items() if task.done()]
    # In reverse, so that clients stop before the services they use.
    for name in reversed(list(servers)):
        servers[name].should_exit = True
        await asyncio.wait([tasks[name]])
    for task in (stopping, announcing):
        task.cancel()
    for place, _ in placed:
        place.socket.close()
    for place, app in placed:
        error = getattr(app.state, "start_error", None)
        if error is not None:
            raise UnavailableError(f"{place.name} did not start: {error.message}") from error
    failures = [error for task in tasks.values() if (error := task.exception()) is not None]
    if failures or (ended and not stop.is_set()):
        raise UnavailableError(
            f"service ended by itself: {', '.join(ended) or 'unknown'}; its log above says why"
        ) from (failures[0] if failures else None)


def stop_on_signals(stop: asyncio.Event) -> None:
    """Set `stop` on SIGINT or SIGTERM; a second signal ends the process at once."""
    loop = asyncio.get_running_loop()

    def on_signal(number: signal.Signals) -> None:
        stop.set()
        loop.remove_signal_handler(number)
        # Python's own handler of SIGINT would print what each service was doing.
        signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, on_signal, number)


async def _announce(servers: Sequence[Server], on_ready: Callable[[], None]) -> None:
    while not all(server.started for server in servers):  # noqa: ASYNC110 - uvicorn has no event
        await asyncio.sleep(START_CHECK_S)
    on_ready()


@contextmanager
def served(apps: Mapping[str, FastAPI]) -> Iterator[dict[str, str]]:
    """Context manager that serves applications in threads on loopback; yields URLs by name.

    Raises UnavailableError if they did not start, or one terminated unexpectedly.
    """
    placed = {name: bind(name, host="127.0.0.1", port=0) for name in apps}
    servers = [_server(app, GRACE_S) for app in apps.values()]
    with ExitStack() as stack:
        for place in placed.values():
            stack.callback(place.socket.close)
        pool = stack.enter_context(ThreadPoolExecutor(len(apps), "services"))
        running = [
            pool.submit(server.run, [place.socket])
            for server, place in zip(servers, placed.values(), strict=True)
        ]
        for server in servers:
            stack.callback(setattr, server, "should_exit", True)  # noqa: FBT003 - a value
        give_up_s = time.monotonic() + START_TIMEOUT_S
        while not all(server.started for server in servers):
            ended = [one for one in running if one.done()]
            if ended or time.monotonic() > give_up_s:
                raise UnavailableError(
                    f"services {', '.join(apps)} did not start within {START_TIMEOUT_S:.0f} s; the "
                    "log above says why"
                ) from (ended[0].exception() if ended else None)
            time.sleep(START_CHECK_S)
        yield {name: place.url for name, place in placed.items()}
        if any(one.done() for one in running):
            raise UnavailableError("a service ended by itself; the log above says why")
