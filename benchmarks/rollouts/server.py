"""Child process of the benchmark: rollouts of several worlds, and what they are compared with.

Answers once with its URLs, and ends when its parent does. "durable" is among them where there is a
redis-server.
"""

import gc
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Final, Literal

import msgpack
import numpy as np
import uvicorn
from starlette.types import Receive, Scope, Send
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

from benchmarks.rollouts.ways import BatchDevice, Device, StillWorld
from dextouch.schemas import ReturnSelector
from dextouch.serving import configure_logging, serve_parent
from dextouch.worlds import WorldServiceSettings, create_world_app
from services.pipelines.servers import Server, bind, run_on_event_loop, served

STEPS: Final[tuple[Literal["last", "all"], ...]] = ("last", "all")


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    """ASGI application that reads a body and responds with the number of bytes in the path."""
    if scope["type"] != "http":
        return
    while (await receive()).get("more_body"):
        pass
    body = bytes(int(scope["path"].rsplit("/", 1)[1]))
    headers = [
        (b"content-type", b"application/msgpack"),
        (b"content-length", str(len(body)).encode()),
    ]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})


def _encoded(value: np.ndarray) -> dict[bytes, Any]:
    shape, data = value.shape, value.tobytes()
    return {b"__ndarray__": True, b"data": data, b"dtype": value.dtype.str, b"shape": shape}


def _decoded(found: dict[Any, Any]) -> Any:  # noqa: ANN401 - an array, or the map itself
    if b"__ndarray__" not in found:
        return found
    return np.frombuffer(found[b"data"], found[b"dtype"]).reshape(found[b"shape"])


async def answer_messages(connection: ServerConnection) -> None:
    """Minimal server like openpi's: unpack a message, take a step, pack the observation."""
    world, state = StillWorld(), 0
    selectors = {steps: ReturnSelector(steps=steps) for steps in STEPS}
    with suppress(ConnectionClosed):
        while True:
            message = await connection.recv(decode=False)
            request = msgpack.unpackb(message, object_hook=_decoded)
            actions, selector = request["actions"], selectors[request["steps"]]
            stepped = world.step(state, actions, seed=0, selector=selector)
            state, seen = stepped.state, stepped.observation
            fields = {
                "first_step": seen.first_step,
                "tactile_kpa": seen.tactile_kpa,
                "action_reached": seen.action_reached,
                **{f"image/{camera}": images for camera, images in seen.images.items()},
            }
            await connection.send(msgpack.packb(fields, default=_encoded))


@contextmanager
def bare_servers() -> Iterator[dict[str, str]]:
    """The echo in a bare uvicorn, and the minimal WebSocket server, in a thread."""
    place, started = bind("echo", host="127.0.0.1", port=0), threading.Event()
    config = uvicorn.Config(echo, log_config=None, access_log=False, lifespan="off")
    server, urls = Server(config), {"echo": place.url}

    async def run() -> None:
        async with serve(answer_messages, "127.0.0.1", 0, compression=None) as sockets:
            port = next(iter(sockets.sockets)).getsockname()[1]
            urls["messages"] = f"ws://127.0.0.1:{port}"
            started.set()
            await server.serve(sockets=[place.socket])

    thread = threading.Thread(target=run_on_event_loop, args=[run()], daemon=True)
    thread.start()
    started.wait()
    try:
        yield urls
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def redis_url() -> Iterator[str | None]:
    """Address of an empty Redis server without persistence; None where none is installed."""
    program = shutil.which("redis-server")
    if program is None:
        yield None
        return
    place = bind("redis", host="127.0.0.1", port=0)
    port = place.url.rsplit(":", 1)[1]
    place.socket.close()
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        command = [program, "--port", port, "--bind", "127.0.0.1", "--save", "", "--dir", folder]
        process = stack.enter_context(
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: S603 - by PATH
        )
        stack.callback(process.terminate)
        assert process.stdout is not None  # noqa: S101 - it is a pipe
        next(line for line in process.stdout if "Ready to accept" in line)
        yield f"redis://127.0.0.1:{port}/0"


def main() -> None:
    """Serve until standard input closes."""
    requests, answer = serve_parent(niceness=0)
    configure_logging(service="benchmark", log_format="auto", level="warning")
    worlds = {
        "still": StillWorld(),
        "still in a thread": StillWorld(is_quick=False),
        "device": Device(is_quick=False),
        "batch device": BatchDevice(is_quick=False),
    }
    with bare_servers() as bare, redis_url() as url:
        # Each round begins new ones, and listing is measured among ten thousand.
        limits = WorldServiceSettings().limits.model_copy(update={"max_rollouts": 30_000})
        apps = {"ours": create_world_app(worlds, WorldServiceSettings(limits=limits))}
        if url is not None:
            durable = WorldServiceSettings(state_url=url, limits=limits)
            apps["durable"] = create_world_app({"still": StillWorld()}, durable)
        with served(apps) as urls:
            # As `dextouch.serving.run` does.
            gc.collect()
            gc.freeze()
            answer({**bare, **urls})
            for _ in requests:
                pass


if __name__ == "__main__":
    main()
