"""Several services in one process: known URLs, one stop for all, a failing one is said."""

import asyncio
import signal
import subprocess
import sys
from contextlib import asynccontextmanager, suppress

import httpx
import pytest
import websockets
from fastapi import FastAPI, WebSocket, WebSocketDisconnect

from dextouch.errors import ConflictError, UnavailableError
from dextouch.serving import MAX_WEBSOCKET_BYTES
from services.pipelines.servers import bind, serve_all


def app_named(name, lives, *, fails=False):
    @asynccontextmanager
    async def lifespan(_):
        if fails:
            raise RuntimeError("planted")
        lives.append(f"{name} up")
        yield
        lives.append(f"{name} down")

    app = FastAPI(lifespan=lifespan)
    app.get("/")(lambda: name)
    return app


async def test_all_answer_and_stop_in_reverse():
    lives = []
    placed = [
        (bind(name, host="127.0.0.1", port=0), app_named(name, lives)) for name in ("store", "page")
    ]
    stop, ready = asyncio.Event(), asyncio.Event()
    serving = asyncio.create_task(serve_all(placed, stop=stop, on_ready=ready.set))
    await asyncio.wait_for(ready.wait(), 60)
    async with httpx.AsyncClient(trust_env=False) as client:
        answers = [(await client.get(place.url)).json() for place, _ in placed]
    assert answers == ["store", "page"]
    stop.set()
    await asyncio.wait_for(serving, 60)
    assert lives[-2:] == ["page down", "store down"]


async def test_a_longer_websocket_message_ends_the_connection():
    app = FastAPI()

    @app.websocket("/live")
    async def live(websocket: WebSocket):
        await websocket.accept()
        with suppress(WebSocketDisconnect):
            while True:
                await websocket.send_json(len(await websocket.receive_text()))

    place = bind("page", host="127.0.0.1", port=0)
    stop, ready = asyncio.Event(), asyncio.Event()
    serving = asyncio.create_task(serve_all([(place, app)], stop=stop, on_ready=ready.set))
    await asyncio.wait_for(ready.wait(), 10)
    url = place.url.replace("http", "ws") + "/live"
    async with websockets.connect(url, proxy=None, compression=None) as client:
        await client.send("x" * MAX_WEBSOCKET_BYTES)
        assert int(await asyncio.wait_for(client.recv(), 10)) == MAX_WEBSOCKET_BYTES
        await client.send("x" * (MAX_WEBSOCKET_BYTES + 1))
        with pytest.raises(websockets.ConnectionClosedError) as caught:
            await asyncio.wait_for(client.recv(), 10)
    # RFC 6455, 7.4.1: a message that is too big.
    assert caught.value.rcvd.code == 1009
    stop.set()
    await asyncio.wait_for(serving, 10)


async def test_a_service_that_cannot_start_ends_all():
    lives = []
    placed = [
        (bind("store", host="127.0.0.1", port=0), app_named("store", lives)),
        (bind("page", host="127.0.0.1", port=0), app_named("page", lives, fails=True)),
    ]
    with pytest.raises(UnavailableError, match="ended by itself: page"):
        await asyncio.wait_for(serve_all(placed, stop=asyncio.Event(), on_ready=lambda: None), 60)
    assert "store down" in lives


def test_a_taken_port_is_named():
    place = bind("store", host="127.0.0.1", port=0)
    place.socket.listen()
    port = place.socket.getsockname()[1]
    with pytest.raises(ConflictError, match=rf"cannot listen on 127.0.0.1:{port}.*--page-port"):
        bind("page", host="127.0.0.1", port=port)
    place.socket.close()


TWO_SIGNALS = """
import asyncio, os, signal
from services.pipelines.servers import run_on_event_loop, stop_on_signals

async def drained():
    stop = asyncio.Event()
    stop_on_signals(stop)
    os.kill(os.getpid(), {number})
    await stop.wait()
    os.kill(os.getpid(), {number})
    await asyncio.sleep(60)

run_on_event_loop(drained())
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_the_process_without_a_traceback(number):
    code = TWO_SIGNALS.format(number=int(number))
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, timeout=60, check=False
    )
    assert (ended.returncode, ended.stderr) == (-number, b"")
